"""One clock for all cameras: timecode, sound and motion, each with its error, weighed and held against each other."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.recordings.importing.motion import Watched, offsets_from_motion
from d2_plugin.recordings.importing.settings import by_camera, finite
from d2_plugin.recordings.importing.sound import Sound, lag_between, read_sound
from d2_plugin.recordings.importing.video import VideoFile

METHODS = ("auto", "timecode", "sound", "motion", "none")
"""How offsets are found; `none` says that all clocks begin together."""

APART = 0.75
"""Frames by which evidence may differ from the whole, beside three times its error: more is a contradiction."""

STAMPS = "the files' own stamps"  # how a method begins that takes them
STAMPS_ERROR = 0.5  # frames: the same of stamps that nothing confirms

TIMECODE_ERROR = 12**-0.5  # frames: the standard deviation of what is rounded to whole frames

SOUND_ERROR = 1e-3
"""Seconds at least that an offset from sound may be wrong: sound travels a third of a metre in that time."""

DAY = 86_400  # seconds after which a timecode begins anew, so that the shorter way around midnight counts

_TIMECODE = re.compile(r"(\d{1,2}):(\d{2}):(\d{2})([:;.])(\d{2,3})$")

INSTEAD = "give the offsets (--offsets NAME=FRAMES,...), or record a clap that all see and hear"


@dataclass(frozen=True)
class Clock:
    """When the clock of a video began, after that of the first camera."""

    seconds: float
    error: float  # standard error, seconds; 0 for what was given
    method: str  # where it comes from, such as `sound`


class Evidence(NamedTuple):
    """That the clock of `other` began so much later than that of `one`."""

    one: str
    other: str
    seconds: float
    error: float
    method: str


def common_clock(
    videos: Mapping[str, VideoFile], how: str, watching: Callable[[], Mapping[str, Watched]] | None
) -> dict[str, Clock]:
    """When each video's clock began, by the best evidence there is: timecode, then sound, then motion.

    Where nothing says it and all files are alike, their own stamps are taken, and `method` says so.
    `watching` says what moves in all cameras; all videos are decoded for it, so only where motion must decide. With
    None, as motion takes the calibration that may be looked for, nothing comes back there.

    Raises:
        D2Error: no evidence links a camera to the others, or the evidence contradicts itself.
    """
    names = list(videos)
    if how == "none" or len(names) == 1:
        return {name: Clock(0.0, 0.0, "none") for name in names}
    frame = 1 / min(video.rate or 25.0 for video in videos.values())
    evidence = _of_timecodes(videos) if how in ("auto", "timecode") else []
    if how in ("auto", "sound"):
        evidence += _of_sound({name: read_sound(video.path) for name, video in videos.items() if video.sound})
    if how == "motion" or (how == "auto" and len(linked_names(names, [one[:2] for one in evidence])) < len(names)):
        if watching is None:
            return {}
        by_motion, doubt = _of_motion(watching(), names, videos)
        if doubt and (evidence or how == "motion" or not of_one_recorder(videos.values())):
            raise D2Error(f"{doubt}: {INSTEAD}")
        if doubt:
            method = f"{STAMPS}, as if one program had recorded them all ({doubt})"
            return {name: Clock(0.0, STAMPS_ERROR * frame, method) for name in names}
        evidence += by_motion
    linked = linked_names(names, [one[:2] for one in evidence])
    if len(linked) < len(names):
        alone = ", ".join(name for name in names if name not in linked)
        what = {"auto": "timecode, sound or motion"}.get(how, f"the {how}")
        raise D2Error(f"nothing in {what} links {alone} with {', '.join(linked)}: leave camera {alone} out, {INSTEAD}")
    return _solved(names, evidence, frame)


def given_clock(videos: Mapping[str, VideoFile], given: Sequence[str]) -> dict[str, Clock]:
    """Offsets in frames of each camera's own rate, as `NAME=FRAMES`; cameras that are not named begin at 0.

    Raises:
        D2Error: what is no number, and cameras that there are not.
    """
    expected = f"{', '.join(METHODS)}, or NAME=FRAMES such as {next(iter(videos))}=-7.5"
    if given and not any("=" in text for text in given):  # one number for all would move none
        raise D2Error(f"--offsets says '{','.join(given)}', expected {expected}: correct it")
    starts = by_camera("--offsets", given, videos, finite, expected)
    return {name: Clock(starts.get(name, 0.0) / (video.rate or 25.0), 0.0, "given") for name, video in videos.items()}


def timecode_seconds(text: str, rate: float) -> float | None:
    """Seconds since midnight of an SMPTE timecode at `rate` frames per second; None where the text is none.

    hours:minutes:seconds:frames, counted at the whole rate next to `rate`. Drop-frame timecode, with `;` before the
    frames, leaves out the first two numbers (four at 59.94) of every minute but each tenth, so that the count keeps up
    with the clock.
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


def _of_timecodes(videos: Mapping[str, VideoFile]) -> list[Evidence]:
    read = {name: timecode_seconds(video.timecode or "", video.rate) for name, video in videos.items()}
    starts = {name: time - float(videos[name].times[0]) for name, time in read.items() if time is not None}
    error = {name: TIMECODE_ERROR / (videos[name].rate or 25.0) for name in starts}
    evidence = []
    for one, other in combinations(starts, 2):
        seconds = math.remainder(starts[other] - starts[one], DAY)
        evidence.append(Evidence(one, other, seconds, float(np.hypot(error[one], error[other])), "timecode"))
    return evidence


def _of_sound(sounds: Mapping[str, Sound | None]) -> list[Evidence]:
    evidence = []
    for (one, first), (other, second) in combinations(sounds.items(), 2):
        lag = None if first is None or second is None else lag_between(first, second)
        if lag is not None:
            evidence.append(Evidence(one, other, lag.seconds, max(lag.error, SOUND_ERROR), "sound"))
    return evidence


def _of_motion(
    watched: Mapping[str, Watched], names: Sequence[str], videos: Mapping[str, VideoFile]
) -> tuple[list[Evidence], str]:
    """(what motion says, or nothing and why it says nothing)."""
    seen = offsets_from_motion(watched, search=max(float(np.ptp(video.times)) for video in videos.values()))
    doubtful = {name: one.doubt for name, one in seen.items() if one.doubt}
    if doubtful:
        name, why = next(iter(doubtful.items()))
        whose = f"camera {name}" if len(names) - len(doubtful) > 1 else "the cameras"
        return [], f"motion does not say when {whose} started ({why})"
    return [Evidence(names[0], name, seen[name].seconds, seen[name].error, "motion") for name in names[1:]], ""


def of_one_recorder(videos: Collection[VideoFile]) -> bool:
    """Whether videos are as long and as fast as those that one program writes of several cameras."""
    lengths, rates = [len(video.stamps) for video in videos], [video.rate for video in videos]
    return max(lengths) - min(lengths) <= 1 and max(rates) <= 1.001 * min(rates)


def linked_names(names: Sequence[str], pairs: Iterable[tuple[str, str]]) -> list[str]:
    """The largest group of names that pairs link, over others or not, in the order of `names`."""
    groups: list[set[str]] = [{name} for name in names]
    for pair in pairs:
        first, second = (next(group for group in groups if name in group) for name in pair)
        if first is not second:
            groups.remove(second)
            first |= second
    largest = max(groups, key=len)
    return [name for name in names if name in largest]


def _solved(names: Sequence[str], evidence: Sequence[Evidence], frame: float) -> dict[str, Clock]:
    offsets, errors = _least_squares(names, evidence)
    worst = _worst(offsets, evidence, frame)
    if worst is not None:
        raise D2Error(_contradiction(names, evidence, frame, *worst))
    best = {name: min((e for e in evidence if name in e[:2]), key=lambda e: e.error) for name in names}
    return {name: Clock(offsets[name], errors[name], best[name].method) for name in names}


def _least_squares(names: Sequence[str], evidence: Sequence[Evidence]) -> tuple[dict[str, float], dict[str, float]]:
    """(offsets, standard errors) by weighted least squares; the first of `names` begins at 0."""
    signs = np.array([[(name == one.other) - float(name == one.one) for name in names] for one in evidence])
    errors = np.array([one.error for one in evidence])
    rows, goal = signs[:, 1:] / errors[:, None], np.array([one.seconds for one in evidence]) / errors
    inverse = np.linalg.pinv(rows.T @ rows)
    offsets, own = inverse @ rows.T @ goal, np.sqrt(np.maximum(np.diag(inverse), 0))
    return dict(zip(names, [0.0, *offsets.tolist()])), dict(zip(names, [0.0, *own.tolist()]))


def _worst(offsets: Mapping[str, float], evidence: Sequence[Evidence], frame: float) -> tuple[Evidence, float] | None:
    """The evidence that differs most from the whole, and by how many seconds; None where all agree."""
    off = [(one, abs(offsets[one.other] - offsets[one.one] - one.seconds)) for one in evidence]
    beyond = [(one, seconds) for one, seconds in off if seconds > APART * frame + 3 * one.error]
    return max(beyond, key=lambda pair: pair[1], default=None)


def _contradiction(
    names: Sequence[str], evidence: Sequence[Evidence], frame: float, worst: Evidence, off: float
) -> str:
    """Whose evidence it is, where leaving one camera or one kind of evidence out makes the rest agree."""
    methods = sorted({one.method for one in evidence})
    guilty = []
    for name in names:
        rest, others = [one for one in evidence if name not in (one.one, one.other)], [n for n in names if n != name]
        if len(rest) >= len(others) and _worst(_least_squares(others, rest)[0], rest, frame) is None:
            guilty.append(name)
    said = (
        f"{' and '.join(methods)} contradict each other" if len(methods) > 1 else f"the {methods[0]} contradicts itself"
    )
    between = f"by {off / frame:.1f} frames between {worst.one} and {worst.other}"
    if len(guilty) == 1:
        without = f"without camera {guilty[0]} all agree (is it of another event?)"
        return f"{said} {between}, and {without}: leave camera {guilty[0]} out, {INSTEAD}"
    return f"{said} {between}: choose one with --offsets timecode, sound or motion, or give them, NAME=FRAMES,..."
