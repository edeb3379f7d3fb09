"""Geometric depth on disk, one timestamp at a time, so that other fusion settings cost seconds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from d2_plugin.priors.frame import Frame
from d2_plugin.priors.stereo.filtering.filter import GeometricDepth
from d2_plugin.recordings.recording import Camera
from d2_plugin.store.files import Entry, EntryFolder
from d2_plugin.store.store import SIGMA, DepthRange, encode_sigma

STEREO_DTYPE = np.dtype([("depth", "<u2"), ("sigma", "u1")])
"""Geometric depth as it is stored, pixel by pixel."""


class GeometricSource(Protocol):
    """Where filtered geometric depth comes from: views that are matched, or maps that lie on disk."""

    @property
    def matcher(self) -> str:
        """Its name in the setting `matcher`."""

    @property
    def cameras(self) -> Sequence[Camera]:
        """Whose depth it has."""

    @property
    def matched_share(self) -> float:
        """Share of the pixels of the last frame that were matched anew, 1 where nothing is ever carried over."""

    def key(self, frame: Frame) -> str:
        """Hash of everything that the depth of this frame depends on."""

    def depths(self, frame: Frame) -> list[GeometricDepth]:
        """D^g per camera at one frame."""


@dataclass(frozen=True, eq=False)
class StoredDepth:
    """D^g of one view as the cache gives it back: `depth` float32 [H, W] (0 = none), its relative standard
    deviation `sigma` float32 [H, W] (infinite where there is none), and what is recorded about it."""

    depth: np.ndarray
    sigma: np.ndarray
    record: dict[str, Any]


def stored_depth(entry: Entry) -> StoredDepth:
    """What one entry of the cache holds."""
    return _decoded(entry.array(STEREO_DTYPE), entry.record)


def _decoded(codes: np.ndarray, record: dict[str, Any]) -> StoredDepth:
    depth = DepthRange(*record["depth_range"]).decode(codes["depth"])
    return StoredDepth(depth, SIGMA[codes["sigma"]], record)


class DepthCache:
    """Depth of a source, computed once and kept as logarithms: depth in 16 bits, sigma in 8.

    Args:
        source: computes what is missing.
        folder: of the cache.
    """

    def __init__(self, source: GeometricSource, folder: Path) -> None:
        self.source, self.entries = source, EntryFolder(folder, synced=False)

    def depths(self, frame: Frame) -> dict[str, StoredDepth]:
        """D^g by camera name; always what was stored, so that a second build sees the same depth as the first."""
        stored = self._stored(frame)
        if len(stored) < len(self.source.cameras):
            return self._store(frame, self.source.depths(frame))
        return stored

    def _stored(self, frame: Frame) -> dict[str, StoredDepth]:
        """What is there of one frame and was made from these inputs."""
        key, found = self.source.key(frame), {}
        for camera in self.source.cameras:
            entry = self.entries.find_current(camera.name, frame.number, key)
            if entry is not None:
                found[camera.name] = stored_depth(entry)
        return found

    def _store(self, frame: Frame, results: Sequence[GeometricDepth]) -> dict[str, StoredDepth]:
        """Writes what was computed, and returns it as it would be read back."""
        stored = {}
        for camera, result in zip(self.source.cameras, results, strict=True):
            depth_range = DepthRange.of(result.depth)
            record = {
                "key": self.source.key(frame),
                "matcher": self.source.matcher,
                "matched_share": round(self.source.matched_share, 6),
                "depth_range": [depth_range.near, depth_range.far],
                "survivors": {name: int(count) for name, count in result.survivors.items()},
            }
            codes = np.empty(result.depth.shape, STEREO_DTYPE)
            codes["depth"], codes["sigma"] = depth_range.encode(result.depth), encode_sigma(result.sigma)
            stored[camera.name] = _decoded(codes, self.entries.write(camera.name, frame.number, codes, record))
        return stored
