"""A rig that grows: from the two cameras that share most, camera by camera, each time with a bundle adjustment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from d2_plugin.recordings.cameras.calibrating.bundle import Bundle, Tracks, fitting, join_matches, project, triangulate
from d2_plugin.recordings.cameras.calibrating.features import (
    Features,
    Matches,
    Pair,
    as_colmap,
    essential_pose,
    pixel_error,
    silent_pycolmap,
)
from d2_plugin.recordings.cameras.calibrating.refine import bundled
from d2_plugin.recordings.cameras.camera import rigid
from d2_plugin.recordings.recording import Camera

STARTS = 2
"""Pairs of cameras that are tried as a start, the most promising first."""

FEWEST_SEEN = 12
"""Points that settle a camera, at least, and as a share of those it should see."""
LEAST_SHARE = 0.25

GROWING = ((8.0, 1.3), (4.0, 0.4))
"""Rounds of the adjustment while cameras are added, as `refine.SCHEDULE`."""


def grown(
    matches: Matches, tracks: Tracks, features: Mapping[str, Features], known: Mapping[str, Camera]
) -> Bundle | None:
    """The bundle with the most cameras, then the most observations; None where no two cameras make a start."""
    bundles = [_grow(pair, matches, tracks, features, known) for pair in _starts(matches, features, known)]
    return max((bundle for bundle in bundles if bundle is not None), key=_worth, default=None)


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


def _worth(bundle: Bundle) -> tuple[int, int]:
    return len(bundle.cameras), int((bundle.tracks.seen >= 0).sum())
