"""Tracks of features through cameras, their points, and the bundle adjustment of both (pycolmap, on the CPU)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import numpy as np

from d2_plugin.recordings.cameras.calibrating.features import Features, Matches, as_colmap, pixel_error, silent_pycolmap
from d2_plugin.recordings.cameras.camera import pinhole, rigid
from d2_plugin.recordings.recording import Camera

SMALLEST_ANGLE = 1.0  # degrees between the rays of a point below which its depth is a guess


@dataclass(frozen=True, eq=False)
class Tracks:
    """What cameras saw of the same things: one row per thing at one moment."""

    names: tuple[str, ...]  # all cameras, in the order of the columns
    seen: np.ndarray  # [n, cameras] int, index into the camera's list of features, -1 where it did not see it

    def column(self, name: str) -> np.ndarray:
        """What one camera saw, [n]."""
        return np.asarray(self.seen[:, self.names.index(name)])

    def within(self, cameras: Mapping[str, Camera]) -> Tracks:
        """The rows that at least two of `cameras` saw, and only what these saw."""
        inside = np.array([name in cameras for name in self.names])
        seen = np.where(inside, self.seen, -1)
        return Tracks(self.names, seen[(seen >= 0).sum(axis=1) >= 2])

    def counts(self, cameras: Mapping[str, Camera]) -> list[int]:
        """How many rows each of `cameras` saw."""
        return [int((self.column(name) >= 0).sum()) for name in cameras]


@dataclass(frozen=True, eq=False)
class Bundle:
    """A rig and the points that it saw."""

    cameras: dict[str, Camera]
    points: np.ndarray  # [n, 3]
    tracks: Tracks

    def errors(self, features: Mapping[str, Features]) -> np.ndarray:
        """Reprojection errors [n, cameras] in pixels, in the columns of the tracks; NaN where a camera saw nothing."""
        errors = np.full(self.tracks.seen.shape, np.nan)
        for name, camera in self.cameras.items():
            seen = self.tracks.column(name)
            rows = seen >= 0
            missed = project(camera, self.points[rows]) - features[name].pixels[seen[rows]]
            errors[rows, self.tracks.names.index(name)] = np.linalg.norm(missed, axis=1)
        return errors


def project(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Pixels [n, 2] of world points [n, 3]; far away where they lie behind the camera."""
    inside = points @ camera.T_camera_world[:3, :3].T + camera.T_camera_world[:3, 3]
    pixels = inside @ camera.K.T
    return np.where(inside[:, 2:] > 0, pixels[:, :2] / np.maximum(pixels[:, 2:], 1e-12), 1e9)


def join_matches(matches: Matches, names: Sequence[str]) -> Tracks:
    """Matches joined to tracks; those that would see two things in one camera are dropped."""
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
    whole = [dict(group) for group in groups.values() if len(dict(group)) == len(group)]
    seen = np.array([[track.get(name, -1) for name in names] for track in whole], int).reshape(-1, len(names))
    return Tracks(tuple(names), seen)


def triangulate(cameras: Mapping[str, Camera], features: Mapping[str, Features], tracks: Tracks) -> Bundle:
    """The points of all tracks with two rays from `cameras` that meet at an angle.

    Linear, from all rays of a track at once; whether it fits is for `fitting` to say.
    """
    inside = tracks.within(cameras)
    rows = np.zeros((len(inside.seen), 2 * len(cameras), 4))
    for place, (name, camera) in enumerate(cameras.items()):
        seen = inside.column(name)
        there = np.flatnonzero(seen >= 0)
        P, pixels = camera.K @ camera.T_camera_world[:3], features[name].pixels[seen[there]]
        for axis in (0, 1):
            rows[there, 2 * place + axis] = (pixels[:, axis : axis + 1] * P[2] - P[axis]) / camera.K[0, 0]
    vectors = np.linalg.eigh(rows.transpose(0, 2, 1) @ rows)[1][:, :, 0]
    finite = np.abs(vectors[:, 3]) > 1e-12
    points = vectors[:, :3] / np.where(finite, vectors[:, 3], 1)[:, None]
    good = finite & (_widest_angle(cameras, inside, points) >= SMALLEST_ANGLE)
    return Bundle(dict(cameras), points[good], Tracks(inside.names, inside.seen[good]))


def _widest_angle(cameras: Mapping[str, Camera], tracks: Tracks, points: np.ndarray) -> np.ndarray:
    """Largest angle [n] in degrees between the rays of each point."""
    rays = []
    for name, camera in cameras.items():
        ray = points - camera.centre
        ray /= np.linalg.norm(ray, axis=1, keepdims=True).clip(1e-300)
        rays.append(np.where((tracks.column(name) >= 0)[:, None], ray, np.nan))
    stacked = np.stack(rays, axis=1)
    cosines = np.einsum("nik,njk->nij", stacked, stacked)
    return np.rad2deg(np.arccos(np.clip(np.nanmin(cosines, axis=(1, 2), initial=1.0), -1, 1)))


def fitting(bundle: Bundle, features: Mapping[str, Features], pixels: float) -> Bundle:
    """The bundle without the observations that miss by more than `pixels` (of `pixel_error`)."""
    limits = [pixels * pixel_error(bundle.cameras[n]) if n in bundle.cameras else 0.0 for n in bundle.tracks.names]
    errors = bundle.errors(features)
    seen = np.where(np.nan_to_num(errors, nan=np.inf) <= np.array(limits), bundle.tracks.seen, -1)
    kept = (seen >= 0).sum(axis=1) >= 2
    return Bundle(bundle.cameras, bundle.points[kept], Tracks(bundle.tracks.names, seen[kept]))


def adjust(bundle: Bundle, features: Mapping[str, Features], scale: float, focal: str | None) -> Bundle:
    """Poses and points that make the reprojection errors least, with the gauge held by two cameras.

    The loss is Cauchy's with `scale` pixels: what misses by much more hardly counts. `focal` frees focal lengths
    as well, one for both axes: "each" camera its own, or one that is "shared".
    """
    pycolmap = silent_pycolmap("adjusting poses")
    numbers = {name: number for number, name in enumerate(bundle.cameras, start=1)}
    rec = pycolmap.Reconstruction()
    for name, number in numbers.items():
        lens = 1 if focal == "shared" else number
        if lens not in rec.cameras:
            rec.add_camera_with_trivial_rig(as_colmap(bundle.cameras[name], lens, focal is not None))
        T, pixels = bundle.cameras[name].T_camera_world, features[name].pixels.reshape(-1, 2)
        image = pycolmap.Image(name=name, keypoints=pixels, camera_id=lens, image_id=number)
        rec.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(T[:3, :3]), T[:3, 3]))
    columns = [(numbers[name], place) for place, name in enumerate(bundle.tracks.names) if name in numbers]
    for point, seen in zip(bundle.points, bundle.tracks.seen.tolist(), strict=True):
        elements = [pycolmap.TrackElement(number, seen[place]) for number, place in columns if seen[place] >= 0]
        rec.add_point3D(point, pycolmap.Track(elements))
    identities = sorted(rec.points3D)
    _solve(pycolmap, rec, scale, focal is not None)
    cameras = {name: _moved(bundle.cameras[name], rec, number, focal is not None) for name, number in numbers.items()}
    points = np.array([rec.points3D[i].xyz for i in identities]).reshape(-1, 3)
    return Bundle(cameras, points, bundle.tracks)


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


def _moved(camera: Camera, rec: Any, number: int, focal: bool) -> Camera:
    pose = rec.images[number].cam_from_world()
    K = camera.K
    if focal:
        length = float(rec.images[number].camera.params[0])
        K = pinhole(length, length, K[0, 2], K[1, 2])
    return replace(camera, K=K, T_camera_world=rigid(pose.rotation.matrix(), np.asarray(pose.translation)))
