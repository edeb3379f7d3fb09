"""The poses of a rig from its images alone: never one that the images do not settle.

Pairs of cameras give essential matrices, the best pair a start, and the other cameras are added one by one, each time
with a bundle adjustment. Features are then moved to where their surroundings match best, and the images are cut into
two halves that must find the same rig by themselves. Each camera has one pose, over all moments and stills. The scale
is arbitrary until a board or a distance says it. A focal length that is not known is looked for where most matches
agree with one motion, and bundled with the poses.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from operator import le

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.recordings.cameras.calibrating.boards import Board, board_matches, how_often, seen_corners
from d2_plugin.recordings.cameras.calibrating.bundle import Bundle, Tracks, fitting, join_matches, project, triangulate
from d2_plugin.recordings.cameras.calibrating.features import (
    Features,
    Matches,
    Pair,
    as_colmap,
    essential_pose,
    find_features,
    match_all,
    of_a_still_camera,
    pixel_error,
    silent_pycolmap,
    verified,
)
from d2_plugin.recordings.cameras.calibrating.refine import SCHEDULE, bundled, half_of, halved
from d2_plugin.recordings.cameras.calibrating.rig import SolvedRig, differences
from d2_plugin.recordings.cameras.calibrating.sharpen import sharpened
from d2_plugin.recordings.cameras.camera import pinhole, rigid
from d2_plugin.recordings.cameras.epipolar import degrees_between
from d2_plugin.recordings.images import checked_image
from d2_plugin.recordings.recording import Camera
from d2_plugin.values import checked_arguments

FINE = (*SCHEDULE, (1.0, 0.1), (0.5, 0.05))  # rounds of the adjustment for features that were moved to better places

LARGEST_DOUBT = (0.2, 0.006)
"""Degrees, and share of the rig's width, that two halves of the images may differ by about a camera."""

LARGEST_FOCAL_DOUBT = 0.03  # share that they may differ by about a focal length

FOCALS = np.geomspace(0.45, 2.4, 9)
"""Focal lengths that are tried where none is known, in longer sides of the image: 96 to 24 degrees across."""
ALIKE = 0.98  # a length that explains this share of the most matches that any explains is tried as well

STARTS = 2  # pairs of cameras that are tried as a start, the most promising first
FEWEST_SEEN = 12  # points that settle a camera, at least, and as a share of those it should see
LEAST_SHARE = 0.25

GROWING = ((8.0, 1.3), (4.0, 0.4))  # rounds of the adjustment while cameras are added, as `refine.SCHEDULE`

ADD = (
    "add stills on the way between the cameras (at most 20 degrees apart), bring neighbouring cameras closer together, "
    "or video a board that they see at the same moment"
)


@checked_arguments
def solve_rig(
    images: Mapping[str, Sequence[np.ndarray]],
    intrinsics: Mapping[str, Camera],
    stills: Mapping[str, np.ndarray] | None = None,
    board: Board | None = None,
    focal: str | None = None,
) -> SolvedRig:
    """The poses of cameras that stand still.

    Args:
        images: camera -> its images RGB uint8 [H, W, 3] at moments that are the same for all cameras, undistorted.
        intrinsics: camera -> its size and K, for the stills too; the poses in it are not used.
        stills: more images of the same scene, a camera each: they connect cameras that see too little in common.
        board: corners of this board, where cameras saw it at the same moment, are matches too.
        focal: "shared" or "each" where focal lengths are not known: those of `intrinsics` are not used then.

    Raises:
        D2Error: the images do not settle the pose of every camera; the sentence names those, and what to add.
    """
    unknown = [name for name in (*images, *(stills or {})) if name not in intrinsics]
    if unknown or not images:
        raise D2Error(f"no intrinsics for camera {unknown[0] if unknown else 'any'}: give size and K of every camera")
    features = {name: of_a_still_camera(_of_one_size(name, taken), tilted=True) for name, taken in images.items()}
    features |= {name: find_features([image], tilted=True) for name, image in (stills or {}).items()}
    if board is None:
        return solve_features(features, intrinsics, tuple(images), focal=focal)
    seen = seen_corners(images, board)
    features, corners = board_matches(features, seen, board)
    try:
        return solve_features(features, intrinsics, tuple(images), corners, focal)
    except D2Error as refused:
        raise D2Error(f"{refused}; {how_often(seen)}") from None


def solve_features(
    features: Mapping[str, Features],
    intrinsics: Mapping[str, Camera],
    wanted: Sequence[str],
    corners: Matches | None = None,
    focal: str | None = None,
) -> SolvedRig:
    """`solve_rig` for features that are there already.

    `wanted` are the cameras that must be settled, `corners` matches that are known beside those of descriptors.
    """
    given = {name: replace(intrinsics[name], T_camera_world=np.eye(4)) for name in features}
    matched = match_all(features)
    for pair, more in (corners or {}).items():
        matched[pair] = np.concatenate([matched[pair], more])
    for known in [given] if focal is None else _likely_focals(matched, features, given):
        matches = verified(matched, features, known)
        tracks = join_matches(matches, tuple(features))
        bundle = _grown(matches, tracks, features, known)
        unsettled = list(wanted) if bundle is None else [name for name in wanted if name not in bundle.cameras]
        if not unsettled:
            break
    if bundle is None or unsettled:
        known_of = "; ".join(_known_of(name, matches, features, known) for name in unsettled[:3])
        raise D2Error(f"the images do not settle where camera {', '.join(unsettled)} stands ({known_of}): {ADD}")
    features, tracks = sharpened(features, tracks.within(bundle.cameras), bundle.cameras)
    schedule = SCHEDULE if any(features[name].greys is None for name in tracks.names) else FINE
    bundle = bundled(bundle.cameras, features, tracks, schedule, focal) or bundle
    doubt, focals = _doubt(bundle, tracks, features, schedule, focal)
    _refuse_unsure(doubt, focals, wanted)
    return SolvedRig.of(bundle, features, doubt, focals, tuple(wanted))


def _known_of(name: str, matches: Matches, features: Mapping[str, Features], known: Mapping[str, Camera]) -> str:
    """What a camera that is not settled shares with another one, and what two halves of that disagree by."""
    pair = max((pair for pair in matches if name in pair), key=lambda pair: len(matches[pair]), default=None)
    if pair is None:
        return f"{name} shares nothing with the others"
    said = f"{name} shares {len(matches[pair])} features with {pair[pair[0] == name]}"
    halves = [halved(matches, features, known, which)[pair] for which in (0, 1)]
    one, other = (essential_pose(pair, half, features, known) for half in halves)
    if one is None or other is None:
        return f"{said}, too few for two halves"
    turn = degrees_between(*(replace(known[name], T_camera_world=pose) for pose in (one, other)))
    way = 2 * np.rad2deg(np.arcsin(np.clip(np.linalg.norm(one[:3, 3] - other[:3, 3]) / 2, 0, 1)))  # of unit vectors
    return f"{said}, two halves of which turn it {turn:.1f} degrees apart and place it {way:.1f} apart"


def _of_one_size(name: str, taken: Sequence[np.ndarray]) -> Sequence[np.ndarray]:
    shapes = {checked_image(image, f"an image of camera {name}").shape for image in taken}
    if len(shapes) != 1:
        raise D2Error(f"camera {name} has images of {len(shapes)} sizes, expected one: give images of one size")
    return taken


def _likely_focals(
    matches: Matches, features: Mapping[str, Features], known: Mapping[str, Camera]
) -> list[dict[str, Camera]]:
    """The cameras with each focal length, one for all, by which most matches agree on a motion, likeliest first."""

    def cameras(factor: float) -> dict[str, Camera]:
        lengths = {name: factor * max(camera.width, camera.height) for name, camera in known.items()}
        return {
            name: replace(camera, K=pinhole(lengths[name], lengths[name], camera.K[0, 2], camera.K[1, 2]))
            for name, camera in known.items()
        }

    def agreeing(factor: float) -> int:
        return sum(len(pairs) for pairs in verified(matches, features, cameras(factor)).values())

    agree = {factor: agreeing(factor) for factor in FOCALS.tolist()}
    likely = [factor for factor in agree if agree[factor] >= ALIKE * max(agree.values())]
    return [cameras(factor) for factor in sorted(likely, key=lambda factor: (-agree[factor], abs(np.log(factor))))]


def _grown(
    matches: Matches, tracks: Tracks, features: Mapping[str, Features], known: Mapping[str, Camera]
) -> Bundle | None:
    """The bundle with the most cameras, then the most observations; None where no two cameras make a start."""
    bundles = [_grow(pair, matches, tracks, features, known) for pair in _starts(matches, features, known)]
    made = [bundle for bundle in bundles if bundle is not None]
    return max(made, key=lambda one: (len(one.cameras), int((one.tracks.seen >= 0).sum())), default=None)


def _starts(matches: Matches, features: Mapping[str, Features], known: Mapping[str, Camera]) -> list[Pair]:
    """The pairs with the most points at a good angle, best first."""
    worth = {}
    for (a, b), pairs in matches.items():
        rig = _pair_rig((a, b), pairs, features, known)
        if rig is not None:
            worth[a, b] = len(triangulate(rig, features, join_matches({(a, b): pairs}, (a, b))).points)
    return sorted(worth, key=lambda pair: -worth[pair])[:STARTS]


def _pair_rig(
    pair: Pair, pairs: np.ndarray, features: Mapping[str, Features], known: Mapping[str, Camera]
) -> dict[str, Camera] | None:
    """Two cameras, a unit apart, by their essential matrix."""
    pose = essential_pose(pair, pairs, features, known)
    if pose is None:
        return None
    return {pair[0]: known[pair[0]], pair[1]: replace(known[pair[1]], T_camera_world=pose)}


def _grow(
    start: Pair, matches: Matches, tracks: Tracks, features: Mapping[str, Features], known: Mapping[str, Camera]
) -> Bundle | None:
    """A bundle from two cameras on, with all the cameras that can be added."""
    rig = _pair_rig(start, matches[start], features, known)
    bundle = None if rig is None else bundled(rig, features, tracks, GROWING)
    while bundle is not None:
        added = _add(bundle, tracks, features, known)
        larger = None if added is None else bundled({**bundle.cameras, added.name: added}, features, tracks, GROWING)
        if larger is None:
            return bundle
        bundle = larger
    return None


def _add(
    bundle: Bundle, tracks: Tracks, features: Mapping[str, Features], known: Mapping[str, Camera]
) -> Camera | None:
    """The camera that sees the most points of the bundle, where they settle its pose."""
    points = fitting(triangulate(bundle.cameras, features, tracks), features, GROWING[-1][0])
    place = {key: i for i, row in enumerate(points.tracks.seen) for key in _keys(row, tracks.names, bundle.cameras)}
    seen: dict[str, list[tuple[int, int]]] = {}
    for row in tracks.seen:
        of = next((place[key] for key in _keys(row, tracks.names, bundle.cameras) if key in place), None)
        for name, index in zip(tracks.names, row.tolist(), strict=True):
            if of is not None and index >= 0 and name not in bundle.cameras:
                seen.setdefault(name, []).append((index, of))
    for name in sorted(seen, key=lambda name: -len(seen[name])):
        camera = _resect(known[name], features[name], np.array(seen[name]), points.points)
        if camera is not None:
            return camera
    return None


def _keys(row: np.ndarray, names: Sequence[str], cameras: Mapping[str, Camera]) -> list[tuple[str, int]]:
    return [(name, index) for name, index in zip(names, row.tolist(), strict=True) if index >= 0 and name in cameras]


def _resect(camera: Camera, features: Features, seen: np.ndarray, points: np.ndarray) -> Camera | None:
    """The camera at the pose that explains enough of the points it sees."""
    if len(seen) < FEWEST_SEEN:
        return None
    pycolmap = silent_pycolmap("finding cameras")
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error, options.ransac.random_seed = 2 * pixel_error(camera), 0
    pixels, there = features.pixels[seen[:, 0]], points[seen[:, 1]]
    estimate = pycolmap.estimate_and_refine_absolute_pose(pixels, there, as_colmap(camera), options)
    if estimate is None or estimate["num_inliers"] < max(FEWEST_SEEN, LEAST_SHARE * len(seen)):
        return None
    pose = estimate["cam_from_world"]
    placed = replace(camera, T_camera_world=rigid(pose.rotation.matrix(), np.asarray(pose.translation)))
    errors = np.linalg.norm(project(placed, there) - pixels, axis=1)
    return placed if np.isfinite(errors).any() else None


def _doubt(
    bundle: Bundle,
    tracks: Tracks,
    features: Mapping[str, Features],
    schedule: Sequence[tuple[float, float]],
    focal: str | None,
) -> tuple[dict[str, tuple[float, float]], dict[str, float]]:
    """What two halves of the images differ by about poses and focal lengths; nothing where one does not hold."""
    halves = _halves(tracks, features, bundle.cameras)
    one, other = (bundled(bundle.cameras, features, half, schedule, focal) for half in halves)
    if one is None or other is None:
        return {}, {}
    doubt = differences(one.cameras, other.cameras)
    if focal is None:
        return doubt, {}
    lengths = {name: (one.cameras[name].K[0, 0], other.cameras[name].K[0, 0]) for name in doubt}
    return doubt, {name: abs(float(np.log(a / b))) for name, (a, b) in lengths.items()}


def _halves(tracks: Tracks, features: Mapping[str, Features], cameras: Mapping[str, Camera]) -> list[Tracks]:
    """Tracks by the cell, of alternating ones, in which the first camera that has them sees them."""
    first = (tracks.seen >= 0).argmax(axis=1)
    which = np.zeros(len(first), int)
    for column, name in enumerate(tracks.names):
        rows = np.flatnonzero(first == column)
        if len(rows):
            which[rows] = half_of(features[name].pixels[tracks.seen[rows, column]], cameras[name])
    return [Tracks(tracks.names, tracks.seen[which == half]) for half in (0, 1)]


def _refuse_unsure(
    doubt: Mapping[str, tuple[float, float]], focals: Mapping[str, float], wanted: Sequence[str]
) -> None:
    unsure = [name for name in wanted if name not in doubt or not all(map(le, doubt[name], LARGEST_DOUBT))]
    if unsure:
        by = (f"{name} by {doubt[name][0]:.2f} degrees and {doubt[name][1]:.1%}" for name in unsure if name in doubt)
        degrees, share = LARGEST_DOUBT
        raise D2Error(
            f"two halves of the images disagree about where camera {', '.join(unsure)} stands"
            f"{f' ({listed} of the width)' if (listed := ', '.join(by)) else ''}, at most {degrees} degrees and "
            f"{share:.1%} are taken: {ADD}"
        )
    vague = [name for name in wanted if focals.get(name, 0.0) > LARGEST_FOCAL_DOUBT]
    if vague:
        share = max(focals[name] for name in vague)
        raise D2Error(
            f"two halves of the images disagree about the focal length of camera {', '.join(vague)} by {share:.0%}: "
            "say it (--focal PIXELS, --intrinsics FILE), or video a board and calibrate the lens with another tool"
        )
