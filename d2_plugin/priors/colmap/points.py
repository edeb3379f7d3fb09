"""Sparse surface points from cameras whose poses are known: SIFT features, matched, triangulated by COLMAP.

COLMAP would estimate the geometry of every pair of images anew to tell good matches from bad ones. The poses are
known here, so a match is kept when it lies on its epipolar line: no random sampling, and pairs with a handful of
matches still count.

Features are those of COLMAP's SIFT; OpenCV's takes less time but serves cameras that see little in common worse.
"""

from __future__ import annotations

import itertools
import os
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.extras import import_pycolmap
from d2_plugin.reading import said
from d2_plugin.recordings.cameras.calibrating.features import as_colmap
from d2_plugin.recordings.cameras.camera import same_spot
from d2_plugin.recordings.cameras.epipolar import sampson
from d2_plugin.recordings.recording import Camera, Recording

LUMA = np.array([0.299, 0.587, 0.114])
"""Weights of red, green and blue in the grey image that features are found in (ITU-R BT.601)."""

DESCRIPTOR_LENGTH = 128
"""Numbers in a SIFT descriptor."""

PEAK_THRESHOLD = 0.0033
"""SIFT contrast threshold; half of COLMAP's, since the epipolar test is strict."""
MAX_FEATURES = 8192
"""Strongest features kept per image."""
MAX_RATIO = 0.8
"""Largest angle to the best match over the angle to the second best (Lowe's ratio test)."""
MAX_ANGLE = 0.7
"""Largest angle between matching descriptors, radians."""
EPIPOLAR_ERROR = 1.0
"""Largest Sampson distance of a match from the known epipolar geometry, pixels."""
REPROJECTION_ERROR = 2.0
"""Largest reprojection error of a point, pixels."""
MIN_ANGLE = 0.5
"""Smallest angle between two rays that meet in a point, degrees."""


class Features(NamedTuple):
    """Feature points of one image."""

    pixels: np.ndarray  # [F, 2] float64, pixel centres at i + 0.5
    descriptors: np.ndarray  # [F, 128] float32, unit length


@dataclass(frozen=True, eq=False)
class SparsePoints:
    """Triangulated surface points of one or several frames."""

    positions: np.ndarray  # [P, 3] float64, world
    colors: np.ndarray  # [P, 3] float32 in 0..1, mean over the images that see the point
    frames: np.ndarray  # [P] int64, frame the point was seen in

    def __len__(self) -> int:
        return len(self.positions)

    @classmethod
    def empty(cls) -> SparsePoints:
        """No points."""
        return cls(np.zeros((0, 3)), np.zeros((0, 3), np.float32), np.zeros(0, np.int64))

    @classmethod
    def joined(cls, parts: Iterable[SparsePoints]) -> SparsePoints:
        """The points of all `parts`, in their order."""
        together = [cls.empty(), *parts]
        return cls(*(np.concatenate([getattr(part, field.name) for part in together]) for field in fields(cls)))


def triangulate(images: Sequence[np.ndarray], cameras: Sequence[Camera], frame: int = 0) -> SparsePoints:
    """Surface points seen by at least two of `cameras` at one instant.

    Args:
        images: RGB uint8 [H, W, 3], one per camera.
        frame: what to note as the points' frame.

    Returns:
        The points, in an order that does not depend on threads; none for a single camera, cameras that stand on one
        spot, or images without texture.

    Raises:
        MissingExtra: pycolmap is not installed.
    """
    pycolmap = import_pycolmap("triangulating sparse points", "stereo")
    with _quiet(pycolmap), tempfile.TemporaryDirectory(prefix="d2_sparse_") as folder:
        features = [_extract(pycolmap, image) for image in images]
        pairs = _matched_pairs(features, cameras)
        if not pairs:
            return SparsePoints.empty()
        try:
            model = _triangulated(pycolmap, Path(folder), cameras, features, pairs)
        except RuntimeError as failure:  # of its database, where the disk is full
            remedy = "make room there, or name another folder for temporary files in TMPDIR"
            raise D2Error(f"COLMAP cannot triangulate in {folder} ({said(failure)}): {remedy}") from failure
        return _collected(model, images, frame)


def triangulate_frames(recording: Recording, cameras: Sequence[str], frames: Iterable[int]) -> SparsePoints:
    """`triangulate` for each of `frames` of a recording, joined; images are read one instant at a time."""
    calibrations = [recording.cameras[name] for name in cameras]
    instants = ((frame, [recording.image(name, frame) for name in cameras]) for frame in frames)
    return SparsePoints.joined(triangulate(images, calibrations, frame) for frame, images in instants)


@contextmanager
def _quiet(pycolmap: ModuleType) -> Iterator[None]:
    """COLMAP reports progress on stderr; errors still come through as exceptions."""
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = 2
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before


def _extract(pycolmap: ModuleType, image: np.ndarray) -> Features:
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.num_threads = os.cpu_count() or 1
    options.sift.peak_threshold = PEAK_THRESHOLD
    options.sift.max_num_features = MAX_FEATURES
    extractor = pycolmap.FeatureExtractor.create(options, device=pycolmap.Device.cpu)
    gray = np.rint(image @ LUMA).astype(np.uint8)
    keypoints, descriptors = extractor.extract_from_uint8_array(gray)
    pixels = np.array([(point.x, point.y) for point in keypoints], np.float64).reshape(-1, 2)
    vectors = np.asarray(descriptors.data, np.float32).reshape(len(pixels), DESCRIPTOR_LENGTH)
    return Features(pixels, vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12))


def _matched_pairs(features: Sequence[Features], cameras: Sequence[Camera]) -> dict[tuple[int, int], np.ndarray]:
    """Matches [M, 2] of every pair of images that has any."""
    both = itertools.combinations(range(len(cameras)), 2)
    apart = [(i, j) for i, j in both if not same_spot(cameras[i], cameras[j])]
    pairs = {(i, j): epipolar_matches(features[i], features[j], cameras[i], cameras[j]) for i, j in apart}
    return {pair: matches for pair, matches in pairs.items() if len(matches)}


def epipolar_matches(first: Features, second: Features, one: Camera, other: Camera) -> np.ndarray:
    """Pairs of feature indices [M, 2] that are each other's nearest, unambiguous, and fit what two cameras see."""
    if min(len(first.pixels), len(second.pixels)) < 2:
        return np.zeros((0, 2), np.int64)
    forward = _nearest(first.descriptors, second.descriptors)
    backward = _nearest(second.descriptors, first.descriptors)
    here = np.flatnonzero(forward >= 0)
    here = here[backward[forward[here]] == here]
    matches = np.stack([here, forward[here]], axis=1)
    error = sampson(one, other, first.pixels[matches[:, 0]], second.pixels[matches[:, 1]])
    return matches[np.abs(error) <= EPIPOLAR_ERROR]


def _nearest(queries: np.ndarray, candidates: np.ndarray, block: int = 1024) -> np.ndarray:
    """Index of the candidate nearest to each query [Q], -1 where it is too far or a second one is as near."""
    nearest = np.full(len(queries), -1)
    for start in range(0, len(queries), block):
        similarity = queries[start : start + block] @ candidates.T
        best, rows = similarity.argmax(axis=1), np.arange(len(similarity))
        angle = np.arccos(np.clip(similarity[rows, best], -1, 1))
        similarity[rows, best] = -np.inf
        second = np.arccos(np.clip(similarity.max(axis=1), -1, 1))
        clear = (angle <= MAX_ANGLE) & (angle <= MAX_RATIO * second)
        nearest[start : start + block] = np.where(clear, best, -1)
    return nearest


def _triangulated(
    pycolmap: ModuleType,
    folder: Path,
    cameras: Sequence[Camera],
    features: Sequence[Features],
    pairs: dict[tuple[int, int], np.ndarray],
) -> Any:
    """The pycolmap.Reconstruction with points; image i has the id i + 1."""
    model = _posed_model(pycolmap, cameras)
    _write_database(pycolmap, folder / "database.db", model, features, pairs)
    options = pycolmap.IncrementalPipelineOptions()
    options.extract_colors = False
    options.min_num_matches = 1
    options.random_seed = options.triangulation.random_seed = 0
    options.triangulation.ignore_two_view_tracks = False  # the default leaves a pair of cameras without a single point
    options.triangulation.min_angle = options.mapper.filter_min_tri_angle = MIN_ANGLE
    options.mapper.filter_max_reproj_error = REPROJECTION_ERROR
    (folder / "model").mkdir()
    return pycolmap.triangulate_points(model, folder / "database.db", folder, folder / "model", options=options)


def _posed_model(pycolmap: ModuleType, cameras: Sequence[Camera]) -> Any:
    model = pycolmap.Reconstruction()
    for number, camera in enumerate(cameras, start=1):
        transform = camera.T_camera_world
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(transform[:3, :3]), transform[:3, 3])
        model.add_camera_with_trivial_rig(as_colmap(camera, number))
        image = pycolmap.Image(name=f"{number}", camera_id=number, image_id=number)
        model.add_image_with_trivial_frame(image, pose)
    return model


def _write_database(
    pycolmap: ModuleType,
    path: Path,
    model: Any,
    features: Sequence[Features],
    pairs: dict[tuple[int, int], np.ndarray],
) -> None:
    database = pycolmap.Database.open(path)
    for camera in model.cameras.values():
        database.write_camera(camera, use_camera_id=True)
    for rig in model.rigs.values():
        database.write_rig(rig, use_rig_id=True)
    for frame in model.frames.values():  # before the images, which must find their frame
        database.write_frame(frame, use_frame_id=True)
    for number, image in model.images.items():
        database.write_image(image, use_image_id=True)
        database.write_keypoints(number, features[number - 1].pixels.astype(np.float32))
    for (i, j), matches in pairs.items():
        geometry = pycolmap.TwoViewGeometry()
        geometry.config = int(pycolmap.TwoViewGeometryConfiguration.CALIBRATED)
        geometry.inlier_matches = matches.astype(np.uint32)
        database.write_two_view_geometry(i + 1, j + 1, geometry)
    database.close()


def _collected(model: Any, images: Sequence[np.ndarray], frame: int) -> SparsePoints:
    points = sorted(model.points3D.values(), key=lambda point: tuple(point.xyz))
    if not points:
        return SparsePoints.empty()
    colors = [np.mean([_color(model, images, seen) for seen in point.track.elements], axis=0) for point in points]
    positions = np.array([point.xyz for point in points], np.float64)
    return SparsePoints(positions, np.array(colors, np.float32) / 255, np.full(len(points), frame, np.int64))


def _color(model: Any, images: Sequence[np.ndarray], seen: Any) -> np.ndarray:
    column, row = model.images[seen.image_id].points2D[seen.point2D_idx].xy
    image = images[seen.image_id - 1]
    return image[min(int(row), image.shape[0] - 1), min(int(column), image.shape[1] - 1)]
