"""Fusion and the sky: which depth a pixel gets, with which label and sigma."""

from dataclasses import replace

import numpy as np
import pytest
from refusals import refuses

from d2_plugin.priors.fuse import cross_source_discrepancy, fuse, hanging_pixels, with_matches
from d2_plugin.priors.monocular.align import Alignment, AlignStatus, aligned_inverse
from d2_plugin.priors.monocular.far import far_pixels
from d2_plugin.priors.settings import PriorSettings
from d2_plugin.protocol import Label

pytest.importorskip("cv2")


# Pixels: both agree, both disagree, only geometric, only monocular, neither.
MONO = np.array([[2.1, 3.0, 0.0, 5.0, 0.0]], np.float32)
GEOMETRIC = np.array([[2.0, 2.0, 4.0, 0.0, 0.0]], np.float32)


def test_the_discrepancy_is_relative_to_geometric_depth() -> None:
    e = cross_source_discrepancy(MONO, GEOMETRIC)
    np.testing.assert_allclose(e, [[0.05, 0.5, 1.0, np.inf, np.inf]], rtol=1e-5)
    np.testing.assert_allclose(cross_source_discrepancy(MONO * 1e3, GEOMETRIC * 1e3), e, rtol=1e-5)


def test_verified_is_strictly_below_tau_c() -> None:
    mono, geometric = np.float32([[2.0, 2.49, 2.5]]), np.full((1, 3), 2.0, np.float32)
    labels = fuse(mono, geometric, tau_c=0.25).labels
    np.testing.assert_array_equal(labels, [[Label.VERIFIED, Label.VERIFIED, Label.CONFLICT]])


def test_fusion_takes_geometric_depth_where_verified_and_monocular_where_it_is_alone() -> None:
    prior = fuse(MONO, GEOMETRIC, tau_c=0.1)
    np.testing.assert_array_equal(prior.sigma, [[0, np.inf, np.inf, np.inf, np.inf]], "the paper's")
    np.testing.assert_allclose(prior.depth, [[2, 0, 0, 5, 0]])
    assert prior.labels.tolist() == [[Label.VERIFIED, Label.CONFLICT, Label.CONFLICT, Label.MONO, Label.EMPTY]]
    assert prior.shares() == {"empty": 0.2, "mono": 0.2, "verified": 0.2, "conflict": 0.4, "agreed": 0.0, "far": 0.0}


def test_each_depth_has_the_sigma_of_its_source_and_what_has_none_is_unknown() -> None:
    sigma_mono, sigma_geometric = np.full_like(MONO, 0.2), np.full_like(MONO, 0.01)
    prior = fuse(MONO, GEOMETRIC, tau_c=0.1, sigma_mono=sigma_mono, sigma_geometric=sigma_geometric)
    np.testing.assert_allclose(prior.sigma, [[0.01, np.inf, np.inf, 0.2, np.inf]])
    medians = prior.sigmas()
    assert medians["verified"] == pytest.approx(0.01)
    assert medians["mono"] == pytest.approx(0.2)
    assert medians["conflict"] is medians["empty"] is medians["agreed"] is None


def test_verification_by_a_map_judges_each_pixel_by_its_own_tolerance() -> None:
    labels = fuse(MONO, GEOMETRIC, tau_c=np.array([[0.01, 0.6, 0.6, 0.6, 0.6]], np.float32)).labels
    np.testing.assert_array_equal(labels, [[Label.CONFLICT, Label.VERIFIED, Label.CONFLICT, Label.MONO, Label.EMPTY]])


@pytest.mark.parametrize(("wrong", "kept"), [(1, False), (2, True)])
def test_a_map_that_contradicts_more_than_stereo_is_ever_wrong_has_no_veto(wrong: int, kept: bool) -> None:
    """PyDNet contradicted half of the stereo on who walks through studio; 90 % of all it contradicted was right."""
    geometric = np.full((1, 150), 2.0, np.float32)
    geometric[0, 100:] = 0
    mono = np.full_like(geometric, 2.0)
    mono[0, :wrong] = 5
    prior = fuse(mono, geometric, tau_c=0.1, most_vetoed=0.01)
    assert (prior.labels[0, :wrong] == (Label.VERIFIED if kept else Label.CONFLICT)).all()
    assert (prior.labels[0, wrong:100] == Label.VERIFIED).all()
    assert (prior.labels[0, 100:] == Label.MONO).all()
    assert (fuse(mono, geometric, tau_c=0.1).labels[0, :wrong] == Label.CONFLICT).all(), "the paper's map may"


@pytest.mark.parametrize(
    ("variant", "depth", "labels"),
    [
        ("mono", [[2.1, 3, 0, 5, 0]], [[2, 2, 0, 2, 0]]),
        ("mvs", [[2, 2, 4, 0, 0]], [[2, 2, 2, 0, 0]]),
        ("dual_unverified", [[2, 2, 4, 5, 0]], [[2, 2, 2, 1, 0]]),
        ("dual_unaligned", [[2, 0, 0, 5, 0]], [[2, 3, 3, 1, 0]]),
    ],
)
def test_each_row_of_the_ablation_is_a_variant(variant: str, depth: list, labels: list) -> None:
    prior = fuse(MONO, GEOMETRIC, tau_c=0.1, variant=variant)
    np.testing.assert_allclose(prior.depth, depth)
    np.testing.assert_array_equal(prior.labels, labels)


def test_the_blur_of_a_depth_edge_proposes_nothing_but_still_verifies() -> None:
    row = np.interp(np.arange(120), [0, 58, 62, 119], [2.0, 2.1, 4.0, 4.2])  # a blurred step between two slanted walls
    mono = np.repeat(row[None], 20, axis=0).astype(np.float32)
    geometric = np.zeros_like(mono)
    geometric[:5] = mono[:5]
    hanging = hanging_pixels(mono, 0.08)
    assert hanging[:, 58:62].all()
    assert not hanging[:, :56].any()
    assert not hanging[:, 65:].any()
    prior = fuse(mono, geometric, tau_c=0.1, hanging=hanging)
    assert (prior.labels[:5] == Label.VERIFIED).all()
    np.testing.assert_array_equal(prior.labels[5:] == Label.EMPTY, hanging[5:])
    assert not hanging_pixels(mono, 0).any()
    mono[:, 30:40] = 0  # a hole is no edge
    assert not hanging_pixels(mono, 0.08)[:, 20:50].any()


def test_a_match_that_no_view_confirms_counts_where_the_map_does_as_far_as_the_map_knows() -> None:
    # Near, 5 sigma off, no match, no map, a map that knows nothing, one that hardly knows, stereo, near where it hangs.
    mono = np.float32([[2.0, 2.0, 2.0, 0.0, 2.0, 2.0, 2.0, 2.0]])
    sigma = np.float32([[0.04, 0.04, 0.04, np.inf, np.inf, 0.12, 0.04, 0.04]])
    unconfirmed = np.float32([[2.1, 2.5, 0.0, 2.1, 2.0, 2.0, 0.0, 1.9]])
    geometric = np.float32([[0, 0, 0, 0, 0, 0, 2.02, 0]])
    hanging = np.arange(8)[None] == 7
    uncertain = {"sigma_mono": sigma, "sigma_geometric": np.where(geometric > 0, np.float32(0.001), np.float32(np.inf))}
    fused = fuse(mono, geometric, tau_c=0.1, hanging=hanging, **uncertain)
    found = with_matches(fused, mono, sigma, unconfirmed)
    taken = np.flatnonzero((found.depth != fused.depth)[0])
    assert taken.tolist() == [0, 7], "where the map hardly knows, it and the match are one here"
    np.testing.assert_array_equal(found.depth[0, taken], unconfirmed[0, taken])
    np.testing.assert_array_equal(found.labels == Label.VERIFIED, [[True, *[False] * 5, True, True]])
    assert (found.labels[0, [1, 2, 4]] == Label.MONO).all()
    assert found.labels[0, 5] == Label.AGREED, "no stereo to rely on where the network is of no use"
    assert found.sigma[0, 5] < sigma[0, 5]
    assert (found.sigma[0, taken] > uncertain["sigma_geometric"][0, 6]).all()
    assert (found.sigma[0, taken] < sigma[0, taken]).all()
    for unit in (1e-30, 1e30):
        there = replace(fused, depth=fused.depth * np.float32(unit))
        scaled = with_matches(there, mono * np.float32(unit), sigma, unconfirmed * np.float32(unit))
        np.testing.assert_array_equal(scaled.labels, found.labels)
        np.testing.assert_allclose(scaled.sigma, found.sigma, rtol=1e-5)


def test_unknown_variants_are_refused() -> None:
    refuses("did you mean 'dual_unverified'", PriorSettings, variant="dual_unverifed")


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


def test_fewer_than_four_kinds_of_evidence_are_no_sky() -> None:
    inverse, geometric, image = scene()
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    sky, speck = rows < HORIZON, (rows < 8) & (columns < 8)
    rim = (rows < 6) | (columns < 6) | (columns >= WIDTH - 6)
    texture = np.random.default_rng(1).integers(0, 256, image.shape).astype(np.uint8)
    without_one = {
        "within the range of stereo": (np.where(sky, 1 / WALL, inverse), geometric, image),
        "no anchors": (inverse, 0 * geometric, image),
        "measured": (inverse, np.full_like(geometric, WALL), image),
        "not at the rim": (np.where(rim, 1 / WALL, inverse), np.where(rim, np.float32(WALL), geometric), image),
        "textured": (inverse, geometric, np.where(sky[..., None], texture, image)),
        "a speck": (np.where(sky & ~speck, 1 / WALL, inverse), geometric, image),
    }
    assert [what for what, maps in without_one.items() if far_pixels(*maps).any()] == []


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
