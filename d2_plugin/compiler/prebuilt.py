"""Kernels that came compiled with a platform wheel, one library for each level of instructions.

Beside them lies `compiled.json`, their checksums. A library is named by a hash of its sources, headers and flags, so
one of another version is never taken, and where there is none the sources are compiled as in any other installation.
Whoever sets CXX or D2_CXXFLAGS wants a compilation of his own.

Environment:
    D2_CPU         the highest level to use, one of `LEVELS`; otherwise the highest that this CPU has
"""

from __future__ import annotations

import functools
import hashlib
import json
import logging
import os
import platform
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from d2_plugin.errors import unknown_name

logger = logging.getLogger(__name__)

FOLDER = Path(__file__).parents[1] / "compiled"
"""Where a platform wheel has them."""

CHECKSUMS = "compiled.json"
CPU_FLAGS = Path("/proc/cpuinfo")


class Level(NamedTuple):
    """Instructions that a library may use: as the compiler is told, and as the kernel names them."""

    flag: str
    needs: frozenset[str]


_AVX2 = frozenset(["avx", "avx2", "fma", "bmi1", "bmi2", "f16c", "movbe", "abm"])
LEVELS = {
    "avx512": Level("-march=x86-64-v4", _AVX2 | frozenset(["avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"])),
    "avx2": Level("-march=x86-64-v3", _AVX2),
    "scalar": Level("-march=x86-64", frozenset()),
}
"""Best first."""


def file_name(name: str, level: str, sources: Sequence[Path], headers: Sequence[Path], flags: Sequence[str]) -> str:
    """What a compiled library is called: its sources, headers and flags are part of the name."""
    return f"{name}-{digest_of(flags, (*sources, *headers))}-{level}.so"


def digest_of(words: Sequence[str], files: Sequence[Path]) -> str:
    """Twenty letters that stand for words and for what is in files."""
    digest = hashlib.sha256("\0".join(words).encode())
    for path in files:
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()[:20]


def find(name: str, sources: Sequence[Path], headers: Sequence[Path], flags: Sequence[str]) -> Path | None:
    """The compiled library for this CPU; None where none came along, or it is damaged.

    Raises:
        D2Error: D2_CPU names no level.
    """
    known = _checksums(FOLDER / CHECKSUMS)
    if not known or os.environ.get("CXX", "").strip() or os.environ.get("D2_CXXFLAGS", "").strip():
        return None
    for level in usable():
        path = FOLDER / file_name(name, level, sources, headers, flags)
        if path.name not in known:
            continue
        if path.is_file() and hashlib.sha256(path.read_bytes()).hexdigest() == known[path.name]:
            return path
        # The dynamic loader answers a truncated file with a bus error, so it never sees one.
        logger.warning("%s is damaged and not used: install the package again", path)
    return None


def usable() -> list[str]:
    """The levels that this CPU has and D2_CPU allows, best first."""
    if platform.machine().lower() not in ("x86_64", "amd64"):
        return []
    names = list(LEVELS)
    chosen = os.environ.get("D2_CPU", "").strip()
    if chosen and chosen not in LEVELS:
        raise unknown_name("level of instructions in D2_CPU", chosen, names)
    allowed = names[names.index(chosen) :] if chosen else names
    return [name for name in allowed if LEVELS[name].needs <= _cpu_flags()]


@functools.cache
def _cpu_flags() -> frozenset[str]:
    """What /proc/cpuinfo lists of the first core: what the system lets programs use, too."""
    try:
        lines = CPU_FLAGS.read_text(encoding="utf-8").splitlines()
    except OSError:
        return frozenset()
    return frozenset(next((line.partition(":")[2].split() for line in lines if line.startswith("flags")), ()))


@functools.cache
def _checksums(path: Path) -> dict[str, str]:
    """SHA-256 of each library by its name; empty where this is no platform wheel."""
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError):
        return {}
