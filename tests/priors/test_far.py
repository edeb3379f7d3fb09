"""Sky is found from four kinds of evidence together, and never from fewer."""

from __future__ import annotations

import numpy as np
import pytest

from d2_plugin.priors.monocular.align import Alignment, AlignStatus, aligned_inverse
from d2_plugin.priors.monocular.far import far_pixels

pytest.importorskip("cv2")

HEIGHT, WIDTH, HORIZON, WALL = 90, 160, 40, 10.0


def scene() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Inverse depth, geometric depth and image of a smooth sky above a textured wall that stereo measured."""
    rng = np.random.default_rng(0)
    inverse = np.full((HEIGHT, WIDTH), 1 / WALL)
    inverse[:HORIZON] = 1e-3 * rng.standard_normal((HORIZON, WIDTH)) / WALL
    geometric = np.zeros((HEIGHT, WIDTH), np.float32)
    geometric[HORIZON:] = WALL
    image = rng.integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    image[:HORIZON] = np.array([150, 180, 230]) + np.arange(HORIZON)[:, None, None] // 2
    return inverse, geometric, image


def test_a_smooth_sky_above_a_wall_is_found_and_nothing_else() -> None:
    far = far_pixels(*scene())
    assert far[: HORIZON - 4].all()
    assert not far[HORIZON:].any()


@pytest.mark.parametrize("unit", [1e-3, 1e6])
def test_the_unit_of_the_world_does_not_matter(unit: float) -> None:
    inverse, geometric, image = scene()
    np.testing.assert_array_equal(far_pixels(inverse / unit, geometric * unit, image), far_pixels(*scene()))


def test_the_sky_grows_to_the_outline_that_a_blurred_map_gives_it_as_far_as_its_colour_goes() -> None:
    inverse, geometric, image = scene()
    inverse[HORIZON - 8 : HORIZON] = 0.7 / WALL
    assert far_pixels(inverse, geometric, image)[: HORIZON - 4].all()
    image[HORIZON - 8 : HORIZON] = (90, 40, 20)
    assert not far_pixels(inverse, geometric, image)[HORIZON - 8 :].any()


def no_sky(what: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The scene with one kind of evidence gone."""
    inverse, geometric, image = scene()
    if what == "within the range of stereo":
        inverse[:HORIZON] = 1 / WALL
    elif what == "no anchors":
        geometric[:] = 0
    elif what == "measured":
        geometric[:] = WALL
    elif what == "not at the rim":
        for map_, wall in ((inverse, 1 / WALL), (geometric, WALL)):
            map_[:6] = map_[:, :6] = map_[:, -6:] = wall
    elif what == "textured":
        image[:HORIZON] = np.random.default_rng(1).integers(0, 256, (HORIZON, WIDTH, 3))
    else:
        inverse[:HORIZON, 8:] = 1 / WALL
        inverse[8:HORIZON] = 1 / WALL
    return inverse, geometric, image


@pytest.mark.parametrize(
    "what", ["within the range of stereo", "no anchors", "measured", "not at the rim", "textured", "a speck"]
)
def test_fewer_than_four_kinds_of_evidence_are_no_sky(what: str) -> None:
    assert not far_pixels(*no_sky(what)).any()


def test_the_zeros_of_a_saturated_network_are_far_whatever_the_shift() -> None:
    inverse, geometric, image = scene()
    mono = np.where(inverse > 0.5 / WALL, inverse - 0.05, 0)  # a ReLU cut off everything far
    alignment = Alignment(AlignStatus.OK, "relative", scale=1.0, shift=0.05)
    far = far_pixels(aligned_inverse(mono, alignment), geometric, image)
    assert far[: HORIZON - 4].all()
    assert not far[HORIZON:].any()


def test_a_metric_map_that_puts_the_sky_far_away_finds_it_and_one_that_says_nothing_does_not() -> None:
    _, geometric, image = scene()
    depth = np.where(np.arange(HEIGHT)[:, None] < HORIZON, 1e4, WALL) * np.ones((1, WIDTH))
    alignment = Alignment(AlignStatus.OK, "metric", scale=1.0, shift=0.0)
    assert far_pixels(aligned_inverse(depth, alignment), geometric, image)[: HORIZON - 4].all()
    for nothing in (0.0, np.nan, -1.0):
        unknown = np.where(depth > WALL, nothing, depth)
        assert not far_pixels(aligned_inverse(unknown, alignment), geometric, image).any()


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1), (3, 3)])
def test_images_of_a_pixel_or_a_row_are_possible(shape: tuple[int, int]) -> None:
    far = far_pixels(np.zeros(shape), np.full(shape, 2.0, np.float32), np.zeros((*shape, 3), np.uint8))
    assert far.shape == shape
    assert not far.any()
