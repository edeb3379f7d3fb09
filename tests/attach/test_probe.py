"""Whether a trainer's own render may stand in for ours, alone and in a batch."""

import logging

import pytest
import torch
from mimics import fudan
from repositories import fudan_model
from tiny import TinyStore

from d2_plugin import D2Config, D2Hooks
from d2_plugin.adapters.fudan import FudanAdapter
from d2_plugin.adapters.probe import probe_package
from d2_plugin.config import DepthLossConfig
from d2_plugin.rasterizer import rasterize

DEPTH_ALONE = D2Config(depth_loss=DepthLossConfig(every=1))


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
