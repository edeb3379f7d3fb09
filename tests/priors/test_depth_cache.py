"""The cache of geometric depth: what a build computes, what it reads back, and what outlives a power cut."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from d2_plugin.priors.frame import Frame
from d2_plugin.priors.geometric_source import DepthCache, StoredDepth
from d2_plugin.priors.stereo.filtering.filter import GeometricDepth
from d2_plugin.recordings.recording import Camera
from d2_plugin.store.files import write_entry

CAMERAS = [Camera(name, 7, 5, np.eye(3), np.eye(4)) for name in ("a", "b")]
FRAME = Frame(3, {}, {})


class Computed:
    """Depths from 1e-3 to 1e6 with holes; of camera b there is none at all."""

    matcher, matched_share, cameras = "patchmatch", 1 / 3, CAMERAS

    def __init__(self) -> None:
        self.asked = 0

    def key(self, frame: Frame) -> str:
        return f"key of {frame.number}"

    def depths(self, frame: Frame) -> list[GeometricDepth]:
        self.asked += 1
        depth = np.geomspace(1e-3, 1e6, 35).astype(np.float32).reshape(5, 7)
        depth[2] = 0
        sigma = np.where(depth > 0, np.float32(0.0123), np.float32(np.inf))
        none = np.zeros_like(depth)
        return [
            GeometricDepth(map_, none, none.astype(np.uint8), {"matched": np.int64(28)}, noise)
            for map_, noise in ((depth, sigma), (none, np.full_like(sigma, np.inf)))
        ]


def assert_same(found: dict[str, StoredDepth], expected: dict[str, StoredDepth]) -> None:
    assert found.keys() == expected.keys()
    for name, stored in expected.items():
        assert found[name].record == stored.record
        for map_, other in ((found[name].depth, stored.depth), (found[name].sigma, stored.sigma)):
            assert map_.dtype == other.dtype
            np.testing.assert_array_equal(map_, other)


def test_the_build_that_computes_sees_what_the_next_one_reads(tmp_path: Path) -> None:
    source = Computed()
    first = DepthCache(source, tmp_path).depths(FRAME)
    assert_same(first, DepthCache(source, tmp_path).depths(FRAME))
    assert source.asked == 1
    assert (first["a"].depth[0] != source.depths(FRAME)[0].depth[0]).any(), "codes are coarser than what was computed"


@pytest.mark.parametrize("suffix", [".npy", ".json"])
def test_files_that_a_power_cut_emptied_are_computed_again(tmp_path: Path, suffix: str) -> None:
    source = Computed()
    first = DepthCache(source, tmp_path).depths(FRAME)
    (tmp_path / "a" / f"00003{suffix}").write_bytes(b"")
    assert_same(DepthCache(source, tmp_path).depths(FRAME), first)
    assert source.asked == 2


def test_only_what_cannot_be_made_again_waits_for_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    waited: list[int] = []
    monkeypatch.setattr(os, "fsync", waited.append)
    DepthCache(Computed(), tmp_path).depths(FRAME)
    assert waited == []
    write_entry(tmp_path / "kept.npy", np.zeros(3), {})
    assert len(waited) == 2
