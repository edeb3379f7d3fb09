"""When cameras started, from what they saw move: change over time, plane by plane through the cameras' baseline.

A point that moves lies, in both images of a pair of cameras, in the same half-plane through the line that joins them,
however far away it is. So the change of brightness from one frame to the next is added up per half-plane: two profiles
over angle and time, which are alike once they are laid over each other at the right lag. Their correlation over the
lag, summed over all pairs, has its peak where the clocks agree, and between frames too, since the profiles are
interpolated. Gains, turns and frame rates of the cameras do not matter, and each image is first given the brightness
of the median one, since a drift of the exposure is no motion.

The error is that of leaving out one group of half-planes after another (the jackknife of Quenouille and Tukey), and of
the disagreement of all pairs of cameras about the same offsets: where three contradict each other, it is no clock.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from d2_plugin.progress import progress_bar
from d2_plugin.recordings.cameras.camera import CalibratedCamera
from d2_plugin.recordings.cameras.undistort import Undistortion
from d2_plugin.recordings.importing.video import Decoder, VideoFile
from d2_plugin.recordings.recording import Camera

LONG_SIDE = 160  # pixels of the images that are compared
MOST_FRAMES = 900  # of each camera; they take 13 MB
FEWEST = 8  # frames that a camera must share with one of the others
ALIKE = 0.2  # mean correlation that the pairs of a camera must reach
RIVAL = 0.8  # another lag that is this good, outside of the peak, makes a camera's offset doubtful
VAGUE = 0.7  # frames of standard error from which motion says nothing
LEAST_ERROR = 0.25  # frames: cameras see other sides of what moves, which no half-plane of one sort tells apart
PLANES, GROUPS = 48, 8  # half-planes between the common limits of two images, and groups of neighbours among them
FINE = 8  # steps per frame in which lags are compared; between them lies a parabola
NOISE = (2.0, 3.0)  # change counts above this many times a pixel's usual change, and this many levels of 255 more
LEAST_COMMON = 5  # frames that two cameras must share at a lag


class Watched(NamedTuple):
    """Small images of a camera that stands still."""

    camera: Camera  # the pinhole of the small images
    images: np.ndarray  # [T, h, w] uint8, brightness
    times: np.ndarray  # [T] seconds on the clock of the video


class Curve(NamedTuple):
    """How well two cameras agree at each lag."""

    lags: np.ndarray  # [L] in steps: the clock of the other began so much later
    correlation: np.ndarray  # [1 + GROUPS, L] of all half-planes, then without each group; 0 at too few frames
    common: np.ndarray  # [L] frames


class Seen(NamedTuple):
    """What motion says about one camera."""

    seconds: float  # when its clock began, after that of the first camera
    error: float  # standard error, seconds
    doubt: str  # why it cannot be trusted; empty where it can


Scores = Mapping[tuple[str, str], tuple[np.ndarray, np.ndarray]]  # cameras -> (lags [L], how well they agree there [L])


def small_images(videos: Mapping[str, VideoFile], cameras: Mapping[str, CalibratedCamera]) -> dict[str, Watched]:
    """Small undistorted images of all cameras, from the beginning."""
    watched = {}
    with progress_bar("decode for motion", sum(min(len(v.stamps), MOST_FRAMES) for v in videos.values())) as bar:
        done = 0
        for name, video in videos.items():
            decoder, count = Decoder(video), min(len(video.stamps), MOST_FRAMES)
            images = []
            for index in range(count):
                images.append(decoder.grey(index, LONG_SIDE))
                bar.update(done := done + 1, name)
            decoder.close()
            undistortion = Undistortion(cameras[name].of_size(images[0].shape[::-1]))
            straight = np.stack([undistortion.image(image) for image in images])
            watched[name] = Watched(undistortion.camera, straight, video.times[:count])
    return watched


def offsets_from_motion(watched: Mapping[str, Watched], search: float) -> dict[str, Seen]:
    """When each camera's clock began, after that of the first one.

    Args:
        watched: at least two calibrated cameras.
        search: largest difference that is looked for, seconds.
    """
    names = list(watched)
    # An offset cannot be known better than the slowest camera tells.
    frame = max(float(np.median(np.diff(one.times))) for one in watched.values())
    step = float(np.median(np.concatenate([np.diff(one.times) for one in watched.values()]))) / FINE
    changes = {name: changes_of(one) for name, one in watched.items()}
    curves = {}
    for one, other in combinations(names, 2):
        pair = curve_between(watched[one], watched[other], changes[one], changes[other], step, search)
        if pair is not None:
            curves[one, other] = pair
    whole, *without = (_scores(curves, which) for which in range(1 + GROUPS))
    offsets = _agreed(names, whole, _tree(names, whole))
    apart: dict[str, list[float]] = {name: [] for name in names}
    for scores in without:
        for name, offset in _agreed(names, scores, offsets).items():
            apart[name].append(offset)
    seen = {}
    for name in names:
        left_out = np.sqrt((GROUPS - 1) / GROUPS * np.square(np.array(apart[name]) - np.mean(apart[name])).sum())
        error = float(np.hypot(np.hypot(left_out, _disagreement(name, offsets, whole)) * step, LEAST_ERROR * frame))
        doubt = _doubt(name, offsets, curves, whole)
        if not doubt and error > VAGUE * frame:
            doubt = f"its offset is uncertain by {error / frame:.1f} frames: too little moves in it"
        seen[name] = Seen(offsets[name] * step, error, doubt)
    return seen


def _scores(curves: Mapping[tuple[str, str], Curve], which: int) -> Scores:
    """Fisher's z of the correlations times the root of the common frames: a chance peak counts less."""
    return {
        pair: (curve.lags, np.arctanh(np.clip(curve.correlation[which], -0.999, 0.999)) * np.sqrt(curve.common))
        for pair, curve in curves.items()
    }


def _tree(names: Sequence[str], scores: Scores) -> dict[str, float]:
    """A start: from the first camera on, each is hung to the one that it agrees with best."""
    offsets = {names[0]: 0.0}
    while len(offsets) < len(names):
        best = None
        for (one, other), (lags, score) in scores.items():
            if (one in offsets) != (other in offsets) and len(lags) and (best is None or score.max() > best[0]):
                lag = float(lags[score.argmax()])
                new = (other, offsets[one] + lag) if one in offsets else (one, offsets[other] - lag)
                best = (score.max(), *new)
        if best is None:
            return offsets | {name: 0.0 for name in names if name not in offsets}
        offsets[best[1]] = best[2]
    return offsets


def _agreed(names: Sequence[str], scores: Scores, start: Mapping[str, float]) -> dict[str, float]:
    """Offsets, in steps, at which the sum of the scores of all pairs has its peak, from a start."""
    offsets = dict(start)
    for _ in range(20):
        before = dict(offsets)
        for name in names[1:]:
            lags, total = _alone(name, offsets, scores)
            if len(lags):
                offsets[name] = _summit(lags, total)
        if all(abs(offsets[name] - before[name]) < 0.01 for name in names):
            break
    return offsets


def _alone(name: str, offsets: Mapping[str, float], scores: Scores) -> tuple[np.ndarray, np.ndarray]:
    """(offsets of one camera, sum of its scores there) with the other cameras where they are."""
    curves = []
    for (one, other), (lags, score) in scores.items():
        if name == other:
            curves.append((lags + offsets[one], score))
        elif name == one:
            curves.append((offsets[other] - lags[::-1], score[::-1]))
    if not curves:
        return np.zeros(0), np.zeros(0)
    places = np.arange(min(lags[0] for lags, _ in curves), max(lags[-1] for lags, _ in curves) + 0.5)
    return places, np.sum([np.interp(places, lags, score, left=0, right=0) for lags, score in curves], axis=0)


def _summit(places: np.ndarray, total: np.ndarray) -> float:
    """The place of the peak, by a parabola over half a frame."""
    top = int(total.argmax())
    low, high = max(top - FINE // 2, 0), min(top + FINE // 2, len(places) - 1)
    if high - low < 2:
        return float(places[top])
    bend, slope, _ = np.polyfit(places[low : high + 1] - places[top], total[low : high + 1], 2)
    shift = -slope / (2 * bend) if bend < 0 else 0.0
    return float(places[top] + np.clip(shift, -FINE / 2, FINE / 2))


def _disagreement(name: str, offsets: Mapping[str, float], scores: Scores) -> float:
    """Standard error, in steps, by how far the pairs of a camera each have their peak from where all together do."""
    off, weights = [], []
    for pair, (lags, score) in scores.items():
        lag = offsets[pair[1]] - offsets[pair[0]]
        near = np.abs(lags - lag) <= 2 * FINE
        if name in pair and near.any() and score[near].max() > 0:
            off.append(_summit(lags[near], score[near]) - lag)
            weights.append(float(score[near].max()))
    if len(off) < 2:
        return 0.0
    return float(np.sqrt(np.average(np.square(off), weights=weights) / (len(off) - 1)))


def _doubt(name: str, offsets: Mapping[str, float], curves: Mapping[tuple[str, str], Curve], scores: Scores) -> str:
    """Why a camera's offset cannot be trusted, or nothing."""
    own = {pair: curve for pair, curve in curves.items() if name in pair}
    places, total = _alone(name, offsets, scores)
    if not own or not len(places):
        return "it shares no view with another camera"
    lags = {pair: offsets[pair[1]] - offsets[pair[0]] for pair in own}
    shared = max(float(np.interp(lags[pair], curve.lags, curve.common)) for pair, curve in own.items())
    alike = float(np.mean([np.interp(lags[pair], curve.lags, curve.correlation[0]) for pair, curve in own.items()]))
    if shared < FEWEST:
        return f"it shares {shared:.0f} frames with the others, fewer than {FEWEST}"
    if alike < ALIKE:
        return f"what moves in it does not move in the others (correlation {alike:.2f})"
    top = int(np.abs(places - offsets[name]).argmin())
    rival = _rival(total, top)
    if rival is not None and total[rival] > RIVAL * total[top]:
        frames = (places[rival] - places[top]) / FINE
        return f"an offset that differs by {frames:+.1f} frames is as good (is the motion repeated?)"
    return ""


def _rival(total: np.ndarray, top: int) -> int | None:
    """The best place outside of the peak at `top`: beyond where the curve has fallen to half and rises again."""
    outside = np.ones(len(total), bool)
    for way in (-1, 1):
        place, lowest = top, total[top]
        while 0 <= place < len(total) and not (total[place] > lowest and lowest < 0.7 * total[top]):
            lowest = min(lowest, total[place])
            outside[place] = False
            place += way
    return int(np.where(outside, total, -np.inf).argmax()) if outside.any() else None


def changes_of(one: Watched) -> tuple[np.ndarray, np.ndarray]:
    """(change per second [T - 1, h, w] beyond what is usual for the pixel, the instants [T - 1] in the middle)."""
    steps = np.diff(one.times)
    still = np.median(one.images, axis=0) + 1
    gains = np.median((one.images + 1.0) / still, axis=(1, 2), keepdims=True)
    change = np.abs(np.diff(one.images / gains, axis=0)).astype(np.float32)
    usual = np.median(change, axis=0)
    change = np.maximum(change - NOISE[0] * usual - NOISE[1], 0) * (np.median(steps) / steps)[:, None, None]
    return change.astype(np.float32), (one.times[1:] + one.times[:-1]) / 2


def curve_between(
    one: Watched, other: Watched, changes: tuple, other_changes: tuple, step: float, search: float
) -> Curve | None:
    """The agreement of two cameras over the lag; None where no half-plane is in both images."""
    angles = _angles(one.camera, other.camera)
    if not all(np.isfinite(angle).any() for angle in angles):  # cameras at one place: no line joins them
        return None
    low, high = (
        pick(float(np.nanquantile(angle, share)) for angle in angles) for pick, share in ((max, 0.01), (min, 0.99))
    )
    if not high > low:
        return None
    profiles = [
        _resampled(_profile(change, angle, low, high), times, step)
        for (change, times), angle in zip((changes, other_changes), angles)
    ]
    starts = (float(changes[1][0]), float(other_changes[1][0]))
    return _correlated(profiles[0], profiles[1], starts, step, search)


def _angles(one: Camera, other: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Angle [h, w] of each pixel's half-plane around the line that joins the cameras; NaN next to that line."""
    axis = other.centre - one.centre
    axis /= np.linalg.norm(axis) + 1e-300
    ahead = one.T_camera_world[2, :3] + other.T_camera_world[2, :3]
    ahead = ahead - axis * (axis @ ahead)
    if np.linalg.norm(ahead) < 1e-6:  # the cameras look at each other: any direction across the line will do
        ahead = np.cross(axis, one.T_camera_world[0, :3])
    ahead /= np.linalg.norm(ahead)
    across = np.cross(axis, ahead)

    def of(camera: Camera) -> np.ndarray:
        x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(camera.K).T @ camera.T_camera_world[:3, :3]
        off = np.hypot(rays @ ahead, rays @ across) / np.linalg.norm(rays, axis=-1)
        return np.where(off > 0.1, np.arctan2(rays @ across, rays @ ahead), np.nan)

    return of(one), of(other)


def _profile(change: np.ndarray, angles: np.ndarray, low: float, high: float) -> np.ndarray:
    """Mean change [T, PLANES] of the pixels of each half-plane."""
    with np.errstate(invalid="ignore"):
        place = np.floor((angles - low) / (high - low) * PLANES)
        inside = (place >= 0) & (place < PLANES)
    places = place[inside].astype(int)
    pixels = np.maximum(np.bincount(places, minlength=PLANES), 1)
    rows = change[:, inside]
    return np.stack([np.bincount(places, row, minlength=PLANES) for row in rows]) / pixels


def _resampled(profile: np.ndarray, times: np.ndarray, step: float) -> np.ndarray:
    """The profile [N, PLANES] every `step` seconds from its first instant on, linear between."""
    wanted = np.arange(times[0], times[-1] + step / 2, step)
    after = np.clip(np.searchsorted(times, wanted), 1, len(times) - 1)
    share = ((wanted - times[after - 1]) / (times[after] - times[after - 1])).clip(0, 1)[:, None]
    return profile[after - 1] * (1 - share) + profile[after] * share


def _correlated(one: np.ndarray, other: np.ndarray, starts: tuple[float, float], step: float, search: float) -> Curve:
    """The correlation over the common time at every lag, about the means of that time."""
    a, b = len(one), len(other)
    shifts = np.arange(-(b - 1), a)  # sample i + shift of `one` meets sample i of `other`
    begin, end = np.maximum(shifts, 0), np.minimum(a, b + shifts)
    count = end - begin
    size = 1 << int(np.ceil(np.log2(a + b)))
    spectra = np.fft.rfft(one, size, axis=0) * np.conj(np.fft.rfft(other, size, axis=0))
    product = np.fft.irfft(spectra, size, axis=0)[shifts % size]
    sums, squares = zip(*(_running(one, begin, end), _running(other, begin - shifts, end - shifts)))
    group = np.arange(PLANES) * GROUPS // PLANES
    kept = np.concatenate([np.ones((1, PLANES)), group != np.arange(GROUPS)[:, None]])  # all, then without each group
    product = kept @ (product - sums[0] * sums[1] / count[:, None]).T
    spreads = [kept @ (square - total**2 / count[:, None]).T for square, total in zip(squares, sums)]
    size = np.sqrt((spreads[0] * spreads[1]).clip(0))
    known = (count >= LEAST_COMMON * FINE) & (size > 1e-9)
    correlation = np.where(known, product / np.where(known, size, 1), 0.0)
    lags = shifts + (starts[0] - starts[1]) / step
    near = np.abs(lags) <= search / step + 1
    return Curve(lags[near], correlation[:, near], count[near] / FINE)


def _running(values: np.ndarray, begin: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sums of the values, and of their squares, from `begin` to `end`."""
    both = []
    for power in (values, values**2):
        total = np.vstack([np.zeros((1, power.shape[1])), np.cumsum(power, axis=0)])
        both.append(total[end] - total[begin])
    return both[0], both[1]
