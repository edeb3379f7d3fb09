"""Monocular depth beyond its anchors: local correction, and the declared sigma, which holds or is infinite."""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from prior_cases import camera_at

from d2_plugin.priors.construct import ViewSources, construct
from d2_plugin.priors.fuse import fuse
from d2_plugin.priors.monocular.align import align, aligned_depth
from d2_plugin.priors.monocular.correct import corrected_depth
from d2_plugin.priors.monocular.extrapolation import extrapolation_error
from d2_plugin.priors.monocular.settings import AlignSettings
from d2_plugin.priors.monocular.uncertainty import monocular_uncertainty
from d2_plugin.priors.settings import PriorSettings
from d2_plugin.priors.stereo.filtering.filter import GeometricDepth
from d2_plugin.protocol import Label
from d2_plugin.recordings.recording import MonoKind
from d2_plugin.recordings.synthetic.room import synthetic_recording
from d2_plugin.store.maps import FusedPrior

cv2 = pytest.importorskip("cv2")
SETTINGS = AlignSettings()


class Scene(NamedTuple):
    """One view of the rendered room; maps [H, W]."""

    truth: np.ndarray
    anchors: np.ndarray
    """True depth in patches away from edges, as stereo finds it, with an error of .001; 0 between them."""
    aligned: np.ndarray
    """The emulated monocular map, aligned."""
    other: np.ndarray
    """The map of another camera and frame, aligned to these anchors."""


@pytest.fixture(scope="module")
def scenes() -> list[Scene]:
    return [room(seed) for seed in range(4)]


def room(seed: int) -> Scene:
    recording = synthetic_recording(cameras=4, held_out=0, frames=5, width=240, height=135, seed=seed)
    truth, random = recording.depth("train1", 0), np.random.default_rng(seed)
    blobs = cv2.GaussianBlur(random.standard_normal(truth.shape), (0, 0), 12)
    edge = cv2.dilate(np.abs(cv2.Laplacian(np.log(truth), cv2.CV_32F)), np.ones((5, 5))) > 0.05
    noisy = truth * np.exp(0.001 * random.standard_normal(truth.shape))
    anchors = np.where((blobs > np.quantile(blobs, 0.6)) & ~edge, noisy, 0).astype(np.float32)
    return Scene(truth, anchors, *(aligned(recording.mono(*view), anchors) for view in (("train1", 0), ("train3", 4))))


def aligned(mono: np.ndarray, anchors: np.ndarray) -> np.ndarray:
    alignment = align(mono, anchors, kind="relative", settings=SETTINGS)
    assert alignment.accepted
    return aligned_depth(mono, alignment, 30.0)


def held(scene: Scene, map_: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(|log error| of the corrected map, its declared sigma) at the pixels without an anchor."""
    alone = (scene.anchors == 0) & (map_ > 0)
    depth = corrected_depth(map_, scene.anchors, SETTINGS)
    sigma = monocular_uncertainty(map_, scene.anchors, SETTINGS).sigma
    return np.abs(np.log(depth[alone] / scene.truth[alone])), sigma[alone]


def holds(error: np.ndarray, sigma: np.ndarray) -> bool:
    """Calibrated: 60 to 85 % within sigma, at least 90 % within two."""
    return 0.60 <= (error <= sigma).mean() <= 0.85 and (error <= 2 * sigma).mean() >= 0.90


def test_the_declared_sigma_holds_and_one_twice_too_large_or_small_would_not(scenes: list[Scene]) -> None:
    error, sigma = (np.concatenate(values) for values in zip(*(held(scene, scene.aligned) for scene in scenes)))
    assert np.isfinite(sigma).mean() > 0.99
    assert holds(error, sigma)
    assert not holds(error, sigma / 2)
    assert not holds(error, sigma * 2)
    sure = sigma < np.median(sigma)
    assert np.quantile(error[~sure], 0.68) > 1.3 * np.quantile(error[sure], 0.68), "larger where it says so"


def bad_map(scene: Scene, what: str) -> np.ndarray:
    """A map that knows less than it should, of about the right depth."""
    middle, random = np.median(scene.anchors[scene.anchors > 0]), np.random.default_rng(1)
    if what == "noise":
        return (middle * np.exp(0.3 * random.standard_normal(scene.truth.shape))).astype(np.float32)
    return np.full_like(scene.truth, middle) if what == "constant" else scene.other


@pytest.mark.parametrize("what", ["noise", "constant", "another frame"])
def test_a_map_that_knows_less_declares_more_and_still_holds(scenes: list[Scene], what: str) -> None:
    errors, sigmas = [], []
    for scene in scenes:
        error, sigma = held(scene, bad_map(scene, what))
        assert np.median(sigma) > 1.15 * np.median(held(scene, scene.aligned)[1])
        errors.append(error)
        sigmas.append(sigma)
    error, sigma = np.concatenate(errors), np.concatenate(sigmas)
    assert np.median(sigma) > np.median(error)
    assert (error <= sigma).mean() > 0.6
    # Of a constant map no edge is known, at which errors are larger: it is the least well judged (and no alignment
    # accepts one).
    assert (error <= 2 * sigma).mean() > (0.8 if what == "constant" else 0.9)


def test_a_map_that_says_less_than_its_anchors_proposes_at_most(scenes: list[Scene]) -> None:
    for scene in scenes:
        found = monocular_uncertainty(bad_map(scene, "noise"), scene.anchors, SETTINGS)
        assert found.skill.nil
        assert np.isinf(found.sigma).all()
        assert np.isfinite(found.at_anchors).all(), "it must not veto right stereo"
        assert monocular_uncertainty(scene.aligned, scene.anchors, SETTINGS).skill.gain > 1 > found.skill.gain


def test_a_map_that_says_nothing_of_a_pixel_contradicts_no_stereo_there(scenes: list[Scene]) -> None:
    anchors, hole = scenes[0].anchors, np.zeros(scenes[0].anchors.shape, bool)
    hole[tuple(np.argwhere(anchors > 0)[::200].T)] = True
    mono = np.where(hole, np.nan, 1 / scenes[0].aligned).astype(np.float32)
    sigma = np.where(anchors > 0, np.float32(0.01), np.float32(np.inf))
    geometric = GeometricDepth(anchors, sigma, np.zeros_like(sigma), {})
    view = ViewSources(np.zeros((*hole.shape, 3), np.uint8), geometric, mono)
    prior = construct({"": view}, {"": camera_at(size=hole.shape[::-1])}, PriorSettings(), "relative")[""]
    assert (prior.maps.labels[hole] == Label.VERIFIED).all()


def test_a_confidence_spreads_sigma_and_does_not_change_what_errors_say_of_its_size(scenes: list[Scene]) -> None:
    scene = scenes[0]
    plain = monocular_uncertainty(scene.aligned, scene.anchors, SETTINGS)
    same = monocular_uncertainty(scene.aligned, scene.anchors, SETTINGS, np.full_like(scene.aligned, 0.25))
    np.testing.assert_allclose(same.sigma, plain.sigma, rtol=1e-4)
    half = np.ones_like(scene.aligned)
    half[:, :120] = 0.5
    ratio = monocular_uncertainty(scene.aligned, scene.anchors, SETTINGS, half).sigma / plain.sigma
    finite = np.isfinite(ratio)
    left, right = (np.median(ratio[:, part][finite[:, part]]) for part in (slice(0, 118), slice(122, None)))
    assert left == pytest.approx(2 * right, rel=0.01)
    half[:, :120] = 0
    assert np.isinf(monocular_uncertainty(scene.aligned, scene.anchors, SETTINGS, half).sigma[:, :118]).all()


def test_the_unit_of_the_world_does_not_matter(scenes: list[Scene]) -> None:
    scene, unit = scenes[0], 1e6
    found = monocular_uncertainty((scene.aligned * unit).astype(np.float32), scene.anchors * np.float32(unit), SETTINGS)
    expected = monocular_uncertainty(scene.aligned, scene.anchors, SETTINGS)
    # The corrected map is float32, and its logarithm near 14 exact to 1e-6: small spans of it are differences of those.
    np.testing.assert_allclose(found.sigma, expected.sigma, rtol=1e-4)
    np.testing.assert_allclose(found.at_anchors, expected.at_anchors, rtol=1e-4)
    assert found.skill == pytest.approx(expected.skill, rel=1e-4)


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (7, 5)])
@pytest.mark.parametrize("anchors", ["none", "one", "all"])
def test_small_images_and_few_anchors_declare_nothing(shape: tuple[int, int], anchors: str) -> None:
    depth = np.full(shape, 3.0, np.float32)
    known = np.zeros_like(depth)
    if anchors == "one":
        known[0, 0] = 3.0
    found = monocular_uncertainty(depth, depth if anchors == "all" else known, SETTINGS)
    assert np.isinf(found.sigma).all()
    assert np.isinf(found.at_anchors).all()
    assert np.isnan(found.skill.scale)
    assert found.skill.as_json() == {"scale": None, "error": None, "gain": None, "tail": None}


def test_too_few_anchors_declare_nothing_however_large_the_image(scenes: list[Scene]) -> None:
    few = np.zeros_like(scenes[0].anchors)
    few[::40, ::40] = scenes[0].truth[::40, ::40]
    for settings in (SETTINGS, AlignSettings(min_anchors=0)):
        assert np.isinf(monocular_uncertainty(scenes[0].aligned, few, settings).sigma).all()


ROWS = np.arange(135)[:, None]
WIDE = np.geomspace(1e-3, 1e6, 135 * 240).reshape(135, 240)

STIFF: dict[str, Callable[[Scene], tuple[np.ndarray, np.ndarray]]] = {
    "anchors at one depth": lambda scene: (scene.aligned, np.where(scene.anchors > 0, 4, 0)),
    "one row of anchors": lambda scene: (scene.aligned, np.where(ROWS == 60, scene.truth, 0)),
    "anchors everywhere": lambda scene: (scene.aligned, scene.truth),
    "a map with zeros": lambda scene: (np.where((ROWS < 50) | (ROWS % 3 == 0), 0, scene.aligned), scene.anchors),
    "a map without any error": lambda scene: (scene.truth, np.where(scene.anchors > 0, scene.truth, 0)),
    "an empty map": lambda scene: (0 * scene.aligned, scene.anchors),
    "depths from 1e-3 to 1e6": lambda scene: (WIDE, np.where(scene.anchors > 0, 1.01 * WIDE, 0)),
}


@pytest.mark.parametrize("stiff", STIFF.values(), ids=STIFF)
def test_stiff_cases_give_a_standard_deviation_or_infinity_and_no_warning(scenes, stiff) -> None:
    aligned, anchors = (map_.astype(np.float32) for map_ in stiff(scenes[2]))
    found = monocular_uncertainty(aligned, anchors, SETTINGS)
    for sigma in (found.sigma, found.at_anchors):
        assert sigma.dtype == np.float32
        assert sigma.shape == aligned.shape
        assert not np.isnan(sigma).any()
        assert (sigma >= 0).all()
    assert np.isinf(found.sigma[aligned == 0]).all()


def verified(scene: Scene, map_: np.ndarray, geometric: np.ndarray, sigmas: float, sigma: float) -> FusedPrior:
    """Fusion by likelihood, as the construction does it, with the geometric sigma given."""
    found = monocular_uncertainty(map_, scene.anchors, SETTINGS)
    stereo = np.where(geometric > 0, sigma, np.inf)
    depth = corrected_depth(map_, scene.anchors, SETTINGS)
    tolerance = sigmas * np.hypot(found.at_anchors, stereo)
    return fuse(depth, geometric, tau_c=tolerance, sigma_mono=found.sigma, sigma_geometric=stereo.astype(np.float32))


def test_a_network_that_is_noise_does_not_veto_right_stereo_as_the_fixed_threshold_does(scenes: list[Scene]) -> None:
    for scene in scenes:
        noise = bad_map(scene, "noise")
        by_likelihood = verified(scene, noise, scene.anchors, 3.0, 0.001)
        fixed = fuse(corrected_depth(noise, scene.anchors, SETTINGS), scene.anchors, tau_c=0.1)
        vetoed, others = (p.labels[scene.anchors > 0] == Label.CONFLICT for p in (by_likelihood, fixed))
        assert vetoed.mean() < 0.02 < 0.4 < others.mean()


def test_a_good_network_vetoes_an_error_that_the_fixed_threshold_lets_pass() -> None:
    """A map exact to .1 %, and stereo that is off by 4 % at a few pixels."""
    random = np.random.default_rng(0)
    rows, columns = np.mgrid[:120, :160]
    truth = (3 + rows / 60 + columns / 80).astype(np.float32)
    good = (truth * np.exp(0.001 * random.standard_normal(truth.shape))).astype(np.float32)
    wrong = random.random(truth.shape) < 0.002
    anchors = np.where(wrong, truth * 1.04, truth).astype(np.float32)
    by_likelihood = verified(Scene(truth, anchors, good, good), good, anchors, 3.0, 0.001)
    assert (by_likelihood.labels[wrong] == Label.CONFLICT).all()
    assert (by_likelihood.labels[~wrong] == Label.VERIFIED).mean() > 0.99
    assert (fuse(corrected_depth(good, anchors, SETTINGS), anchors, tau_c=0.1).labels[wrong] == Label.VERIFIED).all()


def test_a_map_that_misses_some_things_is_less_sure_everywhere_and_vetoes_less(scenes: list[Scene]) -> None:
    """A tenth of the image, in blocks of a tenth of its width, is off by a factor of two."""
    for scene in scenes[:3]:
        random = np.random.default_rng(5)
        height, width = scene.truth.shape
        missed = np.kron(random.random((9, 15)) < 0.1, np.ones((15, 16))).astype(bool)[:height, :width]
        map_ = np.where(missed, 2 * scene.aligned, scene.aligned)
        good, weak = (monocular_uncertainty(m, scene.anchors, SETTINGS) for m in (scene.aligned, map_))
        assert good.skill.tail < 1.4
        assert weak.skill.tail > 1.5 * good.skill.tail
        # Beyond what the scale, the 68 % quantile, says by itself.
        enlarged = np.median(weak.at_anchors[~missed] / good.at_anchors[~missed])
        assert enlarged > 1.3 * weak.skill.scale / good.skill.scale


FAR = 12.0
KINDS: tuple[MonoKind, ...] = ("relative", "metric")


def bent_scene(kind: MonoKind, bend: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(aligned map, anchors, true depth): depth 2 to 12 from left to right, anchors where it is below 4."""
    truth = np.tile(np.geomspace(2, FAR, 160), (90, 1))
    anchors = np.where(truth < 4, truth, 0).astype(np.float32)
    prediction = (1 / truth if kind == "relative" else truth) ** (1 + bend)
    fit = align(prediction, anchors, kind=kind, settings=SETTINGS)
    assert fit.accepted
    return aligned_depth(prediction, fit, np.inf), anchors, truth


@pytest.mark.parametrize("kind", KINDS)
def test_a_map_that_is_a_line_is_sure_everywhere(kind: MonoKind) -> None:
    aligned, anchors, _ = bent_scene(kind, bend=0.0)
    assert extrapolation_error(aligned, anchors, kind, SETTINGS).max() < 1e-3


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("bend", [-0.05, 0.05, 0.1])
def test_of_a_bent_map_it_tells_the_size_of_the_error(kind: MonoKind, bend: float) -> None:
    aligned, anchors, truth = bent_scene(kind, bend)
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
    assert np.isinf(extrapolation_error(aligned, anchors, "metric", SETTINGS)[truth > 8]).all()


def test_the_declared_sigma_contains_it() -> None:
    aligned, anchors, truth = bent_scene("relative", 0.1)
    sigma = monocular_uncertainty(aligned, anchors, SETTINGS).sigma
    told = extrapolation_error(aligned, anchors, "relative", SETTINGS)
    beyond = (truth > 6) & (aligned > 0)
    assert (sigma[beyond] >= told[beyond] * (1 - 1e-5)).all()
    assert np.median(told[beyond]) > 3 * np.median(sigma[(truth > 2.2) & (truth < 3.8)])


SHAPE = (90, 160)


def anchored_scene() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """True depth, aligned monocular depth bent by a smooth 8 %, and geometric depth at a third of the pixels."""
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    depth = (3 + u / 80 + (v > 45)).astype(np.float32)
    bend = 0.08 * np.sin(u / 40 + 1) * np.cos(v / 30)
    geometric = np.where(np.random.default_rng(0).random(SHAPE) < 0.33, depth, 0).astype(np.float32)
    return depth, (depth * np.exp(bend)).astype(np.float32), geometric


def error_of(estimate: np.ndarray, truth: np.ndarray) -> np.ndarray:
    return np.abs(estimate - truth) / truth


def test_a_smooth_bend_is_undone() -> None:
    depth, aligned, geometric = anchored_scene()
    corrected = corrected_depth(aligned, geometric, SETTINGS)
    assert corrected.dtype == np.float32
    assert np.median(error_of(corrected, depth)) < 0.15 * np.median(error_of(aligned, depth))


def test_a_patch_of_wrong_anchors_stays_in_conflict() -> None:
    depth, aligned, geometric = anchored_scene()
    wrong = np.zeros(SHAPE, bool)
    wrong[40:46, 70:76] = True
    geometric = np.where(wrong, depth * 1.25, geometric).astype(np.float32)
    assert (error_of(corrected_depth(aligned, geometric, SETTINGS), depth * 1.25)[wrong] > 0.1).all()


def test_empty_stays_empty_and_the_paper_has_no_correction() -> None:
    _, aligned, geometric = anchored_scene()
    aligned[:20] = 0
    corrected = corrected_depth(aligned, geometric, SETTINGS)
    np.testing.assert_array_equal(corrected > 0, aligned > 0)
    papers = replace(SETTINGS, local_correction=False)
    np.testing.assert_array_equal(corrected_depth(aligned, geometric, papers), aligned)
    np.testing.assert_array_equal(corrected_depth(aligned, np.zeros_like(geometric), SETTINGS), aligned)


def test_a_size_that_no_cell_divides_is_no_special_case() -> None:
    aligned = np.random.default_rng(0).uniform(2, 4, (37, 641)).astype(np.float32)
    corrected = corrected_depth(aligned, (1.1 * aligned).astype(np.float32), SETTINGS)
    np.testing.assert_allclose(corrected, 1.1 * aligned, rtol=0.02)


def test_infinite_and_missing_anchors_change_nothing_around_them() -> None:
    _, aligned, geometric = anchored_scene()
    plain = corrected_depth(aligned, geometric, SETTINGS)
    empty = np.argwhere(geometric == 0)
    geometric[tuple(empty[0])], geometric[tuple(empty[1])] = np.inf, np.nan
    np.testing.assert_array_equal(corrected_depth(aligned, geometric, SETTINGS), plain)
    assert np.isfinite(plain).all()
