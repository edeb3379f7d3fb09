"""Published splits of cameras by name: who trains, who is scored, and where that is written.

    protocol:gc-4dgs-2  -3  -4     N3DV as GC-4DGS trains it (Li et al. 2025, github.com/liyw420/GC-4DGS, its script
                                   scripts/pre_dynerf/pose2MVS.py): lists by scene, which count the recording's
                                   cameras in the order of their names; the first camera, cam00, is scored
    protocol:4c4d                  N3DV as 4C4D trains it (Zhou et al., CVPR 2026, github.com/yangzf-1023/4C4D, default
                                   of scripts/n3v2blender.py): cam01 cam10 cam13 cam20; all others are scored
    protocol:ours-2  -3  -4        this project's own lists, the same as preset:2, preset:3, preset:4

Both published ones use the first 300 frames at half size (1352 x 1014). Sparse points always come from the training
cameras alone, at every protocol. The lists of the D²-4DGS paper are in a supplement that is not public: asking for them
is refused with that sentence, since a list that was made up could be taken for the paper's.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from d2_plugin.errors import D2Error, unknown_name
from d2_plugin.recordings import Recording

PREFIX = "protocol:"
"""How a protocol begins where camera names are expected."""

PAPER = "d2-4dgs"
"""Names that begin so are refused."""

GC_4DGS: dict[str, dict[int, tuple[int, ...]]] = {
    "cut_roasted_beef": {2: (6, 14), 3: (5, 10, 15), 4: (4, 8, 13, 16)},
    "coffee_martini": {2: (5, 11), 3: (4, 9, 14), 4: (4, 6, 10, 14)},
    "flame_salmon": {2: (6, 13), 3: (5, 9, 14), 4: (4, 8, 11, 15)},
    "cook_spinach": {2: (7, 14), 3: (5, 11, 16), 4: (4, 9, 12, 17)},
    "flame_steak": {2: (7, 14), 3: (5, 11, 16), 4: (4, 9, 12, 17)},
    "sear_steak": {2: (7, 14), 3: (5, 11, 16), 4: (4, 9, 12, 17)},
}
"""Places of the training cameras, from 0, in the sorted list of a scene's cameras, by number of views."""

FEWEST_CAMERAS = 18
"""Of a whole N3DV recording (coffee_martini): with fewer the places would mean other cameras."""

CAMERAS_4C4D = ("cam01", "cam10", "cam13", "cam20")


OURS = ("ours-2", "ours-3", "ours-4")
"""This project's own lists: those of the presets, see `d2_plugin.recordings.presets`."""


class CameraSplit(NamedTuple):
    """Cameras to train on and to score, and what is worth knowing about the choice."""

    train: tuple[str, ...]
    test: tuple[str, ...]
    notes: tuple[str, ...]


def _gc_4dgs(recording: Recording, views: int) -> CameraSplit:
    scene = next((name for name in GC_4DGS if name in recording.name.lower()), None)
    if scene is None:
        raise D2Error(
            f"protocol:gc-4dgs-{views} has lists for {', '.join(GC_4DGS)} of N3DV and not for '{recording.name}': "
            "name the folder after its scene, or choose protocol:ours-2, -3 or -4"
        )
    cameras = sorted(recording.cameras)
    if len(cameras) < FEWEST_CAMERAS:
        raise D2Error(
            f"protocol:gc-4dgs-{views} counts the cameras of the whole recording, at least {FEWEST_CAMERAS}, and "
            f"{recording.name} has {len(cameras)}: use the whole recording, or name the training cameras"
        )
    return CameraSplit(tuple(cameras[place] for place in GC_4DGS[scene][views]), (cameras[0],), ())


def _4c4d(recording: Recording) -> CameraSplit:
    absent = [name for name in CAMERAS_4C4D if name not in recording.cameras]
    if absent:
        raise D2Error(
            f"protocol:4c4d trains on {', '.join(CAMERAS_4C4D)} and {recording.name} has no {', '.join(absent)}: "
            "use the whole recording, or name the training cameras"
        )
    return CameraSplit(CAMERAS_4C4D, tuple(name for name in recording.cameras if name not in CAMERAS_4C4D), ())


PROTOCOLS: dict[str, tuple[str, Callable[[Recording], CameraSplit]]] = {
    **{
        f"gc-4dgs-{views}": ("GC-4DGS, scripts/pre_dynerf/pose2MVS.py", partial(_gc_4dgs, views=views))
        for views in (2, 3, 4)
    },
    "4c4d": ("4C4D, default of scripts/n3v2blender.py", _4c4d),
}
"""The published ones by name: where each is written, and its split."""


def is_protocol(text: str) -> bool:
    """Whether what stands in place of camera names is a protocol."""
    return text.startswith(PREFIX)


def protocol_split(recording: Recording, text: str) -> CameraSplit:
    """Training and test cameras of `protocol:NAME`, one of the published ones.

    Raises:
        D2Error: an unknown protocol, one whose lists are not public, or a recording that it is not about.
    """
    name, known = text.removeprefix(PREFIX), [*PROTOCOLS, *OURS]
    if name.startswith(PAPER):
        raise D2Error(
            "the camera lists of the D²-4DGS paper are in a supplement that is not public: choose "
            f"{', '.join(PREFIX + one for one in known)}, or name the training cameras"
        )
    if name not in PROTOCOLS:
        raise unknown_name("protocol", name, known)
    source, split = PROTOCOLS[name]
    chosen = split(recording)
    note = f"{text} trains on {', '.join(chosen.train)} and scores {', '.join(chosen.test)} ({source})"
    return chosen._replace(notes=(note,))
