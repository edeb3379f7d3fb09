"""Frames aligned together: one fit per block, steadier lines, and the same store however it is built."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from d2_plugin.priors.build import build_priors
from d2_plugin.priors.monocular.align import align
from d2_plugin.priors.monocular.settings import AlignSettings
from d2_plugin.priors.monocular.together import Seen, aligned_together
from d2_plugin.priors.settings import PriorSettings, StereoSettings
from d2_plugin.recordings.recording import Recording
from d2_plugin.recordings.synthetic.room import synthetic_recording
from d2_plugin.store.store import PriorStore

pytest.importorskip("cv2")

STEREO = StereoSettings(matcher="sweep", reuse_block=2)
ANY = {"min_anchors": 5, "min_t": 0.0, "min_correlation": -1.0, "wrong_kind_correlation": -1.0, "min_inliers": 0.0}
"""So small a room has few anchors; here they need not be enough."""
TOGETHER = PriorSettings(stereo=STEREO, align=AlignSettings(together=True, **ANY))


@pytest.fixture(scope="module")
def room() -> Recording:
    return synthetic_recording(cameras=3, held_out=0, frames=3, width=128, height=72, arc_degrees=20)


def nothing_moves(image: np.ndarray, before: np.ndarray) -> np.ndarray:
    return np.zeros(image.shape, bool)


def still(frames: int, noise: float = 0.0, share: float = 0.02) -> tuple[dict[int, Seen], np.ndarray, np.ndarray]:
    """A still image seen `frames` times, each map with a line of its own; (frames, true inverse depth, scales)."""
    rng = np.random.default_rng(0)
    inverse = np.tile(np.linspace(0.1, 1, 80), (60, 1))
    scales = rng.uniform(0.5, 2, frames)
    image = np.zeros((*inverse.shape, 3), np.uint8)
    seen = {}
    for number, scale in enumerate(scales):
        mono = (inverse - 0.05 * number) / scale + rng.normal(0, noise, inverse.shape)
        geometric = np.where(rng.random(inverse.shape) < share, 1 / inverse, 0)
        seen[10 * number] = Seen(image, mono.astype(np.float32), geometric.astype(np.float32))
    return seen, inverse, scales


def test_the_lines_are_found_and_recorded_with_one_certificate() -> None:
    seen, _, scales = still(4, noise=1e-3)
    found = aligned_together(seen, "relative", AlignSettings(), nothing_moves)
    assert list(found) == [0, 10, 20, 30]
    np.testing.assert_allclose([alignment.scale for alignment in found.values()], scales, rtol=0.01)
    assert len({alignment.gap for alignment in found.values()}) == 1
    assert all(alignment.accepted and alignment.gap < 1e-8 for alignment in found.values())


def test_lines_of_a_still_image_are_steadier_together() -> None:
    seen, inverse, _ = still(6, noise=0.05)
    settings = AlignSettings()
    alone = {number: align(f.mono, f.geometric, kind="relative", settings=settings) for number, f in seen.items()}
    together = aligned_together(seen, "relative", settings, nothing_moves)

    def unsteady(found: dict) -> float:
        lines = [found[n].scale * np.float64(f.mono).mean() + found[n].shift for n, f in seen.items()]
        return float(np.std(lines)) / inverse.mean()

    assert unsteady(together) < 0.7 * unsteady(alone)


def test_noise_of_the_maps_does_not_make_the_lines_flatter() -> None:
    seen, _, scales = still(6, noise=0.05)
    found = aligned_together(seen, "relative", AlignSettings(), nothing_moves)
    alone = [align(f.mono, f.geometric, kind="relative", settings=AlignSettings()).scale for f in seen.values()]
    ratio = np.array([alignment.scale for alignment in found.values()]) / scales
    assert ratio.mean() > np.mean(alone / scales) - 0.03


def test_a_frame_that_is_refused_alone_stays_refused_and_tells_nothing() -> None:
    seen, _, _ = still(3, noise=1e-3)
    seen[10] = seen[10]._replace(mono=np.random.default_rng(1).random((60, 80)).astype(np.float32))
    found = aligned_together(seen, "relative", AlignSettings(), nothing_moves)
    assert [alignment.accepted for alignment in found.values()] == [True, False, True]
    rest = aligned_together({n: seen[n] for n in (0, 20)}, "relative", AlignSettings(), nothing_moves)
    assert found[20] == rest[20]


def test_shards_make_the_store_that_a_single_build_makes(room: Recording, tmp_path: Path) -> None:
    names = list(room.cameras)
    build_priors(room, names, tmp_path / "whole", TOGETHER)
    for index in (1, 0):
        build_priors(room, names, tmp_path / "parts", TOGETHER, shard=(index, 2))
    whole, parts = PriorStore.open(tmp_path / "whole"), PriorStore.open(tmp_path / "parts")
    for name in names:
        for frame in room.frames:
            assert whole.record(name, frame)["key"] == parts.record(name, frame)["key"]
            assert (whole.prior(name, frame).depth == parts.prior(name, frame).depth).all()
    first, second, third = (whole.record(names[0], frame)["alignment"] for frame in room.frames)
    assert {first["status"], second["status"], third["status"]} == {"ok"}
    assert first["objective"] == second["objective"] != third["objective"], "frames of one block are one fit"
    assert build_priors(room, names, tmp_path / "whole", TOGETHER).built == 0
    alone = replace(TOGETHER, align=AlignSettings(**ANY))
    assert build_priors(room, names, tmp_path / "whole", alone).kept == 0


def test_the_paper_aligns_each_frame_for_itself() -> None:
    assert not PriorSettings.paper().align.together
    assert not PriorSettings().align.together
