"""SMPTE timecode: hours:minutes:seconds:frames, with `;` before the frames where numbers are dropped (29.97, 59.94)."""

from __future__ import annotations

import re

_TIMECODE = re.compile(r"(\d{1,2}):(\d{2}):(\d{2})([:;.])(\d{2,3})$")

DAY = 86_400
"""Seconds after which a timecode begins anew."""


def timecode_seconds(text: str, rate: float) -> float | None:
    """Seconds since midnight of a timecode at `rate` frames per second; None where the text is none.

    Frames are counted at the whole rate next to `rate`. Drop-frame timecode leaves out the first two numbers (four at
    59.94) of every minute but each tenth, so that the count keeps up with the clock.
    """
    match = _TIMECODE.match(text.strip())
    if match is None or rate <= 0:
        return None
    hours, minutes, seconds, frames = (int(match[place]) for place in (1, 2, 3, 5))
    counted = round(rate)
    if minutes > 59 or seconds > 59 or frames >= counted:
        return None
    number = ((hours * 60 + minutes) * 60 + seconds) * counted + frames
    if match[4] in ";.":
        passed = hours * 60 + minutes
        number -= round(counted / 15) * (passed - passed // 10)
    return number / rate


def shortest(seconds: float) -> float:
    """A difference of two times of day, the shorter way around midnight."""
    return (seconds + DAY / 2) % DAY - DAY / 2
