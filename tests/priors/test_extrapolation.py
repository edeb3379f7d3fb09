"""Beyond the depths of its anchors a map is as sure as the lines of parts of the anchors agree."""

from __future__ import annotations

import numpy as np
import pytest

from d2_plugin.priors.monocular.align import align, aligned_depth
from d2_plugin.priors.monocular.extrapolation import extrapolation_error
from d2_plugin.priors.monocular.settings import AlignSettings
from d2_plugin.priors.monocular.uncertainty import monocular_uncertainty
from d2_plugin.recordings.recording import MonoKind

SETTINGS = AlignSettings()
FAR = 12.0
KINDS: tuple[MonoKind, ...] = ("relative", "metric")


def scene(kind: MonoKind, bend: float, measured: float = 4.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(aligned map, anchors, true depth): depth 2 to 12 from left to right, anchors where it is below `measured`."""
    truth = np.tile(np.geomspace(2, FAR, 160), (90, 1))
    anchors = np.where(truth < measured, truth, 0).astype(np.float32)
    prediction = (1 / truth if kind == "relative" else truth) ** (1 + bend)
    fit = align(prediction, anchors, kind=kind, settings=SETTINGS)
    assert fit.accepted
    return aligned_depth(prediction, fit, np.inf), anchors, truth


@pytest.mark.parametrize("kind", KINDS)
def test_a_map_that_is_a_line_is_sure_everywhere(kind: MonoKind) -> None:
    aligned, anchors, _ = scene(kind, bend=0.0)
    assert extrapolation_error(aligned, anchors, kind, SETTINGS).max() < 1e-3


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("bend", [-0.05, 0.05, 0.1])
def test_of_a_bent_map_it_tells_the_size_of_the_error(kind: MonoKind, bend: float) -> None:
    aligned, anchors, truth = scene(kind, bend)
    told = extrapolation_error(aligned, anchors, kind, SETTINGS)
    assert (told[(truth > 2.2) & (truth < 3.8)] == 0).all(), "between the anchors nothing is extrapolated"
    row = told[0][(truth[0] > 4) & (aligned[0] > 0)]
    assert (np.diff(row) >= -1e-9).all(), "the farther beyond, the less sure"
    beyond = (truth > 6) & (aligned > 0) & np.isfinite(told)
    error = np.abs(np.log(aligned[beyond] / truth[beyond]))
    # Lines of thirds part as the distance, the bend goes as its square: three times farther than any anchor, a metric
    # map is off by more than they tell. Inverse depth has not far to go.
    least = 0.4 if kind == "relative" else 0.15
    assert least < np.median(told[beyond] / error) < 2.5


def test_a_line_that_turns_around_without_a_third_says_nothing_beyond() -> None:
    truth = np.tile(np.geomspace(2, FAR, 160), (90, 1))
    aligned = truth.copy()
    anchors = np.where(truth < 4, truth, 0)
    near = (anchors > 0) & (anchors < np.quantile(anchors[anchors > 0], 2 / 3))
    aligned[near] = 5.0 - truth[near]  # falls where depth rises, but for the farthest third
    told = extrapolation_error(aligned, anchors, "metric", SETTINGS)
    assert np.isinf(told[truth > 8]).all()


def test_without_anchors_there_is_nothing_to_say() -> None:
    nothing = np.zeros((9, 16))
    assert (extrapolation_error(np.ones((9, 16)), nothing, "relative", SETTINGS) == 0).all()
    assert (extrapolation_error(nothing, np.ones((9, 16)), "relative", SETTINGS) == 0).all()


def test_the_declared_sigma_contains_it() -> None:
    aligned, anchors, truth = scene("relative", 0.1)
    sigma = monocular_uncertainty(aligned, anchors, SETTINGS).sigma
    told = extrapolation_error(aligned, anchors, "relative", SETTINGS)
    beyond = (truth > 6) & (aligned > 0)
    assert (sigma[beyond] >= told[beyond] * (1 - 1e-5)).all()
    assert np.median(told[beyond]) > 3 * np.median(sigma[(truth > 2.2) & (truth < 3.8)])
