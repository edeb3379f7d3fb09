"""D2Hooks in a trainer: off is off, resume is exact, state stays on its row, mistakes get a sentence."""

from __future__ import annotations

import copy
import inspect
import random
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny import ALL_HOOKS, BACKBONES, TinyStore, make_adapter, make_model, make_trainer, make_views, parameters, same

from d2_plugin import D2Config, D2Error, D2Hooks
from d2_plugin.adapters.yang4d import Yang4DAdapter
from d2_plugin.backbones import trainer as trainer_module
from d2_plugin.backbones.trainer import Trainer
from d2_plugin.config import DensifyConfig, PruneConfig
from d2_plugin.hooks.densify import shuffled_pixels
from d2_plugin.hooks.views import ViewSampler
from d2_plugin.protocol import Splats, View
from d2_plugin.rasterizer import rasterize


def only(*hooks: str) -> D2Config:
    return replace(ALL_HOOKS, **{name: None for name in ALL_HOOKS.hooks if name not in hooks})


def trainer_without(*numbers: int) -> type[Trainer]:
    """The bundled trainer with some of the three lines that attach D2 taken out of its source."""
    lines = inspect.getsource(Trainer).splitlines()
    for number in numbers:
        (index,) = (i for i, line in enumerate(lines) if f"# D2, line {number}" in line)
        guarded = lines[index - 1].strip() == "if d2 is not None:"
        del lines[index - 1 if guarded else index : index + 1]
    space = dict(vars(trainer_module))
    exec("\n".join(lines), space)
    space["Trainer"].d2 = None
    return space["Trainer"]


def test_a_trainer_changes_by_three_lines_and_each_does_its_part() -> None:
    assert inspect.getsource(Trainer).count("# D2, line") == 3
    bare, without = make_trainer(), make_trainer(ALL_HOOKS, kind=trainer_without(1, 2, 3))
    bare.run()
    without.run()
    assert same(parameters(bare), parameters(without)), "a fourth line attaches D2"
    done = {}
    for missing in (None, 2, 3):
        trainer = make_trainer(ALL_HOOKS, kind=trainer_without(missing) if missing else Trainer)
        trainer.run()
        done[missing] = {entry.action for entry in trainer.d2.trace}
    assert done == {None: {"loss", "insert", "remove"}, 2: set(), 3: {"loss"}}  # line 2 shows the views to survey


def test_a_resume_without_the_state_of_d2_differs() -> None:
    whole = make_trainer(ALL_HOOKS)
    whole.run()
    first = make_trainer(ALL_HOOKS)
    first.run(until=17)
    state = first.state_dict()
    rows = {"inserted_at": state["d2"]["inserted_at"]}  # of this many Gaussians: another number is refused
    state["d2"] = make_trainer(ALL_HOOKS).d2.state_dict() | rows
    second = make_trainer(ALL_HOOKS)
    second.load_state_dict(copy.deepcopy(state))
    second.run()
    assert not same(parameters(whole), parameters(second))


@pytest.mark.parametrize("hook", ["densify", "prune", "depth_loss"])
def test_each_hook_alone_leaves_only_its_own_trace(hook: str) -> None:
    trainer = make_trainer(only(hook))
    trainer.run()
    assert {entry.hook for entry in trainer.d2.trace} == {hook}


def random_states() -> list[object]:
    """Of the three global generators that a trainer may draw from."""
    return [torch.get_rng_state().tolist(), np.random.get_state()[1].tolist(), random.getstate()]


def test_hooks_never_touch_the_global_random_state(monkeypatch: pytest.MonkeyPatch) -> None:
    before, trainer = random_states(), make_trainer(ALL_HOOKS)
    trainer.run()
    assert {entry.action for entry in trainer.d2.trace} == {"loss", "insert", "remove"}, "the hooks did nothing"
    assert random_states() == before
    for draw in (lambda: torch.rand(1), lambda: np.random.rand(), random.random):

        def drawing(*arguments: object, draw: Callable[[], object] = draw) -> object:
            draw()
            return shuffled_pixels(*arguments)

        monkeypatch.setattr("d2_plugin.hooks.densify.shuffled_pixels", drawing)
        make_trainer(ALL_HOOKS, iterations=6).run()
        assert random_states() != before, "a hook that draws is not noticed"
        before = random_states()


def test_depth_loss_of_the_trainers_own_render_equals_a_second_render(monkeypatch: pytest.MonkeyPatch) -> None:
    model = make_model()
    adapter = Yang4DAdapter(model)
    view = make_views()[0]
    d2 = D2Hooks(only("depth_loss"), adapter, TinyStore())
    ours = renders_of_ours(monkeypatch)
    model.render(view)
    reused = d2.loss(1, view)
    assert ours == [], "the trainer's render was not used"
    assert adapter.rendered_depth(view) is None, "the render must be handed out once"
    torch.testing.assert_close(d2.loss(2, view), reused)
    assert ours == [view]
    gradients = [torch.autograd.grad(loss, model.gaussians["positions"])[0] for loss in (reused, d2.loss(3, view))]
    torch.testing.assert_close(*gradients)
    assert gradients[0].any()


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
    assert len(ours) == 3, "the count does not count"
    ours.clear()
    for view in reversed(views):
        model.render(view)
    torch.testing.assert_close(d2.loss(2, views), expected)
    assert ours == []
    for view in views:
        model.render(view)
        torch.testing.assert_close(d2.loss(3, view), d2.loss(3, view))  # the second one renders
    assert ours == views


def test_renders_of_an_earlier_step_are_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_evaluations_visit_every_view_before_any_twice() -> None:
    sampler, generator = ViewSampler(), torch.Generator().manual_seed(0)
    for view in make_views():
        sampler.add(view)
    keys = [(v.camera, v.frame) for _ in range(2) for v in sampler.sample(3, generator)]
    assert len(set(keys)) == 6
    assert ViewSampler().sample(3, generator) == []


def test_a_hook_without_a_prior_says_what_to_set() -> None:
    with pytest.raises(D2Error, match="^densify needs a depth prior: set `prior`"):
        D2Hooks.from_config({"densify": {}}, backbone=Yang4DAdapter(make_model()))
    with pytest.raises(D2Error, match="^densify, prune need a depth prior: set `prior`"):
        D2Hooks.from_config({"densify": {}, "prune": {}}, backbone=Yang4DAdapter(make_model()))


def test_a_prior_of_another_size_is_refused_with_both_values() -> None:
    view = replace(make_views()[0], width=64)
    d2 = D2Hooks(only("depth_loss"), Yang4DAdapter(make_model()), TinyStore())
    with pytest.raises(D2Error, match="is 32x24 pixels but the view is 64x24"):
        d2.loss(1, view)


def test_the_state_of_other_hooks_is_refused() -> None:
    state = D2Hooks(only("prune"), Yang4DAdapter(make_model()), TinyStore()).state_dict()
    other = D2Hooks(only("densify"), Yang4DAdapter(make_model()), TinyStore())
    with pytest.raises(D2Error, match=r"made with hooks \['prune'\] but this run has \['densify'\]"):
        other.load_state_dict(state)


class TestRetirement:
    """A hook whose last evaluations changed next to nothing costs no more surveys, and says so."""

    @staticmethod
    def config(**top: object) -> D2Config:
        nothing = {
            "densify": DensifyConfig(start=1, stop=None, every=1, max_gaussians=0),
            "prune": PruneConfig(start=1, stop=None, every=1, patience=3, tau_p=1.0),
        }
        return D2Config(**nothing, views_per_evaluation=3, **top)

    def test_idle_hooks_retire_once_their_evidence_could_have_acted(self) -> None:
        trainer = make_trainer(self.config(retire_after=4), iterations=12)
        trainer.run()
        assert trainer.d2.retired == {"densify": 4, "prune": 6}  # patience 3: two more evaluations
        assert [(t.step, t.hook) for t in trainer.d2.trace if t.action == "retire"] == [(4, "densify"), (6, "prune")]

    def test_nothing_retires_where_that_is_switched_off(self) -> None:
        trainer = make_trainer(self.config(retire_after=0), iterations=12)
        trainer.run()
        assert trainer.d2.retired == {}

    def test_a_hook_that_still_edits_stays(self) -> None:
        trainer = make_trainer(replace(ALL_HOOKS, prune=None, retire_after=2))
        trainer.run()
        inserted = [t.step for t in trainer.d2.trace if t.action == "insert" and t.count]
        assert inserted == [5, 10, 15, 20]
        assert trainer.d2.retired == {}

    def test_a_resumed_run_remembers_who_retired(self) -> None:
        trainer = make_trainer(self.config(retire_after=4), iterations=12)
        trainer.run(5)
        resumed = make_trainer(self.config(retire_after=4), iterations=12)
        resumed.load_state_dict(trainer.state_dict())
        resumed.run()
        assert resumed.d2.retired == {"densify": 4, "prune": 6}
