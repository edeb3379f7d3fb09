"""Mono-only depth compared with other cameras: surfaces are taken, maps that meet agree, the rest stays as it is."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from prior_cases import camera_at, plane_seen_by

from d2_plugin.priors.build import build_priors
from d2_plugin.priors.cross_view.kernel import BESIDE, LIKE, NEAR, WITHIN
from d2_plugin.priors.evidence import AGREED, ALONE, AT_BEST, with_evidence
from d2_plugin.priors.settings import PriorSettings
from d2_plugin.protocol import Label
from d2_plugin.recordings.synthetic.room import synthetic_recording
from d2_plugin.store.maps import FusedPrior
from d2_plugin.store.store import PriorStore

pytest.importorskip("cv2")

WIDTH, HEIGHT, WALL, SIGMA = 40, 30, 4.0, 0.05
TOLERANCE = 0.02
CAMERAS = {name: camera_at((x, 0, 0), size=(WIDTH, HEIGHT), focal=30) for name, x in (("left", 0), ("right", 0.5))}


def slanted(name: str) -> np.ndarray:
    """Depth [H, W] of the plane z = 4 + 0.3 x - 0.2 y in a camera."""
    return plane_seen_by(CAMERAS[name], (-0.3, 0.2, 1), WALL)


def prior_of(depth: np.ndarray | float, label: Label = Label.MONO, sigma: float = SIGMA) -> FusedPrior:
    """One label everywhere."""
    depth = np.broadcast_to(np.asarray(depth, np.float32), (HEIGHT, WIDTH)).copy()
    return FusedPrior(depth, np.full(depth.shape, int(label), np.uint8), np.full(depth.shape, sigma, np.float32))


def left_of(left: FusedPrior, right: FusedPrior) -> FusedPrior:
    """The left view compared with the right one."""
    return with_evidence({"left": left, "right": right}, CAMERAS, TOLERANCE)["left"]


def painted(prior: FusedPrior, color: int) -> FusedPrior:
    return replace(prior, colors=np.full((HEIGHT, WIDTH, 3), color, np.uint8))


def share(prior: FusedPrior, label: Label) -> float:
    return float((prior.labels == label).mean())


def test_maps_that_put_a_wall_at_one_place_agree_where_both_cameras_see_it() -> None:
    agreed = with_evidence({"left": prior_of(WALL), "right": prior_of(WALL)}, CAMERAS, TOLERANCE)
    shift = 30 * 0.5 / WALL  # pixels between the two images
    for prior in agreed.values():
        assert share(prior, Label.AGREED) == pytest.approx(1 - shift / WIDTH, abs=1 / WIDTH)
        both = prior.labels == Label.AGREED
        np.testing.assert_allclose(prior.sigma[both], np.hypot(AGREED * SIGMA, AT_BEST), rtol=1e-6)
        np.testing.assert_allclose(prior.sigma[~both], SIGMA, rtol=1e-6)
        np.testing.assert_array_equal(prior.depth, np.float32(WALL))
    assert (agreed["left"].labels[:, : int(shift)] == Label.MONO).all(), "what one camera alone sees stays mono-only"


def test_maps_that_differ_by_more_than_the_tolerance_do_not_and_both_are_less_sure() -> None:
    compared = with_evidence({"left": prior_of(WALL), "right": prior_of(WALL * 1.03)}, CAMERAS, TOLERANCE)
    for prior in compared.values():
        assert share(prior, Label.MONO) == 1
        np.testing.assert_allclose(np.unique(prior.sigma), [SIGMA, ALONE * SIGMA], rtol=1e-6)


@pytest.mark.parametrize("factor", [0.96, 0.99, 1.0, 1.02, 1.05])
def test_a_surface_that_another_camera_verified_is_taken_along_the_ray_and_is_no_stereo_of_its_own(factor) -> None:
    truth, theirs = slanted("left"), slanted("right")
    compared = left_of(prior_of(truth * factor), prior_of(theirs, Label.VERIFIED, 0.001))
    met = compared.labels == Label.AGREED
    assert met[2:-2, 8:-2].all(), "the right camera sees all but the columns at the left"
    assert not met[:, 0].any()
    np.testing.assert_allclose(compared.depth[met], truth[met], rtol=1e-3)
    expected = np.hypot(0.001, BESIDE * np.abs(np.log(factor)))
    np.testing.assert_allclose(compared.sigma[met], expected, rtol=0.05, atol=2e-4)
    beside = ~met
    np.testing.assert_array_equal(compared.depth[beside], (truth * factor).astype(np.float32)[beside])


@pytest.mark.parametrize(
    ("sigma", "away", "taken"),
    [
        (0.02, 0.9 * WITHIN * 0.02, True),
        (0.02, 1.1 * WITHIN * 0.02, False),
        (0.4, 0.9 * NEAR, True),
        (0.4, 1.1 * NEAR, False),
        (np.inf, 0.9 * NEAR, True),
        (np.inf, 1.1 * NEAR, False),
    ],
)
def test_a_surface_farther_than_sigma_or_than_near_is_another_surface(sigma: float, away: float, taken: bool) -> None:
    truth, theirs = slanted("left"), slanted("right")
    compared = left_of(prior_of(truth * np.exp(away), sigma=sigma), prior_of(theirs, Label.VERIFIED, 0.001))
    assert (share(compared, Label.AGREED) > 0.5) == taken
    assert (share(compared, Label.AGREED) == 0) != taken


def test_what_nothing_is_known_of_stays_unknown_however_well_two_maps_agree() -> None:
    compared = left_of(prior_of(WALL, sigma=np.inf), prior_of(WALL, sigma=np.inf))
    assert share(compared, Label.AGREED) > 0.5
    assert np.isinf(compared.sigma).all()


@pytest.mark.parametrize("label", [Label.FAR, Label.AGREED, Label.EMPTY, Label.CONFLICT])
def test_far_and_empty_pixels_have_no_say_and_agreed_ones_do(label: Label) -> None:
    compared = left_of(prior_of(WALL), prior_of(WALL if label in (Label.FAR, Label.AGREED) else 0.0, label))
    if label == Label.AGREED:
        assert share(compared, Label.AGREED) > 0.5
    else:
        assert share(compared, Label.MONO) == 1
        np.testing.assert_array_equal(compared.sigma, np.float32(SIGMA))


def test_cameras_are_compared_for_the_dual_prior_alone(tmp_path: Path) -> None:
    recording = synthetic_recording(cameras=3, held_out=0, frames=1, width=120, height=68)
    names = list(recording.cameras)

    def labels(settings: PriorSettings) -> np.ndarray:
        """Of one store with these settings: the views are matched once."""
        build_priors(recording, names, tmp_path, settings)
        store = PriorStore.open(tmp_path)
        return np.stack([store.prior(name, recording.frames[0]).labels.numpy() for name in names])

    with_it, without = (labels(PriorSettings(agreement=share, color_limit=0.0)) for share in (0.02, 0.0))
    assert (with_it == Label.AGREED).any()
    changed = with_it != without
    assert set(np.unique(without[changed])) <= {Label.MONO, Label.EMPTY}, "what stereo says for itself never changes"
    assert set(np.unique(with_it[changed])) == {Label.AGREED, Label.VERIFIED}
    for variant in ("dual_unverified", "mono"):
        assert not (labels(PriorSettings(variant=variant)) == Label.AGREED).any()


def test_a_surface_of_another_colour_is_not_the_thing_that_the_ray_sees() -> None:
    """A near thing that the map does not know hides what lies behind it from this camera and not from the other."""
    ours, theirs = prior_of(WALL * 1.01), prior_of(WALL, Label.VERIFIED, 0.001)
    for apart, taken in ((0, True), (0.9, True), (1.1, False)):
        compared = left_of(painted(ours, 100), painted(theirs, 100 + int(apart * LIKE * 255)))
        assert (share(compared, Label.AGREED) > 0.5) is taken
        assert taken or (compared.depth == ours.depth).all()
    assert share(left_of(ours, theirs), Label.AGREED) > 0.5, "without images nothing speaks against it"


@pytest.mark.parametrize(("mine", "seen", "taken"), [(100, 120, True), (100, 100, False), (120, 100, False)])
def test_a_colour_is_compared_in_the_exposure_of_the_other_camera(mine: int, seen: int, taken: bool) -> None:
    """The left camera verified half of the wall, where the other one shows grey 100 as 120."""
    mono, verified = prior_of(WALL * 1.01), prior_of(WALL, Label.VERIFIED, 0.001)
    half = np.arange(WIDTH) < WIDTH // 2
    maps = {name: np.where(half, vars(verified)[name], vars(mono)[name]) for name in ("depth", "labels", "sigma")}
    ours = replace(mono, **maps)
    greys = (100, mine), (120, seen)
    colors = [np.tile(np.where(half[:, None], left, right), (HEIGHT, 1, 3)) for left, right in greys]
    ours, theirs = (replace(p, colors=c.astype(np.uint8)) for p, c in zip((ours, verified), colors, strict=True))
    right = left_of(ours, theirs).labels[:, 3 * WIDTH // 4 :]
    assert bool(np.mean(right == Label.AGREED) > 0.3) is taken


def test_maps_agree_only_about_places_of_one_colour() -> None:
    maps = {name: painted(prior_of(WALL), grey) for name, grey in (("left", 100), ("right", 130))}
    for prior in with_evidence(maps, CAMERAS, TOLERANCE).values():
        assert share(prior, Label.AGREED) == 0
        np.testing.assert_allclose(np.unique(prior.sigma), [SIGMA, ALONE * SIGMA], rtol=1e-6)


def test_agreement_takes_back_what_a_heavy_tail_added() -> None:
    maps = {name: prior_of(WALL) for name in ("left", "right")}
    compared = with_evidence(maps, CAMERAS, TOLERANCE, {"left": 2.0, "right": float("nan")})
    for name, tail in (("left", 2.0), ("right", 1.0)):
        sigma = compared[name].sigma[compared[name].labels == Label.AGREED]
        np.testing.assert_allclose(sigma, np.hypot(AGREED * SIGMA / tail, AT_BEST), rtol=1e-6)
