"""Geometric depth that lies on disk: what a sensor measured, or what COLMAP computed in a workspace of the user's.

Sensor maps lie beside the images as depth/CAMERA/FRAME.npy or .png, with depth/depth.json: {"scale": world units per
stored number}, or {"unit": "m" | "cm" | "mm"} where the calibration is in metres. They hold planar depth, or with
{"along": "ray"} distances from the camera's centre. 0, NaN and infinity are no depth. Confidence maps may lie beside
them (`maps_on_disk.ConfidenceMaps`). True depth for evaluation (depth/CAMERA/FRAME.npz) is never read here.
Workspaces are read by `d2_plugin.priors.colmap.workspace`.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.priors.colmap.workspace import WorkspaceDepth
from d2_plugin.priors.frame import Frame, digest
from d2_plugin.priors.geometric_source import GeometricSource
from d2_plugin.priors.maps_on_disk import SUFFIXES, ConfidenceMaps, at_image_size, divided, planar, stored_numbers
from d2_plugin.priors.stereo.depth_range import DepthBounds
from d2_plugin.priors.stereo.filtering.filter import GeometricDepth, filter_depths, remove_speckles
from d2_plugin.priors.stereo.geometric_depth import gray
from d2_plugin.priors.stereo.settings import StereoSettings
from d2_plugin.reading import field, read_json
from d2_plugin.recordings.files import files_by_camera
from d2_plugin.recordings.recording import Camera, Recording
from d2_plugin.values import Range, shown

UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
"""Metres per unit."""

Scale = Annotated[float, Range(1e-9, 1e9)]
"""World units per stored number that depth.json may say."""

NEIGHBOURS = 2
"""Half the side of the window whose pixels a sensor's depth is compared with, pixels."""

SAME_SURFACE = 0.03
"""Neighbours of a sensor's depth agree within this share of it."""


class SensorDepth:
    """The maps of depth sensors in one folder.

    Raises:
        D2Error: depth.json is missing or does not say what a stored number means.
    """

    name: ClassVar[str] = "sensor"

    def __init__(self, folder: Path, cameras: Sequence[str]) -> None:
        self.scale, self.along_ray = _meaning(folder / "depth.json")
        self.files = files_by_camera(folder, cameras, SUFFIXES)
        self.about = f"sensor depth of {', '.join(self.files) or 'no camera'} in {folder.name}/"

    def depth(self, camera: Camera, frame: int) -> np.ndarray | None:
        """Planar depth float32 [H, W] at the camera's size in world units, 0 where unknown, or None: no map."""
        path = self.files.get(camera.name, {}).get(frame)
        if path is None:
            return None
        with np.errstate(over="ignore", invalid="ignore"):  # numbers beyond float32 are no depth
            stored = stored_numbers(path).astype(np.float32) * np.float32(self.scale)
        known = np.isfinite(stored) & (stored > 0)
        depth = at_image_size(np.where(known, stored, np.float32(0)), camera, path)
        return planar(depth, camera) if self.along_ray else depth


DepthMaps = SensorDepth | WorkspaceDepth
"""A folder of depth maps; `name` is what the setting `matcher` calls it, `about` describes it to a person."""


def find_depth_on_disk(recording: Recording, cameras: Sequence[str], settings: StereoSettings) -> DepthMaps | None:
    """The depth on disk that settings and recording name, or None where geometric depth is to be matched.

    Of its own accord (`auto`) no camera is left without depth: sensors are taken where every camera has one.

    Raises:
        D2Error: the settings ask for depth on disk and there is none.
    """
    if settings.matcher not in ("auto", SensorDepth.name, WorkspaceDepth.name):
        return None
    if settings.matcher == "auto" and recording.path is None:
        return None
    root = (recording.path or Path()).absolute()
    if settings.matcher in ("auto", SensorDepth.name):
        folder = root / (settings.folder or "depth")
        sensor = SensorDepth(folder, cameras) if (folder / "depth.json").is_file() else None
        if sensor is not None and (settings.matcher == SensorDepth.name or len(sensor.files) == len(cameras)):
            return sensor
        if settings.matcher == SensorDepth.name:
            raise D2Error(f"matcher = sensor but {folder} has no depth.json: write it beside CAMERA/FRAME.png or .npy")
    calibrations = [recording.cameras[name] for name in cameras]
    workspace = WorkspaceDepth.find(root, settings, calibrations, recording.frames)
    if workspace is None and settings.matcher == WorkspaceDepth.name:
        where = settings.folder or "colmap/FRAME, colmap or dense"
        raise D2Error(
            f"matcher = workspace but {root} has no COLMAP workspace with stereo/depth_maps at {where}: say where "
            "it is with stereo.folder"
        )
    return workspace


class DepthOnDisk(GeometricSource):
    """Filtered geometric depth from maps on disk.

    COLMAP's maps go through the filter of all matchers, with a cost of 0. A sensor measures where nothing can be
    matched, often with one camera alone: its maps are compared with their neighbours, not judged by texture or by a
    second view.

    Args:
        maps: where they are read.
        cameras: whose maps are read.
        bounds: what lies outside of them is dropped; nothing where None.
        settings: of the filter.
        cache: folder below which filtered depth is kept.
        confidence: that of the maps themselves; 1 everywhere where None.
    """

    def __init__(
        self,
        maps: DepthMaps,
        cameras: Sequence[Camera],
        bounds: DepthBounds | None,
        settings: StereoSettings,
        cache: Path,
        confidence: ConfidenceMaps | None = None,
    ) -> None:
        super().__init__(cameras, bounds, settings, maps.name, cache / "stereo")
        self.maps, self.confidence = maps, ConfidenceMaps(Path(), ()) if confidence is None else confidence
        self._read = functools.lru_cache(maxsize=1)(self._maps)

    def _inputs(self, frame: Frame) -> list[list[str | None]]:
        confidences = [self.confidence.of(camera, frame.number) for camera in self.cameras]
        hashes = [None if map_ is None else digest(map_) for map_ in confidences]
        return [[digest(depth) for depth in self._read(frame.number)], hashes]

    def _computed(self, frame: Frame) -> list[GeometricDepth]:
        confidences = [self.confidence.of(camera, frame.number) for camera in self.cameras]
        known = [True if values is None else values > 0 for values in confidences]
        maps = [np.where(where, depth, np.float32(0)) for where, depth in zip(known, self._read(frame.number))]
        if self.matcher == SensorDepth.name:
            filtered = [filter_sensor(depth, self.settings) for depth in maps]
        else:
            grays = [gray(frame.images[camera.name]) for camera in self.cameras]
            costs = [np.zeros(depth.shape, np.float32) for depth in maps]
            filtered = filter_depths(grays, self.cameras, maps, costs, self.settings)
        return [replace(depth, sigma=divided(depth.sigma, c)) for depth, c in zip(filtered, confidences)]

    def _maps(self, number: int) -> list[np.ndarray]:
        """The maps of one frame, float32 [H, W] per camera, 0 where unknown or out of range."""
        near, far = (0.0, np.inf) if self.bounds is None else self.bounds[:2]
        read = [(camera, self.maps.depth(camera, number)) for camera in self.cameras]
        whole = [np.zeros((c.height, c.width), np.float32) if depth is None else depth for c, depth in read]
        return [np.where((d >= near) & (d <= far), d, np.float32(0)) for d in whole]


def filter_sensor(depth: np.ndarray, settings: StereoSettings) -> GeometricDepth:
    """A sensor's map without the pixels that fly between two surfaces and without specks."""
    settled = np.where(flying_pixels(depth), 0, depth)
    final = remove_speckles(settled)
    survivors = {
        "pixels": depth.size,
        "measured": int(np.count_nonzero(depth)),
        "settled": int(np.count_nonzero(settled)),
        "kept": int(np.count_nonzero(final)),
    }
    sigma = np.where(final > 0, np.float32(settings.sensor_sigma), np.float32(np.inf))
    return GeometricDepth(final, sigma, np.zeros_like(final), {"survivors": survivors})


def flying_pixels(depth: np.ndarray) -> np.ndarray:
    """Pixels [H, W] bool of a sensor's map that lie between two surfaces: at an edge sensors mix both depths.

    They are those whose 5x5 neighbours mostly lie elsewhere, by more than 3 %. The coherence test of matched depth is
    made for less noise.
    """
    height, width = depth.shape
    padded = np.pad(depth, NEIGHBOURS, constant_values=np.nan)  # beyond the image nothing lies elsewhere
    agreeing, around = np.zeros(depth.shape, np.int32), np.zeros(depth.shape, np.int32)
    steps = range(2 * NEIGHBOURS + 1)
    for row, column in itertools.product(steps, steps):
        beside = padded[row : row + height, column : column + width]
        agreeing += np.abs(beside - depth) < SAME_SURFACE * depth
        around += beside >= 0
    return (depth > 0) & (2 * (agreeing - 1) < around - 1)


def _meaning(path: Path) -> tuple[float, bool]:
    """What a depth.json declares: world units per stored number, and whether distances are measured along the ray."""
    table = read_json(path, "write either scale (world units per stored number) or unit into it")
    if ("unit" in table) == ("scale" in table):
        raise D2Error(f"{path} must have either scale (world units per stored number) or unit, got {shown(table)}")
    along = field(table, "along", Literal["z", "ray"], str(path), "correct it", default="z")
    if "unit" in table:
        scale = UNITS[field(table, "unit", Literal["m", "cm", "mm"], str(path), "correct it")]
    else:
        scale = field(table, "scale", Scale, str(path), "correct it")
    return scale, along == "ray"
