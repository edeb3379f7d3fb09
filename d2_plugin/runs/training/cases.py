"""Which recordings are trained on, with which cameras: `PATH@CAMERA+CAMERA@HELD_OUT+HELD_OUT`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from d2_plugin.errors import D2Error
from d2_plugin.recordings.presets import resolve_cameras, split_name
from d2_plugin.runs.settings import RunSettings


class Case(NamedTuple):
    """One recording with its cameras."""

    name: str
    """As rows have it: the recording, how many cameras train, and the size where it is not the recording's own."""
    slug: str
    """Name of its folder."""
    settings: RunSettings


def case_of(text: str, base: RunSettings) -> Case:
    """The case that a text names; `base` gives all but recording and cameras.

    Raises:
        D2Error: no cameras, or more than two groups of them.
    """
    path, *groups = text.split("@")
    if not path or not 1 <= len(groups) <= 2:
        raise D2Error(
            f"'{text}' names no cameras to train with: write PATH@00+02+05+07, or PATH@00+02@01+03 to say as well "
            "which ones score"
        )
    named = [tuple(name for name in group.split("+") if name) for group in groups]
    train, test, _ = resolve_cameras(path, named[0], named[1] if len(named) > 1 else None)
    protocol = split_name(named[0])
    settings = replace(base, recording=path, train_cameras=train, test_cameras=test, protocol=protocol)
    title = Path(path).resolve().name
    size = f", 1/{base.downscale} size" if base.downscale > 1 else ""
    slug = "_".join([title, *train]) + (f"_small{base.downscale}" if base.downscale > 1 else "")
    name = f"{title}, {len(train)} views{size}" + (f", {protocol}" if protocol else "")
    return Case(name, slug + (f"_{protocol.replace(':', '_')}" if protocol else ""), settings)
