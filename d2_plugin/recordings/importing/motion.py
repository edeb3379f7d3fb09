"""When cameras started, from what they saw move: features whose way crosses the epipolar lines of other cameras.

A moving feature lies on the epipolar line of its match in another camera only where both images are of one instant. So
each match of two images says how much later one was taken than the other: its distance from the line over the speed at
which it crosses it. A false match says nothing in particular, and at the right lag of two clocks many agree. Their
share over the lag is held against that of all lags; squares of its excess in standard deviations, which are twice
logarithms of likelihood ratios, add up over all pairs of cameras. Frame rates do not matter, nor gains, which change
no feature's place.

The error is that of leaving out one part of the images after another (the jackknife of Quenouille and Tukey), of the
disagreement of all pairs of cameras about the same offsets, and of calibrations, which put all lines a little wrong.
Motion that repeats itself has another lag at which as large a share agrees as at the best: that is no clock.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import chain, combinations
from typing import NamedTuple

import numpy as np

from d2_plugin.progress import progress_bar
from d2_plugin.recordings.cameras.camera import CalibratedCamera
from d2_plugin.recordings.cameras.epipolar import sampson, sift_features
from d2_plugin.recordings.cameras.undistort import Undistortion
from d2_plugin.recordings.images import opencv
from d2_plugin.recordings.importing.video import Decoder, VideoFile
from d2_plugin.recordings.recording import Camera
from d2_plugin.recordings.selection import spread

LONG_SIDE = 480  # pixels of the images that are looked at
MOST_FRAMES = 900  # of each camera, from its beginning
MOST_IMAGES = 150  # of these, in which features are looked for
MOST_ANCHORS = 48  # of these, which are matched with all of another camera
MOST_FEATURES, CONTRAST = 200, 0.005  # of an image, where it changes; OpenCV's contrast is .04
NOISE = (4.0, 1.0)  # change counts above this many times that of half of the pixels, and this many levels of 255 more
SLOWEST = 0.4  # pixels from one frame to the next: what is slower stands still
BACK = 0.5  # pixels by which a feature that is followed to the next frame and back may miss itself
ALIKE = 0.7  # product of two descriptors that may show the same thing
NEAR = 0.7  # pixels, standard deviation of a match from its epipolar line
SURE = 4.0  # standard deviations by which each camera's best lag must stand out; by chance one in 30,000 lags does
RIVAL = 3.0  # the same of other lags, and by which they must be worse than motion that repeats itself
VAGUE = 0.7  # frames of standard error from which motion says nothing
LEAST_ERROR = 0.15  # frames: what a good calibration is wrong by is half a pixel
GROUPS = 8  # parts of the image
LEAST_COMMON = 5  # frames that two cameras must share at a lag
FINE = 8  # steps per frame in which lags are compared; between them lies a parabola


class Moving(NamedTuple):
    """Features of an image that move."""

    pixels: np.ndarray  # [n, 2]
    velocities: np.ndarray  # [n, 2] pixels per second
    descriptors: np.ndarray  # [n, 128] of length 1


class Watched(NamedTuple):
    """What a camera that stands still saw move."""

    camera: Camera  # the pinhole of the small images
    times: np.ndarray  # [T] seconds on the clock of the video
    moving: Sequence[Moving]  # [T]

    @property
    def frame(self) -> float:
        """Seconds from one image to the next."""
        return float(np.median(np.diff(self.times))) if len(self.times) > 1 else 1.0


class Curve(NamedTuple):
    """How many matches of two cameras agree at each lag, of all and without each group."""

    agree: np.ndarray  # [1 + GROUPS, L] matches
    could: np.ndarray  # [1 + GROUPS, L] matches that can say so
    spread: float = 1.0  # of the excess over what chance would give, in standard deviations of independent matches

    def excess(self, which: int) -> np.ndarray:
        """Standard deviations [L] by which more agree than at all lags together."""
        chance = self.agree[which].sum() / max(self.could[which].sum(), 1e-9) * self.could[which]
        return np.asarray((self.agree[which] - chance) / np.sqrt(chance + 1) / self.spread)


class Seen(NamedTuple):
    """What motion says about one camera."""

    seconds: float  # when its clock began, after that of the first camera
    error: float  # standard error, seconds
    doubt: str  # why it cannot be trusted; empty where it can


Scores = Mapping[tuple[str, str], np.ndarray]  # cameras -> squares of the excess [L] at each of `_lags`


def watched_videos(videos: Mapping[str, VideoFile], cameras: Mapping[str, CalibratedCamera]) -> dict[str, Watched]:
    """What moves in the beginning of all videos."""
    seen: dict[str, Watched] = {}
    counts = {name: min(len(video.stamps), MOST_FRAMES) for name, video in videos.items()}
    with progress_bar("decode for motion", sum(counts.values())) as bar:
        for name, video in videos.items():
            decoder = Decoder(video)
            straight = Undistortion(cameras[name].of_size(decoder.grey(0, LONG_SIDE).shape[::-1]))
            images = (straight.image(decoder.grey(index, LONG_SIDE)) for index in range(counts[name]))
            seen[name] = watch(images, video.times[: counts[name]], straight.camera)
            decoder.close()
            bar.update(sum(counts[one] for one in seen), name)
    return seen


def watch(images: Iterable[np.ndarray], times: np.ndarray, camera: Camera) -> Watched:
    """What moves in images uint8 [h, w] of a camera at `times` [T]."""
    chosen = set(spread(range(len(times)), MOST_IMAGES))
    none = Moving(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 128)))
    before, here, moving = None, None, []
    for place, after in enumerate(chain(images, [None]), -1):
        beside = [
            (one, times[k] - times[place]) for one, k in ((before, place - 1), (after, place + 1)) if one is not None
        ]
        if here is not None:
            moving.append(_moving(here, beside) if beside and place in chosen else none)
        before, here = here, after
    return Watched(camera, times, moving)


def _moving(here: np.ndarray, others: Sequence[tuple[np.ndarray, float]]) -> Moving:
    """What moves in an image, by the images next to it, each so many seconds later."""
    cv2 = opencv("finding clocks by motion")
    gains = [np.median((here + 1.0) / (one + 1.0)) for one, _ in others]
    alike = [(one * gain).clip(0, 255).astype(np.uint8) for gain, (one, _) in zip(gains, others)]
    change = np.max([cv2.GaussianBlur(cv2.absdiff(one, here).astype(np.float32), (0, 0), 1.5) for one in alike], axis=0)
    changes = cv2.dilate((change > NOISE[0] * np.median(change) + NOISE[1]).astype(np.uint8), np.ones((5, 5)))
    grey = cv2.cvtColor(here, cv2.COLOR_GRAY2RGB)
    pixels, descriptors, _ = sift_features(grey, MOST_FEATURES, "finding clocks by motion", CONTRAST, changes)
    if not len(pixels):
        return Moving(pixels, pixels, descriptors)
    start, found = (pixels - 0.5).astype(np.float32)[:, None], []
    for one, (_, later) in zip(alike, others):
        there = cv2.calcOpticalFlowPyrLK(here, one, start, None, winSize=(15, 15))[0]
        back = cv2.calcOpticalFlowPyrLK(one, here, there, None, winSize=(15, 15))[0]
        sure = np.linalg.norm(back - start, axis=2) < BACK
        found.append(np.where(sure, (there - start)[:, 0] / later, np.nan))
    frame = float(np.mean([abs(later) for _, later in others]))
    first, last = found[0], found[-1]
    velocities = np.where(np.isnan(first), last, np.where(np.isnan(last), first, (first + last) / 2))
    way, bend = (np.linalg.norm(one, axis=1) * frame for one in (velocities, first - last))
    kept = (way > SLOWEST) & ~(bend > way + 2)  # what turns back within a frame was not followed
    descriptors = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-9))  # Arandjelovic 2012
    return Moving(pixels[kept], velocities[kept], descriptors[kept])


def offsets_from_motion(watched: Mapping[str, Watched], search: float) -> dict[str, Seen]:
    """When each camera's clock began, after that of the first one.

    Args:
        watched: at least two calibrated cameras.
        search: largest difference that is looked for, seconds.
    """
    names = list(watched)
    # An offset cannot be known better than the slowest camera tells.
    frame = max(one.frame for one in watched.values())
    step = min(one.frame for one in watched.values()) / FINE
    pairs = combinations(names, 2)
    curves = {pair: curve_between(watched[pair[0]], watched[pair[1]], step, search) for pair in pairs}
    whole, *without = (
        {pair: np.maximum(curve.excess(which), 0) ** 2 for pair, curve in curves.items()} for which in range(1 + GROUPS)
    )
    offsets = _agreed(names, whole, _tree(names, whole))
    apart: dict[str, list[float]] = {name: [] for name in names}
    for scores in without:
        for name, offset in _agreed(names, scores, offsets).items():
            apart[name].append(offset)
    seen = {}
    for name in names:
        left_out = np.sqrt((GROUPS - 1) / GROUPS * np.square(np.array(apart[name]) - np.mean(apart[name])).sum())
        error = float(np.hypot(np.hypot(left_out, _disagreement(name, offsets, whole)) * step, LEAST_ERROR * frame))
        doubt = _doubt(name, offsets, curves, whole, frame / step)
        if not doubt and error > VAGUE * frame:
            doubt = f"its offset is uncertain by {error / frame:.1f} frames: too little moves in it"
        seen[name] = Seen(offsets[name] * step, error, doubt)
    return seen


def _lags(score: np.ndarray) -> np.ndarray:
    """Lags [L] of scores [L], in steps: the clock of the other camera began so much later."""
    return np.arange(len(score)) - len(score) // 2


def _tree(names: Sequence[str], scores: Scores) -> dict[str, float]:
    """A start: from the first camera on, each is hung to the one that it agrees with best."""
    offsets = {names[0]: 0.0}
    while len(offsets) < len(names):
        linking = {pair: score for pair, score in scores.items() if (pair[0] in offsets) != (pair[1] in offsets)}
        one, other = max(linking, key=lambda pair: float(linking[pair].max()))
        lag = float(_lags(linking[one, other])[linking[one, other].argmax()])
        offsets |= {other: offsets[one] + lag} if one in offsets else {one: offsets[other] - lag}
    return offsets


def _agreed(names: Sequence[str], scores: Scores, start: Mapping[str, float]) -> dict[str, float]:
    """Offsets, in steps, at which the sum of the scores of all pairs has its peak, from a start."""
    offsets = dict(start)
    for _ in range(20):
        before = dict(offsets)
        for name in names[1:]:
            offsets[name] = _summit(_alone(name, offsets, scores))
        if all(abs(offsets[name] - before[name]) < 0.01 for name in names):
            break
    return offsets


def _alone(name: str, offsets: Mapping[str, float], scores: Scores) -> np.ndarray:
    """The sum of the scores [L] of one camera, the others where they are, at each offset of its own."""
    total = np.zeros(len(next(iter(scores.values()))))
    for (one, other), score in scores.items():
        if name in (one, other):
            places = _lags(score)
            lags = places - offsets[one] if name == other else offsets[other] - places
            total += np.interp(lags, places, score, left=0, right=0)
    return total


def _summit(score: np.ndarray) -> float:
    """The lag of the peak, by a parabola over half a frame on each side."""
    top, lags = int(score.argmax()), _lags(score)
    near = slice(max(top - FINE // 2, 0), top + FINE // 2 + 1)
    bend, slope, _ = np.polyfit(lags[near] - lags[top], score[near], 2)
    shift = -slope / (2 * bend) if bend < 0 else 0.0
    return float(lags[top] + np.clip(shift, -FINE / 2, FINE / 2))


def _disagreement(name: str, offsets: Mapping[str, float], scores: Scores) -> float:
    """Standard error, in steps, by how far the pairs of a camera each have their peak from where all together do."""
    off, weights = [], []
    for (one, other), score in scores.items():
        lag = offsets[other] - offsets[one]
        near = np.where(np.abs(_lags(score) - lag) <= 2 * FINE, score, 0)
        if name in (one, other) and near.any():
            off.append(_summit(near) - lag)
            weights.append(float(near.max()))
    return float(np.sqrt(np.average(np.square(off), weights=weights) / (len(off) - 1))) if len(off) > 1 else 0.0


def _doubt(
    name: str, offsets: Mapping[str, float], curves: Mapping[tuple[str, str], Curve], scores: Scores, frame: float
) -> str:
    """Why a camera's offset cannot be trusted, or nothing; `frame` is in steps."""
    total = _alone(name, offsets, scores)
    top = int(np.abs(_lags(total) - offsets[name]).argmin())
    if total[top] < SURE**2:
        said = f"{np.sqrt(total[top]):.1f} standard deviations, {SURE:g} are asked"
        return f"what moves in it hardly agrees with the others ({said})"
    repeated = {}  # what the scores would be if as large a share of the matches agreed at all lags as does at the best
    for pair, score in scores.items():
        lag, lags, count = offsets[pair[1]] - offsets[pair[0]], _lags(score), curves[pair].could[0]
        repeated[pair] = np.interp(lag, lags, score) * count / max(np.interp(lag, lags, count), 1e-9)
    best, likely = np.sqrt(total), np.sqrt(_alone(name, offsets, repeated))
    rivals = _outside(total, top) & (best > RIVAL) & (best > likely - RIVAL)
    if rivals.any():
        apart = (int(np.where(rivals, total, 0).argmax()) - top) / frame
        return f"an offset that differs by {apart:+.1f} frames is as good (is the motion repeated?)"
    return ""


def _outside(total: np.ndarray, top: int) -> np.ndarray:
    """What is outside of the peak at `top` [L]: beyond where the curve has fallen and rises again."""
    outside = np.ones(len(total), bool)
    for way in (-1, 1):
        place, lowest = top, total[top]
        while 0 <= place < len(total) and not (total[place] > lowest and lowest < 0.7 * total[top]):
            lowest = min(lowest, total[place])
            outside[place] = False
            place += way
    return outside


def curve_between(one: Watched, other: Watched, step: float, search: float) -> Curve:
    """How many matches of two cameras agree at each lag.

    Each match tells of lags within a frame of how far its images are apart by their stamps, those next to that most.
    """
    frame, size = max(one.frame, other.frame), max(int(np.ceil(search / step)), FINE)
    lags = np.arange(-size, size + 1)
    apart, off, own, others, group = _matches(one, other, search + frame)
    slope = (others - own) / 2  # pixels per second by which it leaves its line where the other clock began later
    # What is one thing stays on its line from one instant to the next, so the two ends cross it alike.
    unlike = (others + own) / 2 * frame / (0.5 + np.abs(slope) * frame / 4)
    tells = (slope * frame) ** 2 / ((slope * frame) ** 2 + NEAR**2)
    agree, count = np.zeros((GROUPS, len(lags))), np.zeros((GROUPS, len(lags)))
    first = np.ceil((apart - frame) / step).astype(int)
    for k in range(int(2 * frame / step) + 1):
        place, later = first + k + size, (first + k) * step - apart
        inside = (place >= 0) & (place < len(lags))
        weight = np.maximum(1 - np.abs(later) / frame, 0) * tells
        alike = weight * np.exp(-0.5 * (((off - slope * later) / NEAR) ** 2 + unlike**2))
        np.add.at(agree, (group[inside], place[inside]), alike[inside])
        np.add.at(count, (group[inside], place[inside]), weight[inside])
    kept = np.concatenate([np.ones((1, GROUPS)), 1 - np.eye(GROUPS)])  # all, then without each group
    begun, ended = (other.times[place] + lags * step for place in (0, -1))
    common = np.minimum(one.times[-1], ended) - np.maximum(one.times[0], begun) > (LEAST_COMMON - 1.5) * frame
    curve = Curve(kept @ agree * common, kept @ count * common)
    excess = curve.excess(0)[curve.could[0] > 1]
    wide = 1.4826 * float(np.median(np.abs(excess - np.median(excess)))) if len(excess) else 1.0
    return curve._replace(spread=max(wide, 1.0))


def _matches(one: Watched, other: Watched, search: float) -> tuple[np.ndarray, ...]:
    """Of each match [n]: seconds between the stamps, pixels from its line, how fast each end leaves it, its group."""
    a, b = one.camera, other.camera
    own, others = ([place for place, found in enumerate(w.moving) if len(found.pixels)] for w in (one, other))
    found = [np.zeros((0, 9))]
    for i in spread(own, MOST_ANCHORS) if own else ():
        for j in others:
            here, there, apart = one.moving[i], other.moving[j], one.times[i] - other.times[j]
            alike = here.descriptors @ there.descriptors.T
            best = (alike == alike.max(axis=0)) | (alike == alike.max(axis=1, keepdims=True))
            k, m = np.nonzero(best & (alike > ALIKE) & (abs(apart) <= search))
            ends = here.pixels[k], here.velocities[k], there.pixels[m], there.velocities[m]
            found.append(np.column_stack([np.full(len(k), apart), *ends]))
    both = np.concatenate(found)
    p, v, q, w = (both[:, c : c + 2] for c in (1, 3, 5, 7))
    off, soon = sampson(a, b, p, q), max(one.frame, other.frame) / 4
    leaves = (sampson(a, b, p + v * soon, q) - off) / soon, (sampson(a, b, p, q + w * soon) - off) / soon
    cells = np.floor(p / (a.width, a.height) * GROUPS).astype(int)
    return both[:, 0], off, *leaves, (cells[:, 0] + 3 * cells[:, 1]) % GROUPS
