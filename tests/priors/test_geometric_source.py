"""The cache of geometric depth: what a build computes and reads back, what voids it, what outlives a power cut."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from d2_plugin.priors.frame import Frame
from d2_plugin.priors.geometric_source import GeometricSource
from d2_plugin.priors.stereo.depth_range import DepthBounds
from d2_plugin.priors.stereo.filtering.filter import GeometricDepth
from d2_plugin.priors.stereo.settings import StereoSettings
from d2_plugin.recordings.recording import Camera
from d2_plugin.store.files import write_entry

CAMERAS = [Camera(name, 7, 5, np.eye(3), np.eye(4)) for name in ("a", "b")]
FRAME = Frame(3, {}, {"a": "image a", "b": "image b"})
BOUNDS = DepthBounds(1e-3, 1e6, "test")


class Computed(GeometricSource):
    """Depths from 1e-3 to 1e6 with holes; of camera b there is none at all."""

    def __init__(self, folder: Path, settings: StereoSettings | None = None, matcher: str = "patchmatch") -> None:
        super().__init__(CAMERAS, BOUNDS, settings or StereoSettings(), matcher, folder)
        self.calls = 0

    def _inputs(self, frame: Frame) -> None:
        return None

    def _computed(self, frame: Frame) -> list[GeometricDepth]:
        self.calls += 1
        depth = np.geomspace(1e-3, 1e6, 35).astype(np.float32).reshape(5, 7)
        depth[2] = 0
        sigma = np.where(depth > 0, np.float32(0.0123), np.float32(np.inf))
        none = np.zeros_like(depth)
        maps = (depth, sigma), (none, np.full_like(sigma, np.inf))
        return [GeometricDepth(*pair, {"survivors": {"matched": 28}}) for pair in maps]


def assert_same(read: dict[str, GeometricDepth], expected: dict[str, GeometricDepth]) -> None:
    assert read.keys() == expected.keys()
    for name, depth in expected.items():
        assert read[name].record == depth.record
        for map_, other in ((read[name].depth, depth.depth), (read[name].sigma, depth.sigma)):
            assert map_.dtype == other.dtype
            np.testing.assert_array_equal(map_, other)


def test_the_build_that_computes_sees_what_the_next_one_reads(tmp_path: Path) -> None:
    first, second = Computed(tmp_path), Computed(tmp_path)
    depths = first.depths(FRAME)
    assert_same(second.depths(FRAME), depths)
    assert (first.calls, second.calls) == (1, 0)
    assert (depths["a"].depth[0] != first._computed(FRAME)[0].depth[0]).any(), (
        "codes are coarser than what was computed"
    )


@pytest.mark.parametrize("suffix", [".npy", ".json"])
def test_files_that_a_power_cut_emptied_are_computed_again(tmp_path: Path, suffix: str) -> None:
    source = Computed(tmp_path)
    first = source.depths(FRAME)
    (tmp_path / "a" / f"00003{suffix}").write_bytes(b"")
    assert_same(source.depths(FRAME), first)
    assert source.calls == 2


def test_only_what_cannot_be_made_again_waits_for_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    waited: list[int] = []
    monkeypatch.setattr(os, "fsync", waited.append)
    Computed(tmp_path).depths(FRAME)
    assert waited == []
    write_entry(tmp_path / "kept.npy", np.zeros(3), {})
    assert len(waited) == 2


@pytest.mark.parametrize(
    ("change", "voids"),
    [
        ({"max_pixels": 10_000}, {"patchmatch"}),
        ({"seed": 1}, {"patchmatch"}),
        ({"reuse_block": 7}, set()),
        ({"patchmatch_device": "cpu"}, set()),
    ],
)
def test_maps_are_made_anew_where_a_setting_changed_that_they_depend_on_and_kept_elsewhere(
    tmp_path: Path, change: dict[str, object], voids: set[str]
) -> None:
    settings = replace(StereoSettings(), **change)
    for matcher in ("patchmatch", "workspace"):
        key, other = (Computed(tmp_path, chosen, matcher).key(FRAME) for chosen in (None, settings))
        assert (key != other) == (matcher in voids), matcher
