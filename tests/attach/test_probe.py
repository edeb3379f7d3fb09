"""A trainer's own render, and what it evaluated for it, may stand in for ours: alone, in a batch, of this step only."""

import logging
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from mimics import fudan, gsplat
from repositories import VARIANTS, fudan_model
from tiny import TinyStore, make_views
from torch import Tensor

from d2_plugin import D2Hooks
from d2_plugin.adapters.fudan import FudanAdapter
from d2_plugin.adapters.gsplat_dict import GsplatAdapter
from d2_plugin.adapters.probe import probe_package
from d2_plugin.config import D2Config, DepthLossConfig
from d2_plugin.rasterizer import rasterize

DEPTH_ALONE = D2Config(depth_loss=DepthLossConfig(every=1))


def make(name: str) -> SimpleNamespace:
    """A mimic with the depth loss alone: its adapter, cameras, what they depend on in time, and how it draws one."""
    standing, calls = VARIANTS[name](), []
    adapter, model, draw = standing.adapter, standing.model, standing.draw
    adapter.exact_times = True  # of Deformable-3D-Gaussians
    if name == "spacetime":
        moves = [getattr(model, f"_{part}") for part in ("rotation", "omega", "trbf_center", "trbf_scale", "motion")]
        asked = adapter._at
        adapter._at = lambda time: (calls.append(1), asked(time))[1]
        draw = lambda camera: (calls.append(1), standing.draw(camera))  # noqa: E731
    else:
        field = model._deformation if name == "hust4d" else adapter.deform.deform
        field.register_forward_hook(lambda *_: calls.append(1))
        moves = list(field.parameters())
    d2 = D2Hooks(D2Config(prior="prior", depth_loss=DepthLossConfig()), adapter)
    return SimpleNamespace(
        adapter=adapter, moves=moves, cameras=standing.cameras, draw=draw, d2=d2, calls=calls, model=model
    )


def gradients(made: SimpleNamespace, loss: Tensor) -> list[Tensor]:
    parameters = [*made.moves, made.model._xyz, made.model._opacity]
    parts = torch.autograd.grad(loss, parameters, allow_unused=True)
    return [torch.zeros_like(p) if part is None else part for p, part in zip(parameters, parts, strict=True)]


@pytest.fixture(params=["hust4d", "deformable3d", "spacetime"])
def name(request: pytest.FixtureRequest, workplace: Path) -> str:
    return request.param


@pytest.mark.parametrize("batch", [1, 3])
def test_what_moves_is_evaluated_once_a_view_and_gradients_are_the_same(name: str, batch: int) -> None:
    losses = []
    for drawn in (True, False):
        made = make(name)
        cameras = made.cameras[:batch]
        for camera in cameras if drawn else ():
            made.draw(camera)
        loss = made.d2.loss(1, cameras)
        assert len(made.calls) == batch
        losses.append((loss.detach(), *gradients(made, loss)))
        assert not made.adapter._unassigned
    assert any(part.any() for part in losses[0][1:-2]), "what moves has gradients"
    for one, other in zip(*losses, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-7)


def test_what_cannot_be_assigned_is_evaluated_anew(name: str) -> None:
    """A viewer that draws with gradients on, rows that changed since, an evaluation of a test image."""
    made = make(name)
    expected = made.d2.loss(1, made.cameras[0]).detach()
    made.draw(made.cameras[3])
    made.draw(made.cameras[0])
    made.calls.clear()
    torch.testing.assert_close(made.d2.loss(2, made.cameras[0]).detach(), expected)
    assert len(made.calls) == 1
    with torch.no_grad():
        made.draw(made.cameras[3])
    made.calls.clear()
    torch.testing.assert_close(made.d2.loss(3, made.cameras[0]).detach(), expected)
    made.draw(made.cameras[0])
    made.adapter.remove(torch.arange(len(made.adapter)) == 0)
    made.calls.clear()
    assert made.d2.loss(4, made.cameras[0]).isfinite()
    assert len(made.calls) == 1


@pytest.mark.usefixtures("workplace")
def test_a_render_that_leaves_no_new_fading_is_not_used() -> None:
    """Some renders of SpacetimeGaussians evaluate rotations and leave `trbfoutput` as an earlier view has it."""
    made = make("spacetime")
    made.draw(made.cameras[0])
    assert len(made.adapter._unassigned) == 1
    model = made.model
    model.get_rotation(0.3 - model._trbf_center.detach())
    model.trbfoutput = None
    model.get_rotation(0.4 - model._trbf_center.detach())
    assert len(made.adapter._unassigned) == 1


def test_gsplat_gives_its_own_depth_once() -> None:
    splats, optimizers, strategy = gsplat.make()
    adapter, views = GsplatAdapter(splats, optimizers, strategy.initialize_state()), make_views()[:2]
    drawn = [gsplat.render(splats, view) for view in views]
    depths = torch.stack([image.depth_sum for image in drawn])
    for view, image in zip(adapter.rendered(views, depths, depths / 3), drawn, strict=True):
        depth_sum, alpha = adapter.rendered_depth(view)
        assert torch.equal(depth_sum, image.depth_sum)
        assert torch.equal(alpha, image.depth_sum / 3)
        assert depth_sum.requires_grad
        assert adapter.rendered_depth(view) is None
    adapter.rendered(views, depths, depths)
    adapter.rendered(views[:1], depths, depths)
    assert adapter.rendered_depth(views[1]) is None, "renders of an earlier step are out of date"


@pytest.mark.usefixtures("workplace")
def test_offsets_at_noisy_times_are_not_used() -> None:
    made = make("deformable3d")
    made.adapter.exact_times = False
    for step, evaluations in ((1, 2), (20_000, 1)):
        made.calls.clear()
        made.draw(made.cameras[0])
        made.d2.loss(step, made.cameras[0])
        assert len(made.calls) == evaluations


class TestProbe:
    def test_fudans_own_renders_of_a_batch_are_used_view_by_view_and_equal_ours(self, caplog, monkeypatch) -> None:
        model, scene = fudan_model()
        adapter, cameras = FudanAdapter(model, scene), scene.train_cameras[1.0][:2]
        d2 = D2Hooks(DEPTH_ALONE, adapter, TinyStore())
        expected = d2.loss(1, list(cameras))
        caplog.clear()
        batch = [adapter.rendered(camera, fudan.render(camera, model, [0, 0, 0])) for camera in cameras]
        monkeypatch.setattr("d2_plugin.hooks.depth_loss.rasterize", None)  # D2 need not render
        with caplog.at_level(logging.INFO, logger="d2_plugin.adapters.inria"):
            reused = d2.loss(2, batch)
        torch.testing.assert_close(reused, expected)
        assert "the trainer's own render has depth and alpha with gradients" in caplog.text
        assert "no render of the trainer" not in caplog.text
        assert adapter.probe.usable
        reused.backward()
        assert model._xyz.grad.any()

    def test_a_render_of_an_earlier_step_is_not_used(self) -> None:
        model, scene = fudan_model()
        adapter, camera = FudanAdapter(model, scene), scene.train_cameras[1.0][0]
        adapter.begin_step(1)
        view = adapter.view(adapter.rendered(camera, fudan.render(camera, model, [0, 0, 0])))
        adapter.begin_step(2)
        assert adapter.rendered_depth(view) is None

    @pytest.mark.parametrize(
        ("mend", "sentence"),
        [
            (lambda p: p.pop("alpha"), "has no alpha"),
            (lambda p: p.update(depth=p["depth"].detach()), "has a depth without a gradient"),
            (lambda p: p.update(depth=p["depth"] / p["alpha"].clamp_min(1e-6)), "is divided by alpha"),
            (lambda p: p.update(depth=p["depth"] * 1.5), "is not the sum of w z"),
            (lambda p: p.update(alpha=p["alpha"] * 0.8), "an alpha that is not the sum of the weights"),
            (lambda p: p.update(depth=p["depth"][:, :5]), "a depth of shape"),
        ],
    )
    def test_any_other_meaning_of_depth_leads_to_our_own_rasterizer(self, mend, sentence: str) -> None:
        model, scene = fudan_model()
        adapter = FudanAdapter(model, scene)
        camera = scene.train_cameras[1.0][0]
        package = fudan.render(camera, model, [0, 0, 0])
        mend(package)
        d2 = D2Hooks(DEPTH_ALONE, adapter, TinyStore())
        torch.testing.assert_close(d2.loss(1, adapter.rendered(camera, package)), d2.loss(2, camera))
        assert not adapter.probe.usable
        assert sentence in adapter.probe.sentence

    def test_a_render_of_nothing_is_judged_again_later(self) -> None:
        model, scene = fudan_model()
        camera = scene.train_cameras[1.0][0]
        package = fudan.render(camera, model, [0, 0, 0])
        splats = FudanAdapter(model).slice_at(FudanAdapter(model).view(camera))
        own = rasterize(splats, torch.zeros(len(splats.means), 1), camera.drawn_view())
        empty = own._replace(alpha=torch.zeros_like(own.alpha))
        assert not probe_package(package, empty, (model._xyz, model._opacity)).final
        assert probe_package(package, own, (model._xyz, model._opacity)).usable
