"""Known poses that are slightly wrong, mended by what the images share; kept as they are unless that is proven.

The proof is twofold. Poses from one half of the image must explain the matches of the other half better than the
given poses do. And they must differ from the given ones by more than the two halves' poses differ from each
other. False matches agree within a half, but not across, so they pass neither.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.recordings.cameras.calibrating.bundle import Bundle, Tracks, adjust, fitting, join_matches, triangulate
from d2_plugin.recordings.cameras.calibrating.features import (
    Features,
    Matches,
    match_all,
    of_a_still_camera,
    pixel_error,
    verified,
)
from d2_plugin.recordings.cameras.calibrating.rig import aligned, differences
from d2_plugin.recordings.cameras.calibrating.sharpen import sharpened
from d2_plugin.recordings.cameras.epipolar import sampson
from d2_plugin.recordings.recording import Camera, Recording
from d2_plugin.recordings.selection import spread
from d2_plugin.values import checked_arguments

MOMENTS = 6  # frames that are read, spread over the recording
REACH = 0.04  # matches farther from where the given poses expect them are not believed, in diagonals of the image

SCHEDULE = ((20.0, 1.3), (10.0, 1.3), (2.5, 0.4), (1.3, 0.13))
"""Rounds of the adjustment: (largest error that counts, scale of the Cauchy loss), in `pixel_error`."""

FEWEST_POINTS = 20  # points per half, and `FEWEST_SEEN` of them per camera, below which nothing is concluded
FEWEST_SEEN = 8

FALLS_TO = 0.9  # the error of the other half falls at least to this part of what it was

BEYOND_DOUBT = 1.0
"""The poses turn or move by more than this many times what the two halves' poses differ by, which is about two
standard deviations of the result."""

CELLS = 8  # across and down an image; alternating ones are the two halves, as on a board for chess


@dataclass(frozen=True, eq=False)
class RefinedPoses:
    """What became of the poses of a rig. Pixels are root mean squares over matches the poses were not made from."""

    cameras: dict[str, Camera]
    """With new poses where `accepted`, else as they were given."""
    accepted: bool
    reason: str
    """Why, in a sentence."""
    pixels_before: float | None
    pixels_after: float | None
    changes: dict[str, tuple[float, float]]
    """Camera -> (degrees, share of the rig's width) of the change that was proposed."""
    doubt: dict[str, tuple[float, float]]
    """Camera -> the same between the poses of the two halves."""
    points: int

    def applied(self, recording: Recording) -> Recording:
        """The recording with these poses and a note; the same recording where they were not accepted."""
        if not self.accepted:
            return recording
        return replace(recording, cameras={**recording.cameras, **self.cameras}, notes=(*recording.notes, self.reason))


@checked_arguments
def refine(recording: Recording, cameras: Sequence[str] | None = None, moments: int = MOMENTS) -> RefinedPoses:
    """Bundle the poses of the named cameras (the training ones) over several frames; intrinsics stay.

    The rig as a whole stays where it was: the result is laid over the given poses, so other cameras and the unit of
    the world keep their meaning. Cameras must be synchronised.

    Raises:
        D2Error: fewer than two cameras, or pycolmap or OpenCV is not installed.
    """
    names = list(recording.cameras if cameras is None else cameras)
    if len(names) < 2:
        raise D2Error(f"poses are refined between cameras, and {recording.name} has {len(names)} to train: name two")
    frames = spread(recording.frames, moments)
    features = {
        name: of_a_still_camera([recording.image(name, frame) for frame in frames], recording.recorded(name))
        for name in names
    }
    return refine_poses({name: recording.cameras[name] for name in names}, features)


def refine_poses(given: Mapping[str, Camera], features: Mapping[str, Features]) -> RefinedPoses:
    """`refine` for features that are there already."""
    diagonal = max(float(np.hypot(camera.width, camera.height)) for camera in given.values())
    matches = verified(match_all(features), features, given, REACH * diagonal)
    names = tuple(given)
    features, tracks_of_all = sharpened(features, join_matches(matches, names), given)
    halves = [halved(matches, features, given, which) for which in (0, 1)]
    tracks = [join_matches(half, names) for half in halves]
    why = _undetermined(given, tracks)
    if why:
        return _kept(given, why)
    whole = bundled(given, features, tracks_of_all)
    parts = [bundled(given, features, half) for half in tracks]
    if whole is None or parts[0] is None or parts[1] is None:
        return _kept(given, "the poses stay: the points that the cameras share do not hold them")
    # Each half judges the poses of the other.
    before = _rms(given, halves[0], features), _rms(given, halves[1], features)
    after = _rms(parts[1].cameras, halves[0], features), _rms(parts[0].cameras, halves[1], features)
    return _judged(given, whole, differences(parts[0].cameras, parts[1].cameras), before, after)


def bundled(
    given: Mapping[str, Camera],
    features: Mapping[str, Features],
    tracks: Tracks,
    schedule: Sequence[tuple[float, float]] = SCHEDULE,
    focal: str | None = None,
) -> Bundle | None:
    """The bundle that starts at `given`; None where a camera is left without points. `focal` as `adjust` has it."""
    cameras = dict(given)
    bundle = None
    for limit, scale in schedule:
        bundle = fitting(triangulate(cameras, features, tracks), features, limit)
        if min(bundle.tracks.counts(given), default=0) < FEWEST_SEEN:
            return None
        bundle = adjust(bundle, features, scale * min(pixel_error(camera) for camera in given.values()), focal)
        cameras = bundle.cameras
    return bundle


def halved(matches: Matches, features: Mapping[str, Features], given: Mapping[str, Camera], which: int) -> Matches:
    """The matches whose place in the first of all cameras that sees them lies in one half of the cells."""
    return {
        (a, b): pairs[half_of(features[a].pixels[pairs[:, 0]], given[a]) == which] for (a, b), pairs in matches.items()
    }


def half_of(pixels: np.ndarray, camera: Camera) -> np.ndarray:
    """In which half of the cells of an image pixels [n, 2] lie, 0 or 1 [n]."""
    cells = np.floor(pixels / (camera.width, camera.height) * CELLS).astype(int)
    half: np.ndarray = cells.sum(axis=1) % 2
    return half


def _undetermined(given: Mapping[str, Camera], tracks: Sequence[Tracks]) -> str:
    """Why the matches cannot settle the poses, or nothing."""
    fewest = min(len(half.seen) for half in tracks)
    counts = np.min([half.counts(given) for half in tracks], axis=0)
    lonely = [name for name, count in zip(given, counts, strict=True) if count < FEWEST_SEEN]
    if fewest >= FEWEST_POINTS and not lonely:
        return ""
    whose = f"camera {', '.join(lonely)} shares" if lonely else "the cameras share"
    return f"the poses stay: {whose} too few features with the others to judge them"


def _rms(cameras: Mapping[str, Camera], matches: Matches, features: Mapping[str, Features]) -> float:
    """Root mean square of Sampson's distance, pixels, where a match counts for no more than twice `pixel_error`."""
    squares = [np.zeros(0)]
    for (a, b), pairs in matches.items():
        p, q = features[a].pixels[pairs[:, 0]], features[b].pixels[pairs[:, 1]]
        squares.append(np.minimum(sampson(cameras[a], cameras[b], p, q), 2 * pixel_error(cameras[a])) ** 2)
    return float(np.sqrt(np.concatenate(squares).mean()))


def _judged(
    given: Mapping[str, Camera],
    whole: Bundle,
    doubt: dict[str, tuple[float, float]],
    before: tuple[float, float],
    after: tuple[float, float],
) -> RefinedPoses:
    laid = aligned(whole.cameras, given)
    changes = differences(laid, given)
    larger = _mean_square(changes) > BEYOND_DOUBT**2 * _mean_square(doubt)
    falls = all(new < FALLS_TO * old for new, old in zip(after, before, strict=True))
    pixels = float(np.sqrt(np.mean(np.square(before)))), float(np.sqrt(np.mean(np.square(after))))
    change = f"from {pixels[0]:.2f} to {pixels[1]:.2f} pixels"
    degrees, share = (max(one[i] for one in changes.values()) for i in (0, 1))
    if falls and bool(larger.any()):
        reason = f"poses refined: the error fell {change}, by up to {degrees:.2g} degrees and {share:.2%} of the rig"
    elif not falls:
        reason = f"the poses stay: others would change the error {change}, which is no clear fall"
    else:
        reason = f"the poses stay: two halves of the images differ about them by as much as they would change, {change}"
    accepted = falls and bool(larger.any())
    cameras = laid if accepted else dict(given)
    return RefinedPoses(cameras, accepted, reason, *pixels, changes, doubt, len(whole.points))


def _mean_square(changes: Mapping[str, tuple[float, float]]) -> np.ndarray:
    """Of the degrees and of the shares, [2]."""
    mean: np.ndarray = np.square(list(changes.values())).mean(axis=0)
    return mean


def _kept(given: Mapping[str, Camera], reason: str) -> RefinedPoses:
    return RefinedPoses(dict(given), False, reason, None, None, {}, {}, 0)
