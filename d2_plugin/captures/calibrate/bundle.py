"""Tracks of features through cameras, their points, and the bundle adjustment of both (pycolmap, on the CPU)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import numpy as np

from d2_plugin.captures.calibrate.features import Features, Matches, pixel_error, pycolmap_module
from d2_plugin.captures.calibration import pinhole, rigid
from d2_plugin.captures.capture import Camera

SMALLEST_ANGLE = 1.0
"""Degrees between the rays of a point below which its depth is a guess."""

Track = dict[str, int]
"""Camera -> index of the feature in its list: one thing at one moment."""


@dataclass(frozen=True, eq=False)
class Bundle:
    """A rig and the points that it saw."""

    cameras: dict[str, Camera]
    points: np.ndarray  # [n, 3]
    tracks: list[Track]

    def errors(self, features: Mapping[str, Features]) -> dict[str, np.ndarray]:
        """Reprojection errors in pixels, by camera."""
        found: dict[str, np.ndarray] = {}
        for name, camera in self.cameras.items():
            rows = [i for i, track in enumerate(self.tracks) if name in track]
            seen = features[name].pixels[[self.tracks[i][name] for i in rows]]
            found[name] = np.linalg.norm(project(camera, self.points[rows]) - seen, axis=1)
        return found


def project(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Pixels [n, 2] of world points [n, 3]; far away where they lie behind the camera."""
    inside = points @ camera.T_camera_world[:3, :3].T + camera.T_camera_world[:3, 3]
    pixels = inside @ camera.K.T
    return np.where(inside[:, 2:] > 0, pixels[:, :2] / np.maximum(pixels[:, 2:], 1e-12), 1e9)


def join_matches(matches: Matches) -> list[Track]:
    """Matches joined to tracks; those that would see one thing twice in a camera are dropped."""
    parent: dict[tuple[str, int], tuple[str, int]] = {}

    def root(node: tuple[str, int]) -> tuple[str, int]:
        while parent.setdefault(node, node) != node:
            parent[node] = parent[parent[node]]
            node = parent[node]
        return node

    for (a, b), pairs in matches.items():
        for i, j in pairs.tolist():
            parent[root((a, i))] = root((b, j))
    groups: dict[tuple[str, int], list[tuple[str, int]]] = {}
    for node in list(parent):
        groups.setdefault(root(node), []).append(node)
    return [dict(group) for group in groups.values() if len(dict(group)) == len(group)]


def triangulate(
    cameras: Mapping[str, Camera], features: Mapping[str, Features], tracks: Sequence[Track]
) -> tuple[np.ndarray, list[Track]]:
    """(points [n, 3], their tracks within `cameras`) of all tracks with two rays that meet at an angle.

    Linear, from all rays of a track at once; whether it fits is for `fitting` to say.
    """
    projections = {name: camera.K @ camera.T_camera_world[:3] for name, camera in cameras.items()}
    points, kept = [np.zeros((0, 3))], []
    for track in tracks:
        inside = {name: index for name, index in track.items() if name in cameras}
        if len(inside) < 2:
            continue
        rows = []
        for name, index in inside.items():
            P, (x, y) = projections[name], features[name].pixels[index]
            rows += [(x * P[2] - P[0]) / cameras[name].K[0, 0], (y * P[2] - P[1]) / cameras[name].K[1, 1]]
        homogeneous = np.linalg.svd(np.stack(rows))[2][-1]
        if abs(homogeneous[3]) < 1e-12:
            continue
        point = homogeneous[:3] / homogeneous[3]
        if _angle([cameras[name].centre for name in inside], point) >= SMALLEST_ANGLE:
            points.append(point[None])
            kept.append(inside)
    return np.concatenate(points), kept


def _angle(centres: Sequence[np.ndarray], point: np.ndarray) -> float:
    """Largest angle in degrees between the rays of a point."""
    rays = np.stack([point - centre for centre in centres])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True).clip(1e-300)
    return float(np.rad2deg(np.arccos(np.clip((rays @ rays.T).min(), -1, 1))))


def fitting(bundle: Bundle, features: Mapping[str, Features], pixels: float) -> Bundle:
    """The bundle without the observations that miss by more than `pixels` (of `pixel_error`)."""
    kept_points, kept = [], []
    limits = {name: pixels * pixel_error(camera) for name, camera in bundle.cameras.items()}
    missed = [dict.fromkeys(track, 0.0) for track in bundle.tracks]
    for name, errors in bundle.errors(features).items():
        rows = [i for i, track in enumerate(bundle.tracks) if name in track]
        for i, error in zip(rows, errors.tolist(), strict=True):
            missed[i][name] = error
    for point, track, errors_of in zip(bundle.points, bundle.tracks, missed, strict=True):
        good = {name: index for name, index in track.items() if errors_of[name] <= limits[name]}
        if len(good) >= 2:
            kept_points.append(point)
            kept.append(good)
    return replace(bundle, points=np.array(kept_points).reshape(-1, 3), tracks=kept)


def adjust(bundle: Bundle, features: Mapping[str, Features], scale: float, focal: bool = False) -> Bundle:
    """Poses and points that make the reprojection errors least, with the gauge held by two cameras.

    The loss is Cauchy's with `scale` pixels: what misses by much more hardly counts.

    `focal` frees the focal length of each camera as well, one for both axes.
    """
    pycolmap = pycolmap_module("adjusting poses")
    names = {name: number for number, name in enumerate(bundle.cameras, start=1)}
    rec = pycolmap.Reconstruction()
    for name, number in names.items():
        camera = bundle.cameras[name]
        K = camera.K
        values = [K[0, 0], K[0, 2], K[1, 2]] if focal else [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
        model = "SIMPLE_PINHOLE" if focal else "PINHOLE"
        rec.add_camera_with_trivial_rig(
            pycolmap.Camera(camera_id=number, model=model, width=camera.width, height=camera.height, params=values)
        )
        image = pycolmap.Image(
            name=name, keypoints=features[name].pixels.reshape(-1, 2), camera_id=number, image_id=number
        )
        rec.add_image_with_trivial_frame(image, as_rigid(pycolmap, camera))
    for point, track in zip(bundle.points, bundle.tracks, strict=True):
        elements = [pycolmap.TrackElement(names[name], index) for name, index in track.items()]
        rec.add_point3D(point, pycolmap.Track(elements))
    identities = sorted(rec.points3D)
    _solve(pycolmap, rec, scale, focal)
    cameras = {name: _moved(bundle.cameras[name], rec, number, focal) for name, number in names.items()}
    return Bundle(cameras, np.stack([rec.points3D[i].xyz for i in identities]), bundle.tracks)


def _solve(pycolmap: ModuleType, rec: Any, scale: float, focal: bool) -> None:
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length, options.refine_extra_params, options.print_summary = focal, False, False
    options.ceres.loss_function_type, options.ceres.loss_function_scale = pycolmap.LossFunctionType.CAUCHY, scale
    options.ceres.solver_options.num_threads = 1
    config = pycolmap.BundleAdjustmentConfig()
    for image in rec.images:
        config.add_image(image)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, rec).solve()


def as_rigid(pycolmap: ModuleType, camera: Camera) -> Any:
    """The pose of a camera as pycolmap has it."""
    T = camera.T_camera_world
    return pycolmap.Rigid3d(pycolmap.Rotation3d(T[:3, :3]), T[:3, 3])


def _moved(camera: Camera, rec: Any, number: int, focal: bool) -> Camera:
    found = rec.images[number].cam_from_world()
    K = camera.K
    if focal:
        length = float(rec.cameras[number].params[0])
        K = pinhole(length, length, K[0, 2], K[1, 2])
    return replace(camera, K=K, T_camera_world=rigid(found.rotation.matrix(), np.asarray(found.translation)))
