"""Which cameras train and which are scored, by name: this project's own lists and the published ones.

    preset:4                       four views of the data set that the recording is recognised as; 2 and 3 alike
    preset:n3dv:4                  four views by the order of N3DV, whatever the recording is
    protocol:gc-4dgs-2  -3  -4     N3DV as GC-4DGS trains it (Li et al. 2025, github.com/liyw420/GC-4DGS, its script
                                   scripts/pre_dynerf/pose2MVS.py): lists by scene, which count the recording's
                                   cameras in the order of their names; the first camera, cam00, is scored
    protocol:4c4d                  N3DV as 4C4D trains it (Zhou et al., CVPR 2026, github.com/yangzf-1023/4C4D, default
                                   of scripts/n3v2blender.py): cam01 cam10 cam13 cam20; all others are scored

A preset has one order by data set: three views are the two views and one camera more. Both published protocols use the
first 300 frames at half size (1352 x 1014). The lists of the D²-4DGS paper are in a supplement that is not public.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from d2_plugin.errors import D2Error, refuse_unknown
from d2_plugin.recordings import Recording, open_recording
from d2_plugin.recordings.readers.n3dv import UNSYNCHRONISED

ALL = ("all",)  # in place of camera names: every camera that is not held out trains
PRESET, PROTOCOL = "preset:", "protocol:"  # how a text begins that stands in place of camera names
PAPER = "d2-4dgs"  # protocols whose names begin so are refused


class Rig(NamedTuple):
    """The training cameras of a data set, most important first; `spare` ones stand in for those that are missing."""

    order: tuple[str, ...]
    spare: tuple[str, ...]
    source: str


RIGS = {
    "n3dv": Rig(
        order=("cam01", "cam13", "cam10", "cam20"),
        spare=("cam12", "cam14", "cam03", "cam08", "cam05"),
        source="four views as 4C4D's default; two and three are this project's choice among them",
    ),
}
"""By layout, as each data set numbers its cameras."""

VIEWS = (2, 3, 4)

GC_4DGS: dict[str, dict[int, tuple[int, ...]]] = {
    "cut_roasted_beef": {2: (6, 14), 3: (5, 10, 15), 4: (4, 8, 13, 16)},
    "coffee_martini": {2: (5, 11), 3: (4, 9, 14), 4: (4, 6, 10, 14)},
    "flame_salmon": {2: (6, 13), 3: (5, 9, 14), 4: (4, 8, 11, 15)},
    "cook_spinach": {2: (7, 14), 3: (5, 11, 16), 4: (4, 9, 12, 17)},
    "flame_steak": {2: (7, 14), 3: (5, 11, 16), 4: (4, 9, 12, 17)},
    "sear_steak": {2: (7, 14), 3: (5, 11, 16), 4: (4, 9, 12, 17)},
}
"""Places of the training cameras, from 0, in the sorted list of a scene's cameras, by number of views."""

FEWEST_CAMERAS = 18  # of a whole N3DV recording (coffee_martini): with fewer the places would mean other cameras

CAMERAS_4C4D = ("cam01", "cam10", "cam13", "cam20")

PROTOCOLS = {
    **{f"gc-4dgs-{views}": "GC-4DGS, scripts/pre_dynerf/pose2MVS.py" for views in VIEWS},
    "4c4d": "4C4D, default of scripts/n3v2blender.py",
}
"""By name, where each is written."""


class CameraSplit(NamedTuple):
    """Cameras to train on and to score, and what is worth knowing about the choice."""

    train: tuple[str, ...]
    test: tuple[str, ...]
    notes: tuple[str, ...]


def resolve_cameras(
    path: Path | str, train: tuple[str, ...], test: tuple[str, ...] | None = None
) -> tuple[tuple[str, ...], tuple[str, ...] | None, tuple[str, ...]]:
    """(training cameras, test cameras, notes) of a run on the recording in `path`.

    Where `train` is one preset or protocol, the recording is opened (headers only) and names are filled in, those of
    `test` only where it is None. Names pass through unchanged.
    """
    if train == ALL:
        names = tuple(name for name in open_recording(path).cameras if name not in (test or ()))
        return names, test, ()
    if split_name(train) is None:
        return train, test, ()
    if len(train) > 1:
        raise D2Error(f"'{', '.join(train)}' mixes a preset with other names: give the preset alone, or names only")
    recording = open_recording(path, intersect=True)
    split = camera_split(recording, train[0])
    chosen = split.test if test is None else test
    # A run reads the chosen cameras alone (see `Scene.open`), so only this note says what the others lack.
    noted_by_the_run = open_recording(path, cameras=dict.fromkeys((*split.train, *chosen))).notes
    return split.train, chosen, (*split.notes, *(note for note in recording.notes if note not in noted_by_the_run))


def split_name(train: tuple[str, ...]) -> str | None:
    """The preset or protocol among what stands for training cameras, None where cameras are named."""
    return next((text for text in train if text.startswith((PRESET, PROTOCOL))), None)


def camera_split(recording: Recording, text: str) -> CameraSplit:
    """Training and test cameras for "preset:VIEWS", "preset:DATASET:VIEWS" or "protocol:NAME".

    Raises:
        D2Error: no such name, one whose lists are not public, a recording that it is not about, or too few cameras.
    """
    if not text.startswith(PROTOCOL):
        return _preset(recording, text)
    name = text.removeprefix(PROTOCOL)
    if name.startswith(PAPER):
        raise D2Error(
            "the camera lists of the D²-4DGS paper are in a supplement that is not public: choose "
            f"preset:4, {', '.join(PROTOCOL + one for one in PROTOCOLS)}, or name the training cameras"
        )
    refuse_unknown("protocol", [name], PROTOCOLS)
    train = _trained_by_4c4d(recording) if name == "4c4d" else _trained_by_gc_4dgs(recording, int(name[-1]))
    others = tuple(one for one in recording.cameras if one not in train)
    test = others if name == "4c4d" else (min(recording.cameras),)
    note = f"{text} trains on {', '.join(train)} and scores {', '.join(test)} ({PROTOCOLS[name]})"
    return CameraSplit(train, test, (note,))


def _preset(recording: Recording, preset: str) -> CameraSplit:
    """Test cameras are all others but those known to be unsynchronised, which are never trained on either."""
    *dataset, views_text = preset.removeprefix(PRESET).split(":")
    if not preset.startswith(PRESET) or len(dataset) > 1 or views_text not in map(str, VIEWS):
        raise D2Error(f"'{preset}' is no camera preset: expected preset:2, preset:3, preset:4 or preset:n3dv:4")
    name, views = dataset[0] if dataset else _recognised(recording), int(views_text)
    refuse_unknown("data set", [name], RIGS)
    rig = RIGS[name]
    unsound = [name for name in UNSYNCHRONISED.get(recording.name, ()) if name in recording.cameras]
    sound = [name for name in recording.cameras if name not in unsound]
    chosen = [name for name in (*rig.order, *rig.spare) if name in sound][:views]
    if len(chosen) < views:
        raise D2Error(
            f"{preset} needs {views} of {', '.join((*rig.order, *rig.spare))} and {recording.name} has "
            f"{', '.join(recording.cameras)}: name the training cameras instead"
        )
    replaced = [name for name in rig.order[:views] if name not in chosen]
    notes = [f"{preset} trains on {', '.join(sorted(chosen))} ({rig.source})"]
    if replaced:
        notes.append(f"{', '.join(replaced)} missing or unsynchronised: the next in order stand in")
    if unsound:
        notes.append(f"{', '.join(unsound)} known to be unsynchronised: neither trained on nor scored")
    return CameraSplit(tuple(sorted(chosen)), tuple(name for name in sound if name not in chosen), tuple(notes))


def _recognised(recording: Recording) -> str:
    """The data set of a recording: by its layout, or N3DV by its camera names in any layout."""
    if recording.layout in RIGS:
        return recording.layout
    if "cam00" in recording.cameras and all(name.startswith("cam") for name in recording.cameras):
        return "n3dv"
    raise D2Error(
        f"{recording.name} (layout {recording.layout}) is none of the data sets with presets ({', '.join(RIGS)}): "
        "name its training cameras, or the data set as in preset:n3dv:4"
    )


def _trained_by_gc_4dgs(recording: Recording, views: int) -> tuple[str, ...]:
    scene = next((name for name in GC_4DGS if name in recording.name.lower()), None)
    if scene is None:
        raise D2Error(
            f"protocol:gc-4dgs-{views} has lists for {', '.join(GC_4DGS)} of N3DV and not for '{recording.name}': "
            "name the folder after its scene, or choose preset:2, preset:3 or preset:4"
        )
    cameras = sorted(recording.cameras)
    if len(cameras) < FEWEST_CAMERAS:
        raise D2Error(
            f"protocol:gc-4dgs-{views} counts the cameras of the whole recording, at least {FEWEST_CAMERAS}, and "
            f"{recording.name} has {len(cameras)}: use the whole recording, or name the training cameras"
        )
    return tuple(cameras[place] for place in GC_4DGS[scene][views])


def _trained_by_4c4d(recording: Recording) -> tuple[str, ...]:
    absent = [name for name in CAMERAS_4C4D if name not in recording.cameras]
    if absent:
        raise D2Error(
            f"protocol:4c4d trains on {', '.join(CAMERAS_4C4D)} and {recording.name} has no {', '.join(absent)}: "
            "use the whole recording, or name the training cameras"
        )
    return CAMERAS_4C4D
