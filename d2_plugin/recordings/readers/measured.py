"""What the import of videos measured, as cameras.json keeps it: exposures of the cameras, and who was late.

{"exposures": {camera: {"gain": [r, g, b], "error": [r, g, b]}}, "late": {camera: {frame: seconds}}}
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any

from d2_plugin.reading import field
from d2_plugin.recordings.assembly import CORRECT
from d2_plugin.recordings.files import frame_number
from d2_plugin.recordings.recording import Exposure, Recording
from d2_plugin.values import Range

GAIN = Annotated[float, Range(1e-3, 1e3)]
ERROR = Annotated[float, Range(0, 1e3)]
LATE = Annotated[float, Range(-1e3, 1e3)]


def with_measured(recording: Recording, description: Mapping[str, Any], where: str) -> Recording:
    """The recording with the exposures and the lateness of its cameras; unchanged where the file has neither."""
    exposures, late = (field(description, key, dict, where, CORRECT, default={}) for key in ("exposures", "late"))
    if not exposures and not late:
        return recording
    return replace(
        recording,
        exposures={name: _exposure(exposures, name, where) for name in recording.cameras if name in exposures},
        late={name: _late(late, name, recording.frames, where) for name in recording.cameras if name in late},
    )


def _exposure(table: Mapping[str, Any], name: str, where: str) -> Exposure:
    place = f"exposures of camera {name} in {where}"
    entry = field(table, name, dict, f"exposures in {where}", CORRECT)
    gain = field(entry, "gain", tuple[GAIN, GAIN, GAIN], place, CORRECT)
    return Exposure(gain, field(entry, "error", tuple[ERROR, ERROR, ERROR], place, CORRECT))


def _late(table: Mapping[str, Any], name: str, frames: tuple[int, ...], where: str) -> dict[int, float]:
    place, wanted = f"late of camera {name} in {where}", set(frames)
    entry = field(table, name, dict, f"late in {where}", CORRECT)
    numbers = {key: frame_number(key, f"{place}: {key}") for key in entry if str(key).isdecimal()}
    return {number: field(entry, key, LATE, place, CORRECT) for key, number in numbers.items() if number in wanted}
