"""The colour at infinity, and cameras of different exposure: begun with the images, learnt, saved with the model."""

import math
from dataclasses import replace

import pytest
import torch
from tiny import ALL_HOOKS, BACKBONES, TinyFrames, TinyStore, make_adapter, make_model, make_trainer, make_views
from torch import Tensor

from d2_plugin.backbones import background as module
from d2_plugin.backbones.appearance import Appearance, changed
from d2_plugin.backbones.background import Background
from d2_plugin.plugin import D2Hooks
from d2_plugin.protocol import Render, View
from d2_plugin.rasterizer import rasterize


@pytest.fixture(params=BACKBONES)
def backbone(request: pytest.FixtureRequest) -> str:
    return request.param


def some_sky() -> Background:
    """A sky with all its harmonics, nowhere clamped."""
    sky = Background(torch.device("cpu"))
    with torch.no_grad():
        sky.harmonics.uniform_(-0.05, 0.05, generator=torch.Generator().manual_seed(0))
    return sky


def nothing(view: View) -> Render:
    empty = view.K.new_zeros(view.height, view.width)
    return Render(view.K.new_zeros(view.height, view.width, 3), empty, empty)


def sky_of(sky: Background, view: View) -> Tensor:
    """The background alone [H, W, 3]."""
    return sky.behind(nothing(view), view).color


def turned(view: View, angle: float) -> View:
    c, s = math.cos(angle), math.sin(angle)
    turn = torch.tensor([[c, 0, s, 0.3], [0, 1, 0, -2.0], [-s, 0, c, 0.7], [0, 0, 0, 1]])
    return replace(view, T_camera_world=turn @ view.T_camera_world, camera="held out")


def test_off_is_what_the_rasterizer_returns_and_a_checkpoint_says_that_it_is_off(backbone: str) -> None:
    model, other = (make_model(backbone=backbone, background=on) for on in (False, True))
    view, splats = make_views()[0], model.slice_at(make_views()[0])
    other.load_state_dict(model.state_dict())
    assert other.background is None
    expected = rasterize(splats, model.colors(view, splats), view)
    for render in (model.render(view), other.render(view)):
        assert all(torch.equal(*pair) for pair in zip(render[:3], expected[:3], strict=True))


class TestColour:
    def test_gradients_reach_alpha_and_the_colours(self) -> None:
        sky, view = some_sky(), make_views()[0]
        color, alpha = torch.rand(24, 32, 3), torch.rand(24, 32).requires_grad_()
        depth_sum = torch.rand(24, 32)
        render = sky.behind(Render(color, depth_sum, alpha), view)
        behind = sky_of(sky, view)
        torch.testing.assert_close(render.color, color + (1 - alpha)[..., None] * behind)
        assert render.depth_sum is depth_sum
        assert render.alpha is alpha
        render.color.sum().backward()
        torch.testing.assert_close(alpha.grad, -behind.sum(-1).detach())
        assert sky.constant.grad.all()
        assert sky.harmonics.grad.any(1).all()

    def test_a_direction_has_one_colour_whatever_camera_sees_it(self) -> None:
        """Of a camera that is elsewhere and turned, one pixel whose ray is that of a pixel of the first."""
        sky, view = some_sky(), make_views()[0]
        expected = sky_of(sky, view)
        assert (expected.amax((0, 1)) - expected.amin((0, 1))).min() > 0.02, "a sky of one colour shows nothing"
        for row, column in ((0, 0), (11, 20), (23, 31)):
            other = turned(view, 0.4)
            ray = torch.linalg.solve(view.K, torch.tensor([column + 0.5, row + 0.5, 1.0]))
            ray = other.T_camera_world[:3, :3] @ view.T_camera_world[:3, :3].T @ ray
            K = torch.tensor([[40.0, 0, 0.5 - 40 * ray[0] / ray[2]], [0, 40.0, 0.5 - 40 * ray[1] / ray[2]], [0, 0, 1]])
            found = sky_of(sky, replace(other, K=K, width=1, height=1))
            torch.testing.assert_close(found[0, 0], expected[row, column], atol=1e-5, rtol=0)

    def test_a_large_image_is_interpolated_between_a_few_directions(self, monkeypatch: pytest.MonkeyPatch) -> None:
        view = make_views()[0]
        K = view.K * torch.tensor([10.0, 10, 1])[:, None]
        large = replace(view, K=K, width=10 * view.width, height=10 * view.height)
        coarse = sky_of(some_sky(), large)
        monkeypatch.setattr(module, "NODES", large.width)
        assert (coarse - sky_of(some_sky(), large)).abs().max() < 2e-3

    def test_another_lens_on_the_same_camera_sees_other_directions(self) -> None:
        sky, view = some_sky(), make_views()[0]
        zoomed = replace(view, K=view.K * torch.tensor([2.0, 2.0, 1.0])[:, None])
        wide = sky_of(sky, view)
        assert torch.equal(sky_of(sky, zoomed), sky_of(some_sky(), zoomed)), "remembered from the other lens"
        assert not torch.equal(sky_of(sky, zoomed), wide)

    def test_a_given_colour_takes_its_place(self) -> None:
        view, white = make_views()[0], torch.ones(3)
        plain, with_sky = make_model(), make_model(background=True)
        assert torch.equal(with_sky.render(view, white).color, plain.render(view, white).color)

    @pytest.mark.parametrize("bright", [0.02, 0.98])
    def test_a_sky_is_learned_and_a_held_out_camera_sees_it(self, bright: float) -> None:
        model, views = make_model(1, background=True), make_views()
        model.select(torch.arange(0))
        for step in range(100):
            (model.render(views[step % 3]).color - bright).abs().mean().backward()
            model.optimize(step, 100)
        assert (sky_of(model.background, turned(views[0], 0.1)) - bright).abs().mean() < 0.02


def test_the_depth_loss_knows_nothing_of_the_background(backbone: str) -> None:
    view, found = make_views()[1], []
    for on in (False, True):
        model = make_model(backbone=backbone, background=on)
        d2 = D2Hooks(replace(ALL_HOOKS, densify=None, prune=None), make_adapter(model), TinyStore())
        model.render(view)
        loss = d2.loss(1, view)
        found.append([loss, *torch.autograd.grad(loss, [model.gaussians["positions"]])])
    assert all(torch.equal(bare, sky) for bare, sky in zip(*found, strict=True))
    assert found[0][-1].any()


class TestStart:
    """It begins with what the images show, as if all were at infinity."""

    @staticmethod
    def started(images: list[Tensor], views: list[View]) -> Background:
        sky = Background(torch.device("cpu"))
        sky.start_from(views, lambda index: images[index])
        return sky

    @staticmethod
    def flat(view: View, color: tuple[float, float, float]) -> Tensor:
        return torch.tensor(color).expand(view.height, view.width, 3)

    def test_images_of_one_colour_are_that_colour_also_where_no_camera_looks(self) -> None:
        views, color = make_views()[:2], (0.2, 0.5, 0.9)
        sky = self.started([self.flat(view, color) for view in views], views)
        for angle in (0.0, 1.5, 3.0):
            shown = sky_of(sky, turned(views[0], angle))
            torch.testing.assert_close(shown, self.flat(views[0], color), atol=1e-4, rtol=0)

    def test_what_was_not_recorded_is_no_colour(self) -> None:
        view, color, recorded = make_views()[0], (0.2, 0.5, 0.9), torch.ones(24, 32, dtype=torch.bool)
        recorded[:, :9] = False
        image, sky = self.flat(view, color) * recorded[..., None], Background(torch.device("cpu"))
        sky.start_from([view], lambda index: image, lambda index: recorded)
        torch.testing.assert_close(sky_of(sky, view), self.flat(view, color), atol=1e-4, rtol=0)

    @pytest.mark.parametrize("seed", range(3))
    def test_no_direction_is_brighter_or_darker_than_a_image_can_be(self, seed: int) -> None:
        views = make_views()[:2]
        generator = torch.Generator().manual_seed(seed)
        noise = [(torch.rand(view.height, view.width, 3, generator=generator) > 0.5).float() for view in views]
        sky = self.started(noise, views)
        for angle in torch.linspace(0, 6, 12).tolist():
            shown = sky_of(sky, turned(views[0], angle))
            assert (shown - 0.5).abs().max() < 0.4, "least squares ran away where no camera looks"

    @pytest.mark.parametrize("pull", [module.UNSEEN, 0.0])
    def test_where_no_camera_looks_it_stays_as_begun_while_a_sky_is_learnt(self, pull: float, monkeypatch) -> None:
        """Also in a saved model; without the pull the other side goes more than half of the way to it."""
        monkeypatch.setattr(module, "UNSEEN", pull)
        view, sky = make_views()[0], Background(torch.device("cpu"))
        sky.load_state_dict(self.started([self.flat(view, (0.5, 0.5, 0.5))], [view]).state_dict())
        for _ in range(300):
            (sky_of(sky, view) - 0.9).abs().mean().backward()
            sky.optimize()
        assert (sky_of(sky, view) - 0.9).abs().mean() < 0.05
        assert ((sky_of(sky, turned(view, math.pi)) - 0.5).abs().mean() < 0.17) == (pull > 0)

    def test_where_all_directions_are_seen_nothing_is_pulled(self) -> None:
        view = make_views()[0]
        K = torch.tensor([[view.height / 2.01, 0, view.width / 2], [0, view.height / 2.01, view.height / 2], [0, 0, 1]])
        flat = replace(view, K=K)
        tilt = torch.tensor([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]]) @ flat.T_camera_world
        views = [turned(flat, quarter * math.pi / 2) for quarter in range(4)]
        views += [replace(flat, T_camera_world=tilt), replace(flat, T_camera_world=tilt @ tilt @ tilt)]
        sky = self.started([self.flat(view, (0.2, 0.5, 0.9))] * 6, views)
        assert not sky.unseen.any()

    def test_left_and_right_are_told_apart(self) -> None:
        view = make_views()[0]
        image = torch.zeros(view.height, view.width, 3)
        image[:, view.width // 2 :] = 1
        shown = sky_of(self.started([image], [view]), view)
        assert shown[:, : view.width // 4].mean() < 0.35
        assert shown[:, -view.width // 4 :].mean() > 0.65


GAINS = {"cam0": 0.8, "cam1": 1.0, "cam2": 1.2}


class Exposed(TinyFrames):
    """The tiny scene with a gain for each camera."""

    def image(self, index: int) -> torch.Tensor:
        return super().image(index) * GAINS[self.views[index].camera]


def test_gains_are_learnt_and_a_camera_that_did_not_train_sees_the_mean() -> None:
    found = {}
    for appearance in (False, True):
        trainer = make_trainer(iterations=180, appearance=appearance, temporal=False, background=False)
        trainer.frames = Exposed()
        trainer.run()
        found[appearance] = trainer.model
    changes = torch.stack([found[True].appearance.change(camera).detach() for camera in GAINS])
    assert changes.mean(0).abs().max() < 1e-6
    gray = (0.5 + changes[:, :, :3].sum(-1) * 0.5 + changes[:, :, 3]).mean(-1)  # what a gray of .5 looks like
    assert (gray[2] - gray[0]).item() == pytest.approx(0.2, abs=0.07)
    truth = TinyFrames().image(0)
    errors = {}
    for appearance, model in found.items():
        with torch.no_grad():
            view = replace(make_views()[0], camera="held out")
            errors[appearance] = (model.render(view).color - truth).abs().mean().item()
    assert errors[True] < 0.7 * errors[False], "the colours of its neighbours' exposures"


MEASURED = {"a": (1.2, 1.1, 1.0), "b": (0.8, 0.9, 1.0), "held": (1.4, 1.0, 0.7)}


def started() -> Appearance:
    appearance = Appearance(torch.device("cpu"))
    appearance.start_from(MEASURED, ("a", "b"))
    return appearance


def test_each_camera_sees_its_gain_before_the_first_step_and_only_training_cameras_learn() -> None:
    appearance = started()
    for camera, gain in MEASURED.items():
        seen = changed(torch.full((3,), 0.5), appearance.change(camera))
        torch.testing.assert_close(seen, 0.5 * torch.tensor(gain))
    assert set(appearance.changes) == {"a", "b"}


def test_nothing_begins_where_a_training_camera_has_no_gain() -> None:
    appearance = Appearance(torch.device("cpu"))
    appearance.start_from({"a": (1.2, 1.0, 1.0)}, ("a", "b"))
    assert not appearance.changes
    assert not appearance.measured


def test_measured_changes_are_saved_with_those_that_learn() -> None:
    appearance, again = started(), Appearance(torch.device("cpu"))
    changed(torch.full((2, 3), 0.5), appearance.change("a")).sum().backward()
    appearance.optimize()
    again.load_state_dict(appearance.state_dict())
    assert all(torch.equal(again.change(camera), appearance.change(camera)) for camera in MEASURED)


@pytest.mark.parametrize("background", [True, False])
@pytest.mark.parametrize("given", [None, (0.2, 0.4, 0.9)])
def test_the_image_is_that_of_the_mean_camera_after_the_change(background: bool, given: tuple[float, ...]) -> None:
    """Gaussians and background are changed, which are fewer than pixels: their gradients are those of the image."""
    model, mean = (make_model(background=background, appearance=on) for on in (True, False))
    view, behind = make_views()[0], None if given is None else torch.tensor(given)
    with torch.no_grad():
        change = torch.tensor([[0.3, -0.1, 0.0, 0.05], [0.0, -0.2, 0.1, 0.0], [0.02, 0.0, 0.1, -0.04]])
        model.appearance.measured[view.camera] = change.requires_grad_()
        for one in (model, mean):
            if background:
                one.background.harmonics.uniform_(-0.05, 0.05, generator=torch.Generator().manual_seed(3))
    seen = model.render(view, behind).color
    expected = mean.render(view, behind).color
    expected = expected + expected @ change[:, :3].T + change[:, 3]
    torch.testing.assert_close(seen, expected, rtol=0, atol=2e-6)
    weights = torch.rand(seen.shape, generator=torch.Generator().manual_seed(4))
    (found,) = torch.autograd.grad((seen * weights).sum(), change)
    (right,) = torch.autograd.grad((expected * weights).sum(), change)
    torch.testing.assert_close(found, right, rtol=1e-4, atol=1e-3)
