"""A trainer with the three lines stops soon after a number of its model is none any more, and says which one."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from tiny import ALL_HOOKS, BACKBONES, make_adapter, make_model, make_trainer, make_views

from d2_plugin.backbones.trainer import Trainer
from d2_plugin.hooks.finite import Diverged, FiniteCheck

QUIET = replace(ALL_HOOKS, densify=None, prune=None, finite_every=6)
"""The depth loss alone, so that nothing looks but the check."""


def poisoned(trainer: Trainer, at: int, name: str = "opacity_logits", value: float = math.nan) -> Callable[..., None]:
    """Called after each step; spoils one number of one parameter after that of number `at`."""

    def on_step(step: int, loss: float) -> None:
        if step == at:
            trainer.model.gaussians[name].data.view(-1)[7] = value

    return on_step


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_training_stops_at_the_next_look_with_the_parameter(value: float) -> None:
    trainer = make_trainer(QUIET)
    told = (
        r"at step 12 or less than 6 steps before it \(.* of \S+ is NaN or infinite.*\): no state was saved yet; lower"
    )
    with pytest.raises(Diverged, match=told):
        trainer.run(20, poisoned(trainer, 7, "positions", value))


def test_it_is_looked_before_anything_is_inserted_or_removed() -> None:
    trainer = make_trainer(replace(ALL_HOOKS, finite_every=1000))
    with pytest.raises(Diverged, match=r"at step 5 or"):
        trainer.run(20, poisoned(trainer, 3))


def test_the_last_saved_step_is_told_and_a_spoilt_state_is_not_saved() -> None:
    trainer = make_trainer(QUIET)
    trainer.run(4)
    state = copy.deepcopy(trainer.state_dict())
    trainer.run(8, poisoned(trainer, 8))
    with pytest.raises(Diverged, match=r"at step 8 .* the last state that was saved is of step 4"):
        trainer.state_dict()
    trainer = make_trainer(QUIET)
    trainer.load_state_dict(state)
    with pytest.raises(Diverged, match=r"the last state that was saved is of step 4"):
        trainer.run(20, poisoned(trainer, 7))


def test_a_loss_of_d2_that_is_not_finite_is_reported() -> None:
    check = FiniteCheck(make_adapter(make_model()), 1)
    check.remember(torch.tensor(math.nan), [])
    with pytest.raises(Diverged, match=r"\(D2's loss is nan\)"):
        check.check(3, now=False)


def test_it_can_be_switched_off() -> None:
    trainer = make_trainer(replace(QUIET, finite_every=0))
    trainer.run(8, poisoned(trainer, 7))
    assert trainer.step == 8
    trainer.state_dict()


@pytest.mark.parametrize("backbone", BACKBONES)
def test_every_tensor_that_is_trained_is_checked(backbone: str) -> None:
    model = make_model(backbone=backbone)
    check = FiniteCheck(make_adapter(model), 1)
    check.check(1, now=False)
    for name, value in make_adapter(model).trained().items():
        kept = value.detach().clone()
        value.data.view(-1)[-1] = math.inf
        with pytest.raises(Diverged, match=name.replace(".", r"\.")):
            check.check(1, now=False)
        value.data.copy_(kept)
    check.check(1, now=False)


def test_a_backbone_without_trained_is_checked_through_its_slice() -> None:
    model = make_model()

    class Bare:
        """Nothing optional."""

        slice_at = staticmethod(model.slice_at)

    bare: Any = Bare()
    check, views = FiniteCheck(bare, 1), make_views()
    check.check(1, now=True)  # nothing was trained on yet, so nothing can be asked
    check.remember(0.0, views[:1])
    check.check(2, now=False)
    model.gaussians["base_colors"].data.fill_(math.nan)
    check.check(3, now=False)  # what it does not tell cannot be seen
    model.gaussians["opacity_logits"].data.fill_(math.nan)
    with pytest.raises(Diverged, match="of opacities is NaN"):
        check.check(4, now=False)
