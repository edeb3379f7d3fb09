"""Geometric depth D^g of the training cameras, frame by frame, kept on disk so that other fusion settings cost seconds.

Where it comes from is one of two: `stereo.matched_depth` matches the views, `depth_on_disk` reads maps that a sensor
measured or COLMAP computed.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from d2_plugin.priors.frame import Frame, describe_camera
from d2_plugin.priors.stereo.depth_range import DepthBounds
from d2_plugin.priors.stereo.filtering.filter import GeometricDepth
from d2_plugin.priors.stereo.settings import DEPENDS_ON, StereoSettings
from d2_plugin.recordings.recording import Camera
from d2_plugin.store.files import Entry, EntryFolder, hash_of
from d2_plugin.store.maps import SIGMA, DepthRange, encode_sigma

VERSION = 13  # raise it when a matcher or the filter changes what it returns, so that caches are not trusted

STEREO_DTYPE = np.dtype([("depth", "<u2"), ("sigma", "u1")])
"""Geometric depth as it is stored, pixel by pixel: logarithms, in 16 and in 8 bits. Matches that nobody confirms stand
between, with an infinite sigma."""


class GeometricSource(ABC):
    """Filtered geometric depth of a recording; what was computed once is read again from the cache.

    Args:
        cameras: whose depth it is.
        bounds: near and far of the depths that are searched or kept; None keeps all.
        settings: what else decides.
        matcher: the name of the source among `MatcherName`.
        folder: of the cache.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        bounds: DepthBounds | None,
        settings: StereoSettings,
        matcher: str,
        folder: Path,
    ) -> None:
        self.cameras, self.bounds, self.settings, self.matcher = list(cameras), bounds, settings, matcher
        self.entries = EntryFolder(folder, synced=False)
        self._keys: dict[int, str] = {}

    def depths(self, frame: Frame) -> dict[str, GeometricDepth]:
        """D^g by camera name; always what was stored, so that a second build sees the same depth as the first."""
        key = self.key(frame)
        entries = {c.name: self.entries.find_current(c.name, frame.number, key) for c in self.cameras}
        stored = {name: stored_depth(entry) for name, entry in entries.items() if entry is not None}
        if len(stored) == len(entries):
            return stored
        return {
            camera.name: self._write(camera.name, frame.number, depth, key)
            for camera, depth in zip(self.cameras, self._computed(frame), strict=True)
        }

    def key(self, frame: Frame) -> str:
        """Hash of all that the depth of a frame depends on: of all views, since each depends on all."""
        if frame.number not in self._keys:
            self._keys[frame.number] = hash_of(
                VERSION,
                self.matcher,
                {name: getattr(self.settings, name) for name in DEPENDS_ON[self.matcher]},
                None if self.bounds is None else list(self.bounds[:2]),
                [describe_camera(camera) for camera in self.cameras],
                [frame.hashes[camera.name] for camera in self.cameras],
                self._inputs(frame),
            )
        return self._keys[frame.number]

    @abstractmethod
    def _inputs(self, frame: Frame) -> Any:
        """What the depth of a frame depends on besides images, cameras, range and settings, as plain values."""

    @abstractmethod
    def _computed(self, frame: Frame) -> list[GeometricDepth]:
        """D^g per camera at one frame, in the order of the cameras."""

    def _write(self, camera: str, frame: int, depth: GeometricDepth, key: str) -> GeometricDepth:
        """Store one map, and return it as it will be read back."""
        matched = np.where(depth.depth > 0, depth.depth, depth.unconfirmed)
        depth_range = DepthRange.of(matched)
        about = {"key": key, "matcher": self.matcher, "depth_range": [depth_range.near, depth_range.far]}
        codes = np.empty(depth.depth.shape, STEREO_DTYPE)
        codes["depth"], codes["sigma"] = depth_range.encode(matched), encode_sigma(depth.sigma)
        return _decoded(codes, self.entries.write(camera, frame, codes, about | depth.record))


def stored_depth(entry: Entry) -> GeometricDepth:
    """What one entry of the cache holds."""
    return _decoded(entry.array(STEREO_DTYPE), entry.record)


def _decoded(codes: np.ndarray, record: dict[str, Any]) -> GeometricDepth:
    matched, sigma = DepthRange(*record["depth_range"]).decode(codes["depth"]), SIGMA[codes["sigma"]]
    confirmed = sigma < np.inf
    return GeometricDepth(matched * confirmed, sigma, matched * ~confirmed, record)
