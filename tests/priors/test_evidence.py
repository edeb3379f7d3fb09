"""Two cameras' monocular depths confirm each other only where they put one surface at one place."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from d2_plugin.captures.capture import Camera
from d2_plugin.captures.synthetic.room import synthetic_capture
from d2_plugin.priors.build import build_priors
from d2_plugin.priors.fuse import FusedPrior
from d2_plugin.priors.monocular.agree import with_agreement
from d2_plugin.priors.settings import PriorSettings
from d2_plugin.priors.store import PriorStore
from d2_plugin.protocol import DepthPrior, Label

WIDTH, HEIGHT, WALL = 40, 30, 4.0


def camera(x: float) -> Camera:
    """At (x, 0, 0), looking along z."""
    pose = np.eye(4)
    pose[0, 3] = -x
    return Camera("camera", WIDTH, HEIGHT, np.array([[30.0, 0, 20], [0, 30.0, 15], [0, 0, 1]]), pose)


CAMERAS = {"left": camera(0.0), "right": camera(0.5)}


def mono(depth: float) -> FusedPrior:
    """A wall that only the monocular map knows."""
    return FusedPrior(np.full((HEIGHT, WIDTH), depth, np.float32), np.full((HEIGHT, WIDTH), int(Label.MONO), np.uint8))


def share(prior: FusedPrior, label: Label) -> float:
    return float((prior.labels == label).mean())


def test_maps_that_put_a_wall_at_one_place_agree_where_both_cameras_see_it() -> None:
    agreed = with_agreement({"left": mono(WALL), "right": mono(WALL)}, CAMERAS, 0.02, 0.1)
    shift = 30 * 0.5 / WALL  # pixels between the two pictures
    assert share(agreed["left"], Label.AGREED) == pytest.approx(1 - shift / WIDTH, abs=1 / WIDTH)
    assert share(agreed["right"], Label.AGREED) == pytest.approx(1 - shift / WIDTH, abs=1 / WIDTH)
    assert (agreed["left"].labels[:, : int(shift)] == Label.MONO).all(), "what one camera alone sees stays mono-only"


def test_maps_that_differ_by_more_than_the_tolerance_do_not() -> None:
    agreed = with_agreement({"left": mono(WALL), "right": mono(WALL * 1.03)}, CAMERAS, 0.02, 0.1)
    assert share(agreed["left"], Label.AGREED) == share(agreed["right"], Label.AGREED) == 0


def test_a_verified_depth_behind_the_point_refutes_it() -> None:
    middle = camera(0.25)
    behind = FusedPrior(np.full((HEIGHT, WIDTH), 6.0, np.float32), np.full((HEIGHT, WIDTH), 2, np.uint8))
    rig = {**CAMERAS, "middle": middle}
    agreed = with_agreement({"left": mono(WALL), "right": mono(WALL), "middle": behind}, rig, 0.02, 0.1)
    seen = slice(4, WIDTH - 8)  # columns of the left picture that both others see
    assert not (agreed["left"].labels[:, seen] == Label.AGREED).any()
    assert share(agreed["middle"], Label.VERIFIED) == 1


def test_depth_never_changes_and_only_mono_only_pixels_are_relabelled() -> None:
    generator = np.random.default_rng(0)
    labels = generator.integers(0, 4, (HEIGHT, WIDTH)).astype(np.uint8)
    depth = np.where(np.isin(labels, (Label.MONO, Label.VERIFIED)), WALL, 0).astype(np.float32)
    prior = FusedPrior(depth, labels)
    agreed = with_agreement({"left": prior, "right": mono(WALL)}, CAMERAS, 0.02, 0.1)["left"]
    assert np.array_equal(agreed.depth, depth)
    changed = agreed.labels != labels
    assert changed.any()
    assert (labels[changed] == Label.MONO).all()
    assert (agreed.labels[changed] == Label.AGREED).all()


def test_points_behind_another_camera_are_not_looked_up() -> None:
    turned = camera(0.0)
    turned.T_camera_world[:3, :3] = np.diag([-1.0, 1, -1])  # looks away
    agreed = with_agreement({"left": mono(WALL), "away": mono(WALL)}, {"left": camera(0), "away": turned}, 0.02, 0.1)
    assert share(agreed["left"], Label.AGREED) == 0


def test_trusted_is_verified_and_agreed_and_both_are_supported() -> None:
    prior = DepthPrior(torch.ones(1, 5), torch.arange(5, dtype=torch.uint8)[None])
    assert prior.trusted.tolist() == [[False, False, True, False, True]]
    assert prior.support.tolist() == [[False, True, True, False, True]]
    assert prior.verified.tolist() == [[False, False, True, False, False]]


def test_the_builder_adds_agreement_to_the_dual_prior_alone(tmp_path) -> None:
    pytest.importorskip("cv2", reason="opencv is in the `image` extra")
    capture = synthetic_capture(cameras=3, held_out=0, frames=1, width=160, height=90)
    names = list(capture.cameras)

    def labels(folder: str, settings: PriorSettings) -> np.ndarray:
        build_priors(capture, names, tmp_path / folder, settings)
        store = PriorStore.open(tmp_path / folder)
        return np.stack([store.prior(name, capture.frames[0]).labels.numpy() for name in names])

    with_it, without = labels("on", PriorSettings()), labels("off", PriorSettings(agreement=0.0))
    assert (with_it == Label.AGREED).any()
    assert np.array_equal(np.where(with_it == Label.AGREED, Label.MONO, with_it), without)
    unverified = labels("unverified", PriorSettings(variant="dual_unverified"))
    assert not (unverified == Label.AGREED).any()
    assert PriorSettings.paper().agreement == 0
