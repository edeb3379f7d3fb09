"""The three lines in a trainer: what they promise, the cap of Gaussians, and how a run that diverges ends."""

import copy
import logging
import math
import random
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from refusals import refuses
from tiny import ALL_HOOKS, BACKBONES, TinyFrames, TinyStore, make_adapter, make_model, make_trainer, make_views
from torch import Tensor

from d2_plugin import D2Error, D2Hooks
from d2_plugin.adapters.yang4d import Yang4DAdapter
from d2_plugin.backbones.trainer import Trainer, TrainSettings
from d2_plugin.config import D2Config, DensifyConfig, PruneConfig
from d2_plugin.hooks.finite import Diverged, FiniteCheck
from d2_plugin.hooks.hook import Context, Hook, HookConfig
from d2_plugin.hooks.prune import Prune
from d2_plugin.hooks.views import ViewSampler
from d2_plugin.protocol import Points, Splats, View
from d2_plugin.rasterizer import rasterize


def only(*hooks: str) -> D2Config:
    return replace(ALL_HOOKS, **{name: None for name in ALL_HOOKS.hooks if name not in hooks})


def random_states() -> list[object]:
    """Of the three global generators that a trainer may draw from."""
    return [torch.get_rng_state().tolist(), np.random.get_state()[1].tolist(), random.getstate()]


def test_hooks_never_touch_the_global_random_state() -> None:
    before, trainer = random_states(), make_trainer(ALL_HOOKS, 16)
    trainer.run()
    assert {entry.action for entry in trainer.d2.trace} == {"loss", "insert", "remove"}, "the hooks did nothing"
    assert random_states() == before


def renders_of_ours(monkeypatch: pytest.MonkeyPatch) -> list[View]:
    """The views that D2 renders itself from now on."""
    views: list[View] = []

    def counting(splats: Splats, colors: torch.Tensor, view: View, *rest: object) -> object:
        views.append(view)
        return rasterize(splats, colors, view, *rest)

    monkeypatch.setattr("d2_plugin.hooks.depth_loss.rasterize", counting)
    return views


@pytest.mark.parametrize("backbone", BACKBONES)
def test_every_view_of_a_batch_uses_the_trainers_own_render(backbone: str, monkeypatch: pytest.MonkeyPatch) -> None:
    model, views = make_model(backbone=backbone), make_views()[:3]
    d2 = D2Hooks(only("depth_loss"), make_adapter(model), TinyStore())
    ours = renders_of_ours(monkeypatch)
    expected = d2.loss(1, views)
    assert ours == views, "the count does not count"
    ours.clear()
    for view in reversed(views):
        model.render(view)
    reused = d2.loss(2, views)
    torch.testing.assert_close(reused, expected)
    assert ours == []
    gradients = [torch.autograd.grad(loss, model.gaussians["positions"])[0] for loss in (reused, expected)]
    torch.testing.assert_close(*gradients)
    assert gradients[0].any()
    for view in views:
        model.render(view)
        torch.testing.assert_close(d2.loss(3, view), d2.loss(3, view))  # the second one renders
    assert ours == views


def test_renders_of_an_earlier_step_are_forgotten() -> None:
    model, view = make_model(), make_views()[0]
    adapter = make_adapter(model)
    model.render(view).color.sum().backward()
    model.optimize(1, 10)
    assert adapter.rendered_depth(view) is None
    model.render(view)
    with torch.no_grad():
        model.render(view)
    assert adapter.rendered_depth(view) is None, "the trainer's last render of this view has no gradients"


def test_a_backbone_that_changes_silently_is_noticed_once() -> None:
    model = make_model()
    d2 = D2Hooks(ALL_HOOKS, Yang4DAdapter(model), TinyStore())
    d2.hooks["prune"].streak = torch.ones(60, dtype=torch.int64)
    model.gaussians.select(torch.arange(50))  # not through the choke point
    with pytest.warns(UserWarning, match="from 60 to 50 Gaussians without telling"):
        d2.step(1)
    assert d2.hooks["prune"].streak is None
    model.gaussians.select(torch.arange(40))
    d2.step(2)


def test_a_change_that_is_told_and_one_that_is_not_spoil_no_count_of_what_the_trainer_added() -> None:
    model, view, ones = make_model(), make_views()[0], torch.ones(10)
    adapter = Yang4DAdapter(model)
    d2 = D2Hooks(D2Config(densify=DensifyConfig(max_gaussians=30)), adapter, TinyStore())
    d2.loss(1, view)
    adapter.insert(Points(torch.tensor([[0.0, 0, 3]] * 10), torch.zeros(10, 3), 0 * ones, ones / 10, ones / 2))
    model.gaussians.select(torch.arange(80) % 70)  # not through the choke point
    with pytest.warns(UserWarning, match="from 70 to 80 Gaussians without telling"):
        d2.step(1)


def test_neither_autocast_nor_another_default_device_changes_a_loss_or_an_edit(monkeypatch) -> None:
    # It refuses `meta`, which stands for a GPU.
    monkeypatch.setattr("d2_plugin.plugin.check_surroundings", lambda: None)
    prior = TinyStore().prior("cam0", 0)

    def after(context: AbstractContextManager[object]) -> list[torch.Tensor]:
        model, views = make_model(), make_views()
        d2 = D2Hooks(ALL_HOOKS, make_adapter(model), SimpleNamespace(prior=lambda *key: prior))
        with context:
            for step, view in enumerate(views, 1):
                loss = d2.loss(step, view)
                d2.step(step)
        return [loss, model.gaussians["positions"], d2.inserted_at]

    expected = after(nullcontext())
    assert expected[-1].any(), "nothing was inserted"
    for context in (torch.autocast("cpu", torch.bfloat16), torch.device("meta")):
        torch.testing.assert_close(after(context), expected, rtol=0, atol=0)


def test_a_state_that_was_loaded_on_another_device_goes_on() -> None:
    sampler, prune = ViewSampler(), Prune(PruneConfig())
    for view in make_views():
        sampler.add(view)
    prune.load_state_dict({"streak": torch.ones(3, dtype=torch.int64)})
    sampler.add(replace(view, K=view.K.to("meta"), T_camera_world=view.T_camera_world.to("meta")))
    prune.follow(torch.arange(3, device="meta"))
    found = [prune.streak, *(view.K for view in sampler.sample(99, torch.Generator()))]
    assert {tensor.device.type for tensor in found} == {"meta"}


def test_evaluations_visit_every_view_before_any_twice() -> None:
    sampler, generator = ViewSampler(), torch.Generator().manual_seed(0)
    for view in make_views():
        sampler.add(view)
    keys = [(v.camera, v.frame) for _ in range(2) for v in sampler.sample(3, generator)]
    assert len(set(keys)) == 6
    assert ViewSampler().sample(3, generator) == []


def test_evaluations_look_from_where_a_trainer_that_refines_poses_has_its_cameras_now() -> None:
    sampler, view = ViewSampler(), make_views()[0]
    refined = replace(view, T_camera_world=view.T_camera_world @ torch.diag(torch.tensor([-1.0, 1, -1, 1])))
    assert sampler.add(view)
    assert not sampler.add(refined)
    assert sampler.sample(1, torch.Generator()) == [refined]


def test_every_view_is_looked_at_before_insertion_ends() -> None:
    looked: list[list] = []

    class Watching(Hook):
        def edit(self, context: Context) -> None:
            looked.append([(surveyed.view.camera, surveyed.view.frame) for surveyed in context.evaluation])

    config = D2Config(densify=DensifyConfig(start=5, stop=25, every=10), views_per_evaluation=1)
    hooks = {"watching": Watching(HookConfig(start=5, every=10))}
    settings = TrainSettings(iterations=36)
    trainer = Trainer(
        make_model(), TinyFrames(), settings, lambda model: D2Hooks(config, make_adapter(model), TinyStore(), hooks)
    )
    trainer.run(14)
    trainer.load_state_dict(copy.deepcopy(trainer.state_dict()))
    trainer.run()
    assert [len(views) for views in looked] == [3, 3, 1, 1], "five are known at first; insertion looks twice"
    assert len({*looked[0], *looked[1]}) == 6


def test_a_hook_without_a_prior_says_what_to_set() -> None:
    with pytest.raises(D2Error, match="^densify, prune need a depth prior: set `prior`"):
        D2Hooks.from_config({"densify": {}, "prune": {}}, backbone=Yang4DAdapter(make_model()))


def test_a_configuration_of_another_length_than_the_trainers_is_named(caplog: pytest.LogCaptureFixture) -> None:
    for config, said in (({"iterations": 90}, 1), ({"iterations": 30}, 0), ({}, 0), (ALL_HOOKS, 0)):
        caplog.clear()
        D2Hooks.from_config(config, make_adapter(make_model()), TinyStore(), iterations=30)
        assert caplog.text.count("is of a run of 90 steps and the trainer says 30") == said


def test_a_prior_of_another_size_is_refused_with_both_values() -> None:
    view = replace(make_views()[0], width=64)
    d2 = D2Hooks(only("depth_loss"), Yang4DAdapter(make_model()), TinyStore())
    refuses("is 32x24 pixels but the view is 64x24", d2.loss, 1, view)
    d2.loss(1, make_views()[0])  # as a trainer at random scales has it
    refuses("is 32x24 pixels but the view is 64x24.*or give d2.loss views of the prior's size", d2.loss, 2, view)


@pytest.mark.parametrize(
    ("change", "says"),
    [(lambda part: part[None], r"returned \(1, 24, 32\) with"), (Tensor.detach, r"returned \(24, 32\) without")],
)
def test_a_render_of_the_trainers_that_cannot_be_supervised_is_refused(change: Callable, says: str) -> None:
    adapter = make_adapter(make_model())
    adapter.rendered_depth = lambda view: [change(part) for part in rendered(adapter, view)]
    d2 = D2Hooks(only("depth_loss"), adapter, TinyStore())
    refuses(rf"rendered_depth\(\) {says}.* or return None, and D2 renders", d2.loss, 1, make_views()[0])


def rendered(adapter: Any, view: View) -> tuple[Tensor, Tensor]:
    splats = adapter.slice_at(view)
    render = rasterize(splats, splats.means, view, adapter.settings)
    return render.depth_sum, render.alpha


class TestRetirement:
    """A hook whose last evaluations changed next to nothing costs no more surveys, and says so."""

    @staticmethod
    def config(**top: object) -> D2Config:
        nothing = {
            "densify": DensifyConfig(start=1, stop=None, every=1, max_gaussians=0),
            "prune": PruneConfig(start=1, stop=None, every=1, patience=3, tau_p=1.0, sight=False),
        }
        return D2Config(**nothing, views_per_evaluation=3, **top)

    def test_idle_hooks_retire_once_their_evidence_could_have_acted_in_a_resumed_run_too(self) -> None:
        trainer, resumed = (make_trainer(self.config(retire_after=4), iterations=8) for _ in range(2))
        trainer.run(5)
        resumed.load_state_dict(trainer.state_dict())
        for run in (trainer, resumed):
            run.run()
            assert run.d2.retired == {"densify": 4, "prune": 6}  # patience 3: two more evaluations
        assert [(t.step, t.hook) for t in trainer.d2.trace if t.action == "retire"] == [(4, "densify"), (6, "prune")]

    def test_nothing_retires_where_that_is_switched_off(self) -> None:
        trainer = make_trainer(self.config(retire_after=0), iterations=12)
        trainer.run()
        assert trainer.d2.retired == {}

    def test_a_hook_that_still_edits_stays(self) -> None:
        trainer = make_trainer(replace(ALL_HOOKS, prune=None, retire_after=2), 16)
        trainer.run()
        inserted = [t.step for t in trainer.d2.trace if t.action == "insert" and t.count]
        assert inserted == [5, 10, 15]
        assert trainer.d2.retired == {}


def grown(most: int | None) -> tuple[D2Hooks, list[int]]:
    """A toy trainer that adds ten Gaussians a step, the last of them faintest, long after insertion has ended."""
    model = make_model()
    adapter = make_adapter(model)
    densify = DensifyConfig(start=1, stop=2, max_gaussians=most, budget_per_view=5)
    d2, counts = D2Hooks(D2Config(densify=densify), adapter, TinyStore()), []
    for step in range(1, 5):
        d2.loss(step, make_views()[0])
        ones = torch.ones(10)
        positions = torch.tensor([0.0, 0.0, 3.0]).repeat(10, 1)
        adapter.insert(Points(positions, positions * 0, ones * 0, ones / 10, torch.linspace(0.9, 0.1, 10)))
        d2.step(step)
        counts.append(len(adapter))
    return d2, counts


def test_the_trainers_own_growth_stops_at_a_cap_alone_and_it_is_said_once(caplog: pytest.LogCaptureFixture) -> None:
    before = len(make_adapter(make_model()))
    with caplog.at_level(logging.INFO, logger="d2_plugin"):
        d2, counts = grown(before + 20)
    assert max(counts) == counts[-1] == before + 20
    newest = d2.backbone.slice_at(make_views()[0]).opacities[-5:]
    torch.testing.assert_close(newest, torch.linspace(0.9, 0.1, 10)[:5])  # the faintest of ten went
    assert caplog.text.count("above max_gaussians") == 1
    assert d2.log.capped > 0
    assert f"({d2.log.capped} above max_gaussians)" in d2.log.summary()
    d2, counts = grown(None)
    assert counts[-1] - counts[0] == 30
    assert "max_gaussians" not in d2.log.summary()


def test_what_was_there_before_stays_where_the_cap_is_below_it(caplog: pytest.LogCaptureFixture) -> None:
    before = len(make_adapter(make_model()))
    _, counts = grown(before - 5)
    assert counts == [before] * 4
    assert f"step 1: {before + 10} Gaussians, so none are inserted: max_gaussians = {before - 5}" in caplog.text


QUIET = replace(ALL_HOOKS, densify=None, prune=None, finite_every=6)
"""The depth loss alone, so that nothing looks but the check."""


def poisoned(trainer: Trainer, at: int, name: str = "opacity_logits", value: float = math.nan) -> Callable[..., None]:
    """Called after each step; spoils one number of one parameter after that of number `at`."""

    def on_step(step: int, loss: float) -> None:
        if step == at:
            trainer.model.gaussians[name].data.view(-1)[7] = value

    return on_step


@pytest.mark.parametrize("value", [math.nan, -math.inf])
def test_training_stops_at_the_next_look_with_the_parameter(value: float) -> None:
    trainer = make_trainer(QUIET)
    told = (
        r"at step 12 or less than 6 steps before it \(.* of \S+ is NaN or infinite.*\): no state was saved yet; lower"
    )
    refuses(told, trainer.run, 20, poisoned(trainer, 7, "positions", value), error=Diverged)


def test_it_is_looked_before_anything_is_inserted_or_removed() -> None:
    trainer = make_trainer(replace(ALL_HOOKS, finite_every=1000))
    refuses(r"at step 5 or", trainer.run, 20, poisoned(trainer, 3), error=Diverged)


def test_the_last_saved_step_is_told_and_a_spoilt_state_is_not_saved() -> None:
    trainer = make_trainer(QUIET)
    trainer.run(4)
    state = copy.deepcopy(trainer.state_dict())
    trainer.run(8, poisoned(trainer, 8))
    refuses(r"at step 8 .* the last state that was saved is of step 4", trainer.state_dict, error=Diverged)
    trainer = make_trainer(QUIET)
    trainer.load_state_dict(state)
    refuses(r"the last state that was saved is of step 4", trainer.run, 20, poisoned(trainer, 7), error=Diverged)


def test_a_loss_of_d2_that_is_not_finite_is_reported() -> None:
    check = FiniteCheck(make_adapter(make_model()), 1)
    check.remember(torch.tensor(math.nan), [])
    refuses(r"\(D2's loss is nan\)", check.check, 3, now=False, error=Diverged)


def test_it_can_be_switched_off() -> None:
    trainer = make_trainer(replace(QUIET, finite_every=0))
    trainer.run(8, poisoned(trainer, 7))
    assert trainer.step == 8
    trainer.state_dict()


@pytest.mark.parametrize("backbone", BACKBONES)
def test_every_tensor_that_is_trained_is_checked(backbone: str) -> None:
    model = make_model(backbone=backbone, background=True)
    check, trained = FiniteCheck(make_adapter(model), 1), make_adapter(model).trained()
    assert {"positions", "background.constant", "background.harmonics"} <= set(trained)
    assert any(name.startswith("field") for name in trained) is (backbone == "deform")
    check.check(1, now=False)
    for name, value in trained.items():
        kept = value.detach().clone()
        value.data.view(-1)[-1] = math.inf
        refuses(name.replace(".", r"\."), check.check, 1, now=False, error=Diverged)
        value.data.copy_(kept)
    check.check(1, now=False)


def test_a_backbone_without_trained_is_checked_through_its_slice() -> None:
    model = make_model()

    class Bare:
        slice_at = staticmethod(model.slice_at)

    bare: Any = Bare()
    check, views = FiniteCheck(bare, 1), make_views()
    check.check(1, now=True)  # nothing was trained on yet, so nothing can be asked
    check.remember(0.0, views[:1])
    check.check(2, now=False)
    model.gaussians["base_colors"].data.fill_(math.nan)
    check.check(3, now=False)  # what it does not tell cannot be seen
    model.gaussians["opacity_logits"].data.fill_(math.nan)
    refuses("of opacities is NaN", check.check, 4, now=False, error=Diverged)
