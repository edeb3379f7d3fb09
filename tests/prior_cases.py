"""For tests of priors: sources that show something else, stores byte by byte, depth maps as COLMAP writes them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.emulated_multiview import emulated_multiview
from d2_plugin.recordings.recording import Recording, Source

Shown = Callable[[str, int], "np.ndarray | None"]


MAPS = ("image", "depth", "mono")


def showing(recording: Recording, instead: dict[str, Shown], **changes: object) -> Recording:
    """The recording with other images, depth or monocular maps, and other values of `changes`."""
    source = Source()
    vars(source).update({kind: getattr(recording.source, kind) for kind in MAPS} | instead)
    return replace(recording, source=source, **changes)


def contents(path: Path) -> dict[str, bytes]:
    """Every file below a folder."""
    return {str(file.relative_to(path)): file.read_bytes() for file in sorted(path.rglob("*")) if file.is_file()}


def write_dense_array(path: Path, depth: np.ndarray) -> None:
    """Write a depth map [H, W] as COLMAP would."""
    height, width = depth.shape
    path.write_bytes(f"{width}&{height}&1&".encode() + np.ascontiguousarray(depth, dtype="<f4").tobytes())


def write_multiview(
    recording: Recording,
    names: list[str],
    folder: Path,
    posed: bool = False,
    turned: Callable[[dict[str, np.ndarray], int], None] | None = None,
) -> Path:
    """Emulated multi-view predictions of all frames; `turned` may spoil the arrays of a frame."""
    folder.mkdir(parents=True)
    cameras = [recording.cameras[name] for name in names]
    for frame in recording.frames:
        arrays = emulated_multiview([recording.depth(name, frame) for name in names], cameras, 100 + frame, posed)
        if turned is not None:
            turned(arrays, frame)
        np.savez(folder / f"{frame:05d}.npz", **arrays)
    return folder
