"""Which cameras to train on with two, three or four views, by data set.

The paper's own camera lists are in a supplement that is not public; those of other publications are in
`d2_plugin.recordings.protocols`. N3DV's four views are those of 4C4D; the other lists are this project's choice. Each
data set has one order: three views are the two views and one camera more, so scores over the number of views compare
like with like.

    preset:4          four views of the data set that the recording is recognised as
    preset:n3dv:4     four views by the order of N3DV, whatever the recording is
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from d2_plugin.errors import D2Error, unknown_name
from d2_plugin.recordings import Recording, open_recording
from d2_plugin.recordings.protocols import OURS, CameraSplit, is_protocol, protocol_split
from d2_plugin.recordings.protocols import PREFIX as PROTOCOL
from d2_plugin.recordings.readers.n3dv import UNSYNCHRONISED

ALL = ("all",)
"""In place of camera names: every camera that is not held out trains."""

PREFIX = "preset:"
"""How a preset begins where camera names are expected."""


@dataclass(frozen=True)
class Rig:
    """The training cameras of a data set, most important first; `spare` ones stand in for those that are missing."""

    order: tuple[str, ...]
    spare: tuple[str, ...]
    held_out: tuple[str, ...]
    """Never trained on: what dense-view comparisons test with."""
    source: str


RIGS = {
    "n3dv": Rig(
        order=("cam01", "cam13", "cam10", "cam20"),
        spare=("cam12", "cam14", "cam03", "cam08", "cam05"),
        held_out=("cam00",),
        source="four views as 4C4D's default; two and three are this project's choice among them",
    ),
    "technicolor": Rig(
        order=("00", "15", "03", "12"),  # corners of the 4 x 4 rig: a diagonal, then the other one
        spare=("01", "14", "02", "13"),
        held_out=("10",),
        source="the corners of the rig, this project's choice",
    ),
    "enerf": Rig(
        # Along the arc stand 07 06 05 02 15 13 17 08 16 14 12 11 10 01 09 00 03 04: near the middle, then the sides.
        order=("08", "12", "02", "09"),
        spare=("17", "11", "15", "01"),
        held_out=("00",),
        source="spread along the arc of cameras, this project's choice",
    ),
}
"""By layout, as each data set numbers its cameras."""

VIEWS = (2, 3, 4)


def is_preset(text: str) -> bool:
    """Whether what stands in place of camera names is a preset."""
    return text.startswith(PREFIX)


def camera_preset(recording: Recording, preset: str) -> CameraSplit:
    """Training and test cameras for `preset`, "preset:VIEWS" or "preset:DATASET:VIEWS".

    Test cameras are all others but those known to be unsynchronised, which are never trained on either.

    Raises:
        D2Error: not a preset, a recording that is none of the data sets, or too few of the cameras are there.
    """
    dataset, views = _parsed(recording, preset)
    rig = RIGS[dataset]
    unsound = [name for name in UNSYNCHRONISED.get(recording.name, ()) if name in recording.cameras]
    sound = [name for name in recording.cameras if name not in unsound]
    candidates = [name for name in (*rig.order[:views], *rig.order[views:], *rig.spare) if name in sound]
    if len(candidates) < views:
        raise D2Error(
            f"{preset} needs {views} of {', '.join((*rig.order, *rig.spare))} and {recording.name} has "
            f"{', '.join(recording.cameras)}: name the training cameras instead"
        )
    chosen = candidates[:views]
    replaced = [name for name in rig.order[:views] if name not in chosen]
    notes = [f"{preset} trains on {', '.join(sorted(chosen))} ({rig.source})"]
    if replaced:
        notes.append(f"{', '.join(replaced)} missing or unsynchronised: the next in order stand in")
    if unsound:
        notes.append(f"{', '.join(unsound)} known to be unsynchronised: neither trained on nor scored")
    return CameraSplit(tuple(sorted(chosen)), tuple(name for name in sound if name not in chosen), tuple(notes))


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
    split = _split(recording, train[0])
    chosen = split.test if test is None else test
    # A run reads the chosen cameras alone (see `Scene.open`), so only this note says what the others lack.
    said_by_the_run = open_recording(path, cameras=dict.fromkeys((*split.train, *chosen))).notes
    return split.train, chosen, (*split.notes, *(note for note in recording.notes if note not in said_by_the_run))


def split_name(train: tuple[str, ...]) -> str | None:
    """The preset or protocol among what stands for training cameras, None where cameras are named."""
    return next((text for text in train if is_preset(text) or is_protocol(text)), None)


def _split(recording: Recording, text: str) -> CameraSplit:
    if text.removeprefix(PROTOCOL) in OURS:
        return camera_preset(recording, f"{PREFIX}{text.rpartition('-')[2]}")
    return protocol_split(recording, text) if is_protocol(text) else camera_preset(recording, text)


def _parsed(recording: Recording, preset: str) -> tuple[str, int]:
    """(data set, number of views) of a preset's text."""
    *dataset, views = preset.removeprefix(PREFIX).split(":")
    if not is_preset(preset) or len(dataset) > 1 or views not in map(str, VIEWS):
        raise D2Error(f"'{preset}' is no camera preset: expected preset:2, preset:3, preset:4 or preset:n3dv:4")
    name = dataset[0] if dataset else _recognised(recording)
    if name not in RIGS:
        raise unknown_name("data set", name, RIGS)
    return name, int(views)


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
