"""Known poses that are slightly wrong, mended by what the images share; kept as they are unless that is proven.

First one camera after another is turned where it stands: positions are rarely wrong, and three angles are settled by
few features. Then all poses are bundled. The proof is the same for both and twofold. Poses from one half of the image
must explain the matches of the other half better than the given poses do. And they must differ from the given ones by
more than the two halves' poses differ from each other. False matches agree within a half, but not across, so they pass
neither.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

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
from d2_plugin.recordings.cameras.epipolar import Matched, degrees_between, sampson, turned
from d2_plugin.recordings.recording import Camera, Recording
from d2_plugin.recordings.selection import spread
from d2_plugin.values import checked_arguments

MOMENTS = 6  # frames that are read, spread over the recording
TURNED = 0.15  # degrees by which a camera that is called wrong is turned: a quarter of a degree ruins stereo

VAGUE = 1.0  # degrees: a pose that is known no better is not held to be right

REACH = 0.04  # matches farther from where the given poses expect them are not believed, in diagonals of the image

SCHEDULE = ((20.0, 1.3), (10.0, 1.3), (2.5, 0.4), (1.3, 0.13))
"""Rounds of the adjustment: (largest error that counts, scale of the Cauchy loss), in `pixel_error`."""

FEWEST_POINTS = 20  # points per half, and `FEWEST_SEEN` of them per camera, below which nothing is concluded
FEWEST_SEEN = 8

FALLS_TO = 0.9  # the error of the other half falls at least to this part of what it was

BEYOND_DOUBT = 1.0
"""Poses turn or move by more than this many times what the two halves' poses differ by, which is about two standard
deviations of the result."""

CELLS = 8  # across and down an image; alternating ones are the two halves, as on a board for chess


class Turn(NamedTuple):
    """What the images say about the orientation of one camera, the others as they are."""

    degrees: float  # by which it should be turned where it stands
    doubt: float  # degrees that two halves of the images differ by about that: about two standard deviations
    pixels: float  # median distance of its matches from the epipolar lines of the given poses
    wrong: bool  # whether the turn is proven


@dataclass(frozen=True, eq=False)
class RefinedPoses:
    """What became of the poses of a rig. Pixels are root mean squares over matches the poses were not made from."""

    cameras: dict[str, Camera]  # with new poses where `accepted`, else as they were given
    accepted: bool
    reason: str  # why, in a sentence
    pixels_before: float | None
    pixels_after: float | None
    changes: dict[str, tuple[float, float]]
    """Camera -> (degrees, share of the rig's width) of the change that was proposed."""
    doubt: dict[str, tuple[float, float]]
    """Camera -> the same between the poses of the two halves, about two standard deviations."""
    points: int
    turns: dict[str, Turn] = field(default_factory=dict)


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
        name: of_a_still_camera([recording.image(name, frame) for frame in frames], recording.recorded(name), True)
        for name in names
    }
    return refine_poses({name: recording.cameras[name] for name in names}, features)


@checked_arguments
def check_poses(recording: Recording) -> dict[str, Turn]:
    """What all images say about the orientation of each camera; none where they share too little.

    Raises:
        D2Error: fewer than two cameras, or pycolmap or OpenCV is not installed.
    """
    given, frames = recording.cameras, recording.frames
    features = {name: of_a_still_camera([recording.image(name, frame) for frame in frames]) for name in given}
    return _turns(given, *_expected(given, features)[:2])[0]


def turns_in_words(turns: Mapping[str, Turn], cameras: Collection[str]) -> list[str]:
    """A sentence for each camera that is turned, then what is known of the others."""
    sentences = [
        f"camera {name} is turned by {turn.degrees:.2f} degrees (known within {turn.doubt:.2f}) and misses what others "
        f"see by {turn.pixels:.1f} pixels: give --refine-poses, or calibrate it again"
        for name, turn in turns.items()
        if turn.wrong
    ]
    known = {name: max(turn[:2]) for name, turn in turns.items() if not turn.wrong}
    listed = {
        name: f"{name} within {within:.2f} degrees ({turns[name].pixels:.1f} pixels)" for name, within in known.items()
    }
    held = ", ".join(listed[name] for name, within in known.items() if within <= VAGUE)
    vague = ", ".join(listed[name] for name, within in known.items() if within > VAGUE)
    alone = ", ".join(name for name in cameras if name not in turns)
    sentences += [f"poses hold as far as features tell: {held}"] if held else []
    sentences += [f"poses that features hardly tell anything of: {vague}"] if vague else []
    return sentences + ([f"poses not checked: {alone}, too few shared features"] if alone else [])


def _expected(
    given: Mapping[str, Camera], features: Mapping[str, Features]
) -> tuple[dict[str, Features], Matches, Tracks]:
    """(features in better places, matches near where the given poses expect them, their tracks)."""
    diagonal = max(float(np.hypot(camera.width, camera.height)) for camera in given.values())
    matches = verified(match_all(features), features, given, REACH * diagonal)
    better, tracks = sharpened(features, join_matches(matches, tuple(given)), given)
    return better, matches, tracks


def _turns(
    given: Mapping[str, Camera], features: Mapping[str, Features], matches: Matches
) -> tuple[dict[str, Turn], dict[str, Camera]]:
    """(what is said about each camera with matches, the cameras with the proven turns), the worst camera first."""
    cameras = dict(given)
    turns: dict[str, Turn] = {}
    halves = [halved(matches, features, given, which) for which in (0, 1)]
    while True:
        tried = {}
        for name in {name: None for pair in matches for name in pair if name not in turns}:
            trials = [turned(name, cameras, _places(half, features)) for half in (*halves, matches)]
            own = [_matches_of(name, half) for half in halves]
            before = [_squares(cameras, half, features) for half in own]
            after = [_squares({**cameras, name: trials[1 - i]}, half, features) for i, half in enumerate(own)]
            falls = all(new.sum() < FALLS_TO**2 * old.sum() for new, old in zip(after, before, strict=True))
            degrees, doubt = degrees_between(trials[2], cameras[name]), degrees_between(*trials[:2])
            wrong = falls and degrees > max(TURNED, BEYOND_DOUBT * doubt)
            change = sum(float(new.sum() - old.sum()) for new, old in zip(after, before, strict=True))
            tried[name] = change, trials[2], Turn(degrees, doubt, _misses(name, given, matches, features), wrong)
        proven = [name for name, (_, _, turn) in tried.items() if turn.wrong]
        if not proven:
            return {**turns, **{name: turn for name, (_, _, turn) in tried.items()}}, cameras
        best = min(proven, key=lambda name: tried[name][0])
        _, cameras[best], turns[best] = tried[best]


def _places(matches: Matches, features: Mapping[str, Features]) -> Matched:
    return {
        (a, b): (features[a].pixels[pairs[:, 0]], features[b].pixels[pairs[:, 1]])
        for (a, b), pairs in matches.items()
        if len(pairs)
    }


def _matches_of(name: str, matches: Matches) -> Matches:
    """The matches of one camera: what pairs of others miss would hide what it does."""
    return {pair: pairs for pair, pairs in matches.items() if name in pair}


def _misses(name: str, cameras: Mapping[str, Camera], matches: Matches, features: Mapping[str, Features]) -> float:
    own = _places(_matches_of(name, matches), features)
    missed = np.concatenate([sampson(cameras[a], cameras[b], *ends) for (a, b), ends in own.items()])
    return float(np.median(np.abs(missed)))


def refine_poses(given: Mapping[str, Camera], features: Mapping[str, Features]) -> RefinedPoses:
    """`refine` for features that are there already."""
    features, matches, whole = _expected(given, features)
    turns, cameras = _turns(given, features, matches)
    bundle = _bundled_poses(cameras, features, matches, whole)
    wrong = {name: turn for name, turn in turns.items() if turn.wrong}
    if not wrong:
        return replace(bundle, turns=turns)
    listed = ", ".join(
        f"{name} by {turn.degrees:.2g} degrees (within {turn.doubt:.2g})" for name, turn in wrong.items()
    )
    before, after = (_rms(rig, matches, features) for rig in (given, bundle.cameras))
    then = f", then {bundle.reason}" if bundle.accepted else ""
    reason = f"poses refined: turned camera {listed}; the error fell from {before:.2f} to {after:.2f} pixels{then}"
    doubt = bundle.doubt or {name: (turns[name].doubt, 0.0) if name in turns else (0.0, 0.0) for name in given}
    return RefinedPoses(
        bundle.cameras, True, reason, before, after, differences(bundle.cameras, given), doubt, bundle.points, turns
    )


def _bundled_poses(
    given: Mapping[str, Camera], features: Mapping[str, Features], matches: Matches, tracks_of_all: Tracks
) -> RefinedPoses:
    halves = [halved(matches, features, given, which) for which in (0, 1)]
    tracks = [join_matches(half, tuple(given)) for half in halves]
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
    return np.asarray(cells.sum(axis=1) % 2)


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
    squares = _squares(cameras, matches, features)
    return float(np.sqrt(squares.mean())) if len(squares) else 0.0


def _squares(cameras: Mapping[str, Camera], matches: Matches, features: Mapping[str, Features]) -> np.ndarray:
    """Squares [n] of Sampson's distance, where a match counts for no more than twice `pixel_error`."""
    squares = [np.zeros(0)]
    for (a, b), ends in _places(matches, features).items():
        squares.append(np.minimum(np.abs(sampson(cameras[a], cameras[b], *ends)), 2 * pixel_error(cameras[a])) ** 2)
    return np.concatenate(squares)


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
    return RefinedPoses(laid if accepted else dict(given), accepted, reason, *pixels, changes, doubt, len(whole.points))


def _mean_square(changes: Mapping[str, tuple[float, float]]) -> np.ndarray:
    """Of the degrees and of the shares, [2]."""
    return np.asarray(np.square(list(changes.values())).mean(axis=0))


def _kept(given: Mapping[str, Camera], reason: str) -> RefinedPoses:
    return RefinedPoses(dict(given), False, reason, None, None, {}, {}, 0)
