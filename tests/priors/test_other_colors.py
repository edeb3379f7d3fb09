"""A pixel that shows another colour than the surface whose depth it took has no stereo; all others keep theirs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from prior_cases import camera_at

from d2_plugin.priors.other_colors import without_other_colors
from d2_plugin.priors.settings import PriorSettings
from d2_plugin.protocol import Label
from d2_plugin.recordings.recording import Camera
from d2_plugin.store.maps import FusedPrior

pytest.importorskip("cv2")

WIDTH, HEIGHT, WALL, POLE = 80, 60, 4.0, 2.0
CAMERAS = {name: camera_at((x, 0, 0), size=(WIDTH, HEIGHT), focal=64) for name, x in (("left", 0), ("right", 0.5))}
LIMIT = PriorSettings().color_limit
WALL_COLOR, POLE_COLOR = (140, 120, 100), (60, 120, 200)


def views(pole_depth: float, exposure: float = 1.0, unit: float = 1.0) -> dict[str, FusedPrior]:
    """A wall, and a pole of two columns before it whose pixels have `pole_depth` in the left view, its own in the right
    one, which is `exposure` times as bright."""
    found = {}
    for name, column in (("left", 40), ("right", 40 - int(64 * 0.5 / POLE))):
        colors = np.full((HEIGHT, WIDTH, 3), WALL_COLOR, np.float64)
        depth = np.full((HEIGHT, WIDTH), WALL * unit, np.float32)
        colors[:, column : column + 2] = POLE_COLOR
        depth[:, column : column + 2] = unit * (pole_depth if name == "left" else POLE)
        colors *= exposure if name == "right" else 1.0
        labels = np.full(depth.shape, int(Label.VERIFIED), np.uint8)
        found[name] = FusedPrior(depth, labels, np.full(depth.shape, 0.01, np.float32), colors.round().astype(np.uint8))
    return found


def cameras(unit: float) -> dict[str, Camera]:
    return {
        name: camera_at((x, 0, 0), size=(WIDTH, HEIGHT), focal=64) for name, x in (("left", 0), ("right", 0.5 * unit))
    }


@pytest.mark.parametrize("exposure", [0.6, 1.0, 1.2])
@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_a_pole_with_the_depth_of_the_wall_behind_it_has_none(exposure: float, unit: float) -> None:
    given = views(WALL, exposure, unit)
    found = without_other_colors(given, cameras(unit), LIMIT)["left"]
    assert (found.labels[:, 40:42] == Label.EMPTY).all()
    assert (found.depth[:, 40:42] == 0).all()
    assert np.isinf(found.sigma[:, 40:42]).all()
    np.testing.assert_array_equal(np.delete(found.labels, [40, 41], 1), np.uint8(Label.VERIFIED))
    np.testing.assert_array_equal(np.delete(found.depth, [40, 41], 1), np.delete(given["left"].depth, [40, 41], 1))


@pytest.mark.parametrize("exposure", [0.6, 1.0, 1.2])
def test_a_pole_with_its_own_depth_keeps_it(exposure: float) -> None:
    for name, found in without_other_colors(views(POLE, exposure), CAMERAS, LIMIT).items():
        assert (found.labels == Label.VERIFIED).all(), name


def test_where_cameras_differ_by_more_than_exposure_a_colour_must_be_farther_off() -> None:
    given = views(WALL)
    colors = given["right"].colors.copy()
    colors[: HEIGHT // 3] += 12  # as a real camera's do that sees the light there at another angle
    given["right"] = replace(given["right"], colors=colors)
    found = without_other_colors(given, CAMERAS, LIMIT)["left"]
    assert (found.labels[:, 40:42] == Label.EMPTY).all()
    np.testing.assert_array_equal(np.delete(found.labels, [40, 41], 1), np.uint8(Label.VERIFIED))


def test_what_no_other_camera_knows_cannot_be_told() -> None:
    given = views(WALL)
    given["right"] = replace(given["right"], depth=0 * given["right"].depth, labels=0 * given["right"].labels)
    assert (without_other_colors(given, CAMERAS, LIMIT)["left"].labels == Label.VERIFIED).all()
    mono = {name: replace(view, labels=np.full_like(view.labels, int(Label.MONO))) for name, view in given.items()}
    assert (without_other_colors(mono, CAMERAS, LIMIT)["left"].labels == Label.MONO).all()
    blind = {name: replace(view, colors=None) for name, view in views(WALL).items()}
    assert without_other_colors(blind, CAMERAS, LIMIT) == blind


def test_the_paper_compares_no_colours() -> None:
    assert PriorSettings.paper().color_limit == 0
