"""How much memory a recording will take, said before work begins instead of by the system that ends the process."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from d2_plugin.errors import D2Error
from d2_plugin.recordings.recording import Recording
from d2_plugin.values import counted

BYTES_PER_PIXEL = 110  # of every training camera, at the peak of building its prior or of rendering it
BYTES_PER_MATCH, MOST_MATCHES = 70, 2_000_000  # of pixels that stereo matches at once, and how many of a camera
BASE_BYTES = 1 << 29  # what Python, torch and the Gaussians take whatever the size of the images
SCALES = (2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)  # what is proposed for `--downscale`


def needed_bytes(recording: Recording, cameras: Sequence[str], downscale: int = 1) -> int:
    """Estimate of the peak memory of priors and training on the named cameras, all of one instant at a time."""
    chosen = [recording.cameras[name] for name in cameras]
    pixels = [(camera.width // downscale) * (camera.height // downscale) for camera in chosen]
    matched = sum(min(count, MOST_MATCHES) for count in pixels)
    return BASE_BYTES + BYTES_PER_PIXEL * sum(pixels) + BYTES_PER_MATCH * matched


def available_bytes() -> int | None:
    """Memory that this process may still take: what is free on the machine, within its limits; None where unknown."""
    limits = [*_free_on_linux(), *_left_of_group(), *_left_of_process()]
    return min(limits) if limits else None


def check_memory(recording: Recording, cameras: Sequence[str]) -> None:
    """Refuse a recording that this machine has too little memory for, with a scale that fits.

    Raises:
        D2Error: the estimate is above what is available.
    """
    available = available_bytes()
    fits = [scale for scale in SCALES if available is None or needed_bytes(recording, cameras, scale) <= available]
    proposal = f"--downscale {fits[0]}" if fits else "a machine with more memory"
    largest = max((recording.cameras[name] for name in cameras), key=lambda camera: camera.width * camera.height)
    what = f"images of {counted(len(cameras), 'camera')} of {largest.width}x{largest.height} pixels"
    check_bytes(needed_bytes(recording, cameras), what, f"use {proposal}")


def check_bytes(needed: float, what: str, remedy: str) -> None:
    """Refuse `what`, a plural, where this machine has too little memory for it.

    Raises:
        D2Error: more than is available is needed.
    """
    available = available_bytes()
    if available is not None and needed > available:
        raise D2Error(
            f"{what} need about {needed / 2**30:.1f} GiB of memory and {available / 2**30:.1f} GiB are available: "
            f"{remedy}"
        )


def _free_on_linux() -> list[int]:
    with suppress(OSError, ValueError):
        free = re.search(r"MemAvailable:\s+(\d+) kB", Path("/proc/meminfo").read_text())
        return [int(free[1]) * 1024] if free else []
    return []


def _left_of_group() -> list[int]:
    """Of a container: version 2 of control groups, which says `max` where there is no limit, then version 1."""
    for limit, used in (
        ("memory.max", "memory.current"),
        ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes"),
    ):
        with suppress(OSError, ValueError):
            folder = Path("/sys/fs/cgroup")
            inactive = re.search(
                r"^(?:total_)?inactive_file (\d+)", (folder / used).with_name("memory.stat").read_text(), re.MULTILINE
            )
            left = int((folder / limit).read_text()) - int((folder / used).read_text())
            return [left + (int(inactive[1]) if inactive else 0)]  # files in memory give way
    return []


def _left_of_process() -> list[int]:
    """Within `ulimit -v`, where one is set."""
    with suppress(ImportError, OSError, ValueError):
        import resource

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit != resource.RLIM_INFINITY:
            taken = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
            return [max(limit - taken, 0)]
    return []
