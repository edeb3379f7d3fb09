"""The local correction: undoes a smooth bend, ignores outliers, and says nothing where it knows nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from d2_plugin.priors.monocular import correct
from d2_plugin.priors.monocular.correct import corrected_depth, corrected_without
from d2_plugin.priors.settings import AlignSettings

pytest.importorskip("cv2")

SHAPE = (90, 160)
SETTINGS = AlignSettings()


def scene() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """True depth, aligned monocular depth bent by a smooth 8 %, and geometric depth at a third of the pixels."""
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    depth = (3 + u / 80 + (v > 45)).astype(np.float32)
    bend = 0.08 * np.sin(u / 40 + 1) * np.cos(v / 30)
    geometric = np.where(np.random.default_rng(0).random(SHAPE) < 0.33, depth, 0).astype(np.float32)
    return depth, (depth * np.exp(bend)).astype(np.float32), geometric


def error(estimate: np.ndarray, truth: np.ndarray) -> np.ndarray:
    return np.abs(estimate - truth) / truth


def test_a_smooth_bend_is_undone() -> None:
    depth, aligned, geometric = scene()
    corrected = corrected_depth(aligned, geometric, SETTINGS)
    assert corrected.dtype == np.float32
    assert np.median(error(corrected, depth)) < 0.15 * np.median(error(aligned, depth))


def test_pixels_without_anchors_nearby_keep_the_global_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    depth, aligned, geometric = scene()
    geometric[:, 40:] = 0
    monkeypatch.setattr(correct, "SCALES", (0.03,))
    corrected = corrected_depth(aligned, geometric, SETTINGS)
    np.testing.assert_allclose(corrected[:, 80:], aligned[:, 80:], rtol=1e-4)
    assert np.median(error(corrected, depth)[:, :35]) < 0.4 * np.median(error(aligned, depth)[:, :35])


def test_a_patch_of_wrong_anchors_stays_in_conflict() -> None:
    depth, aligned, geometric = scene()
    wrong = np.zeros(SHAPE, bool)
    wrong[40:46, 70:76] = True
    geometric = np.where(wrong, depth * 1.25, geometric).astype(np.float32)
    corrected = corrected_depth(aligned, geometric, SETTINGS)
    assert (error(corrected, depth * 1.25)[wrong] > 0.1).all()


def test_empty_stays_empty_and_the_paper_has_no_correction() -> None:
    _, aligned, geometric = scene()
    aligned[:20] = 0
    corrected = corrected_depth(aligned, geometric, SETTINGS)
    np.testing.assert_array_equal(corrected > 0, aligned > 0)
    np.testing.assert_array_equal(
        corrected_depth(aligned, geometric, replace(SETTINGS, local_correction=False)), aligned
    )
    np.testing.assert_array_equal(corrected_depth(aligned, np.zeros_like(geometric), SETTINGS), aligned)


def test_a_size_that_no_cell_divides_is_no_special_case() -> None:
    rng = np.random.default_rng(0)
    aligned = rng.uniform(2, 4, (37, 641)).astype(np.float32)
    corrected = corrected_depth(aligned, (1.1 * aligned).astype(np.float32), SETTINGS)
    np.testing.assert_allclose(corrected, 1.1 * aligned, rtol=0.02)


def test_each_choice_of_anchors_is_corrected_as_if_it_were_alone() -> None:
    _, aligned, geometric = scene()
    left_out = np.random.default_rng(1).random((3, *SHAPE)) < np.array([0, 0.5, 1])[:, None, None]
    corrected = corrected_without(aligned, geometric, left_out, SETTINGS)
    for index, hole in enumerate(left_out):
        alone = corrected_depth(aligned, np.where(hole, np.float32(0), geometric), SETTINGS)
        np.testing.assert_array_equal(corrected[index], alone)
    np.testing.assert_array_equal(corrected[2], aligned, "without anchors there is no correction")
    assert (corrected[0] != corrected[1]).any()


def test_infinite_and_missing_anchors_change_nothing_around_them() -> None:
    _, aligned, geometric = scene()
    plain = corrected_depth(aligned, geometric, SETTINGS)
    empty = np.argwhere(geometric == 0)
    geometric[tuple(empty[0])], geometric[tuple(empty[1])] = np.inf, np.nan
    np.testing.assert_array_equal(corrected_depth(aligned, geometric, SETTINGS), plain)
    assert np.isfinite(plain).all()
