"""The poses of a rig from its pictures alone, with known intrinsics: never one that the pictures do not settle.

Pairs of cameras give essential matrices, the best pair a start, and the other cameras are added one by one, each time
with a bundle adjustment. Then the pictures are cut into two halves that must find the same rig by themselves. Each
camera has one pose, over all moments and stills. The scale is arbitrary until a board or a distance says it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from d2_plugin.captures.calibrate.align import differences, rig_width
from d2_plugin.captures.calibrate.bundle import Bundle, Tracks, fitting, join_matches, project, triangulate
from d2_plugin.captures.calibrate.features import (
    Features,
    Matches,
    Pair,
    find_features,
    match_all,
    pixel_error,
    pycolmap_module,
)
from d2_plugin.captures.calibrate.refine import bundled, halved
from d2_plugin.captures.calibrate.verify import as_colmap, essential_pose, verified
from d2_plugin.captures.calibration import rigid
from d2_plugin.captures.capture import Camera
from d2_plugin.captures.pictures import checked_picture
from d2_plugin.errors import D2Error
from d2_plugin.values import checked_arguments

STARTS = 2
"""Pairs of cameras that are tried as a start, the most promising first."""

FEWEST_SEEN = 12
"""Points that settle a camera, at least, and as a share of those it should see."""
LEAST_SHARE = 0.25

GROWING = ((8.0, 1.3), (4.0, 0.4))
"""Rounds of the adjustment while cameras are added, as `refine.SCHEDULE`."""

LARGEST_DOUBT = (0.5, 0.02)
"""Degrees, and share of the rig's width, that two halves of the pictures may differ by about a camera."""

ADD = (
    "add stills on the way between the cameras (at most 20 degrees apart), bring neighbouring cameras closer together, "
    "or film a board that they see at the same moment"
)


@dataclass(frozen=True, eq=False)
class SolvedRig:
    """A rig that was found; the first camera's axes are the world's, and the width of the rig is 1."""

    cameras: dict[str, Camera]
    pixels: dict[str, float]
    """Camera -> median reprojection error in pixels."""
    seen: dict[str, int]
    """Camera -> points that it sees."""
    doubt: dict[str, tuple[float, float]]
    """Camera -> (degrees, share of the rig's width) that two halves of the pictures differ by: about two standard
    deviations."""
    scale: str = "arbitrary: give the distance of two cameras, or film a board"

    def verdicts(self) -> dict[str, str]:
        """A sentence per camera."""
        return {
            name: f"{self.pixels[name]:.2f} pixels over {self.seen[name]} points, known to {self.doubt[name][0]:.2g} "
            f"degrees and {self.doubt[name][1]:.2%} of the rig's width"
            for name in self.cameras
        }

    @checked_arguments
    def scaled(self, one: str, other: str, distance: float) -> SolvedRig:
        """The same rig with `distance` between two of its cameras."""
        if not distance > 0 or one == other or one not in self.cameras or other not in self.cameras:
            raise D2Error(
                f"a distance of {distance:g} between {one} and {other} says no scale: name two cameras of "
                f"{', '.join(self.cameras)} and how far they stand apart, above 0"
            )
        found = float(np.linalg.norm(self.cameras[one].centre - self.cameras[other].centre))
        return self.times(distance / found, f"from the distance {distance:g} of {one} and {other}")

    def times(self, factor: float, why: str) -> SolvedRig:
        """The same rig, `factor` times as large; `why` says how that is known."""
        cameras = {}
        for name, camera in self.cameras.items():
            T = camera.T_camera_world.copy()
            T[:3, 3] *= factor
            cameras[name] = replace(camera, T_camera_world=T)
        return replace(self, cameras=cameras, scale=why)


@checked_arguments
def solve_rig(
    pictures: Mapping[str, Sequence[np.ndarray]],
    intrinsics: Mapping[str, Camera],
    stills: Mapping[str, np.ndarray] | None = None,
) -> SolvedRig:
    """The poses of cameras that stand still.

    Args:
        pictures: camera -> its pictures RGB uint8 [H, W, 3] at moments that are the same for all cameras, undistorted.
        intrinsics: camera -> its size and K, for the stills too; the poses in it are not looked at.
        stills: more pictures of the same scene, a camera each: they connect cameras that see too little in common.

    Raises:
        D2Error: the pictures do not settle the pose of every camera; the sentence names those, and what to add.
    """
    unknown = [name for name in (*pictures, *(stills or {})) if name not in intrinsics]
    if unknown or not pictures:
        raise D2Error(f"no intrinsics for camera {unknown[0] if unknown else 'any'}: give size and K of every camera")
    features = {name: find_features(_moments(name, taken)) for name, taken in pictures.items()}
    features |= {name: find_features([picture]) for name, picture in (stills or {}).items()}
    return solve_features(features, intrinsics, tuple(pictures))


def solve_features(
    features: Mapping[str, Features], intrinsics: Mapping[str, Camera], wanted: Sequence[str]
) -> SolvedRig:
    """`solve_rig` for features that were found already; `wanted` are the cameras that must be settled."""
    known = {name: replace(intrinsics[name], T_camera_world=np.eye(4)) for name in features}
    matches = verified(match_all(features), features, known)
    tracks = join_matches(matches, tuple(features))
    grown = [_grow(pair, matches, tracks, features, known) for pair in _starts(matches, features, known)]
    found = max((bundle for bundle in grown if bundle is not None), key=_worth, default=None)
    lost = list(wanted) if found is None else [name for name in wanted if name not in found.cameras]
    if found is None or lost:
        raise D2Error(f"the pictures do not settle where camera {', '.join(lost)} stands: {ADD}")
    found = bundled(found.cameras, features, tracks) or found
    doubt = _doubt(found, matches, features)
    unsure = [name for name in wanted if name not in doubt or not _sure(doubt[name])]
    if unsure:
        raise D2Error(
            f"two halves of the pictures disagree about where camera {', '.join(unsure)} stands, so that is not known: "
            f"{ADD}"
        )
    return _result(found, features, doubt, wanted)


def _moments(name: str, taken: Sequence[np.ndarray]) -> list[np.ndarray]:
    """What a camera sees where nothing moves, which stills see as well, then every picture."""
    shapes = {checked_picture(picture, f"a picture of camera {name}").shape for picture in taken}
    if len(shapes) != 1:
        raise D2Error(f"camera {name} has pictures of {len(shapes)} sizes, expected one: give pictures of one size")
    still = np.median(np.stack(taken), axis=0).astype(np.uint8) if len(taken) > 2 else taken[0]
    return [still, *taken]


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
    """The features (camera, index) of a track in `cameras`."""
    return [(name, index) for name, index in zip(names, row.tolist(), strict=True) if index >= 0 and name in cameras]


def _resect(camera: Camera, features: Features, seen: np.ndarray, points: np.ndarray) -> Camera | None:
    """The camera at the pose that explains enough of the points it sees."""
    if len(seen) < FEWEST_SEEN:
        return None
    pycolmap = pycolmap_module("finding cameras")
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error, options.ransac.random_seed = 2 * pixel_error(camera), 0
    pixels, there = features.pixels[seen[:, 0]], points[seen[:, 1]]
    found = pycolmap.estimate_and_refine_absolute_pose(pixels, there, as_colmap(camera), options)
    if found is None or found["num_inliers"] < max(FEWEST_SEEN, LEAST_SHARE * len(seen)):
        return None
    pose = found["cam_from_world"]
    placed = replace(camera, T_camera_world=rigid(pose.rotation.matrix(), np.asarray(pose.translation)))
    errors = np.linalg.norm(project(placed, there) - pixels, axis=1)
    return placed if np.isfinite(errors).any() else None


def _worth(bundle: Bundle) -> tuple[int, int]:
    return len(bundle.cameras), int((bundle.tracks.seen >= 0).sum())


def _doubt(found: Bundle, matches: Matches, features: Mapping[str, Features]) -> dict[str, tuple[float, float]]:
    """What two halves of the pictures differ by; nothing where one of them does not hold the rig."""
    inside = {pair: pairs for pair, pairs in matches.items() if set(pair) <= found.cameras.keys()}
    names = tuple(found.cameras)
    halves = [join_matches(halved(inside, features, found.cameras, which), names) for which in (0, 1)]
    parts = [bundled(found.cameras, features, half) for half in halves]
    if parts[0] is None or parts[1] is None:
        return {}
    return differences(parts[0].cameras, parts[1].cameras)


def _sure(doubt: tuple[float, float]) -> bool:
    return all(value <= limit for value, limit in zip(doubt, LARGEST_DOUBT, strict=True))


def _result(
    found: Bundle, features: Mapping[str, Features], doubt: dict[str, tuple[float, float]], wanted: Sequence[str]
) -> SolvedRig:
    errors = found.errors(features)
    first = np.linalg.inv(found.cameras[wanted[0]].T_camera_world)
    poses = {name: found.cameras[name].T_camera_world @ first for name in wanted}
    cameras = {name: replace(found.cameras[name], T_camera_world=pose) for name, pose in poses.items()}
    by_camera = {name: errors[:, found.tracks.names.index(name)] for name in wanted}
    rig = SolvedRig(
        cameras,
        {name: float(np.nanmedian(missed)) for name, missed in by_camera.items()},
        {name: int(np.isfinite(missed).sum()) for name, missed in by_camera.items()},
        {name: doubt[name] for name in wanted},
    )
    return replace(rig.times(1 / rig_width(cameras), ""), scale=rig.scale)
