"""Which camera of a calibration belongs to which recording.

In this order: equal names; one name that holds the other (hd_00_05 and 00_05); equal last numbers (int_cam1_img and
cam01); and, with a note, the order of names where there are as many recordings as cameras. A way counts where it finds
one camera for every recording, and no camera twice.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

from d2_plugin.errors import D2Error
from d2_plugin.recordings.cameras.formats.camera import Entry

Same = Callable[[str, str], bool]
"""(name in the calibration, name of a recording) -> whether they may be one camera."""


def matched(entries: Sequence[Entry], recordings: Sequence[str], place: str) -> tuple[list[Entry], tuple[str, ...]]:
    """(the cameras under the names of the recordings and in their order, notes).

    Raises:
        D2Error: recordings without a camera, by name.
    """
    names = [entry.name for entry in entries]
    for same in (_equal, _holds, _same_number):
        pairs = _pairs(names, recordings, same)
        if pairs is not None:
            return [entries[names.index(pairs[name])]._replace(name=name) for name in recordings], ()
    if len(names) != len(recordings):
        lost = [name for name in recordings if not any(_equal(camera, name) for camera in names)]
        raise D2Error(
            f"{place} has no camera for {', '.join(lost or recordings)}, only {_some(names)}: name the recordings as "
            "the calibration does"
        )
    by_order = dict(zip(sorted(recordings, key=natural), sorted(entries, key=lambda entry: natural(entry.name))))
    said = ", ".join(f"{name} is {entry.name}" for name, entry in by_order.items())
    note = f"names differ, so cameras were matched in the order of names ({said}): rename them if that is wrong"
    return [by_order[name]._replace(name=name) for name in recordings], (note,)


def natural(name: str) -> list[tuple[int, str]]:
    """A key that sorts cam2 before cam10."""
    return [(int(part), "") if part.isdecimal() else (0, part.lower()) for part in re.split(r"(\d{1,18})", name)]


def _pairs(cameras: Sequence[str], recordings: Sequence[str], same: Same) -> dict[str, str] | None:
    """Recording -> camera where every recording has exactly one and no two share it, else None."""
    found = {name: [camera for camera in cameras if same(camera, name)] for name in recordings}
    if any(len(candidates) != 1 for candidates in found.values()):
        return None
    pairs = {name: candidates[0] for name, candidates in found.items()}
    return pairs if len(set(pairs.values())) == len(pairs) else None


def _equal(camera: str, recording: str) -> bool:
    return camera == recording


def _holds(camera: str, recording: str) -> bool:
    one, other = camera.lower(), recording.lower()
    return _whole_word(one, other) or _whole_word(other, one)


def _whole_word(part: str, whole: str) -> bool:
    """Whether `part` stands in `whole` and does not cut a number or a word."""
    edge = r"[^\W_]"
    return re.search(rf"(?<!{edge}){re.escape(part)}(?!{edge})", whole) is not None


def _same_number(camera: str, recording: str) -> bool:
    one, other = (re.findall(r"\d{1,18}", name) for name in (camera, recording))
    return bool(one) and bool(other) and int(one[-1]) == int(other[-1])


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "")
