"""Trainers whose optimizer begins with small steps: schedules count what these are worth."""

import logging

import pytest
import torch
from repositories import make_cem4dgs
from tiny import TinyStore, make_model, make_views

from d2_plugin import D2Hooks
from d2_plugin.adapters.shared import steps_of_adam
from d2_plugin.adapters.yang4d import Yang4DAdapter
from d2_plugin.config import D2Config
from d2_plugin.hooks.hook import Context, Hook, HookConfig


class Slow(Yang4DAdapter):
    """Four of its optimizer's steps are worth one."""

    def pace(self, step: int) -> float:
        return step / 4


def radam(beta: float, **chosen: float) -> torch.optim.RAdam:
    return torch.optim.RAdam([torch.nn.Parameter(torch.zeros(1, dtype=torch.float64))], betas=(0.9, beta), **chosen)


@pytest.mark.parametrize("beta", [0.7, 0.9, 0.99, 0.999, 0.99999])
def test_a_share_is_what_torch_steps_by(beta: float) -> None:
    """A constant gradient moves Adam by its rate in each step, and RAdam by its share of that once it adapts."""
    optimizer = radam(beta, lr=1.0, eps=0.0)
    (parameter,), places = optimizer.param_groups[0]["params"], [0.0]
    for _ in range(400):
        parameter.grad = torch.full_like(parameter, 1e-12)  # next to nothing, where a step does not adapt
        optimizer.step()
        places.append(-parameter.item())
    assert [steps_of_adam(optimizer, step) for step in range(401)] == pytest.approx(places, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("beta", [0.0, 0.6, 0.61, 0.999, 1 - 1e-12])
def test_it_rises_by_a_step_at_most_and_never_falls(beta: float) -> None:
    worth = torch.tensor([steps_of_adam(radam(beta), step) for step in range(3000)], dtype=torch.float64)
    assert torch.isfinite(worth).all()
    assert ((worth.diff() >= 0) & (worth.diff() <= 1 + 1e-9)).all()
    assert worth[0] == steps_of_adam(radam(beta), -1) == 0


def test_other_optimizers_count_as_they_are() -> None:
    adam = torch.optim.Adam([torch.nn.Parameter(torch.zeros(1))])
    assert [steps_of_adam(optimizer, 70) for optimizer in (adam, None, radam(0.5))] == [70, 70, 70]


def test_cem4dgs_reads_it_from_its_optimizer() -> None:
    adapter = make_cem4dgs().adapter
    assert adapter.pace(300) == 300
    adapter.gaussians.optimizer = radam(0.999)
    assert adapter.pace(300) == pytest.approx(74.4, abs=0.1)


class Counted(Hook):
    """Notes at which steps of the schedule it was asked, and how often."""

    def __init__(self) -> None:
        super().__init__(HookConfig(start=2, stop=40, every=5))
        self.losses: list[int] = []
        self.edits: list[int] = []

    def loss(self, context: Context) -> None:
        self.losses.append(context.step)

    def edit(self, context: Context) -> None:
        self.edits.append(context.step)


def test_edits_come_once_for_each_step_that_counts(caplog: pytest.LogCaptureFixture) -> None:
    """A run of 200 steps that are worth 50 edits as often as one of 50, and has its losses in all of its steps."""
    caplog.set_level(logging.INFO, "d2_plugin")
    hook = Counted()
    d2 = D2Hooks.from_config({"densify": {}}, Slow(make_model()), TinyStore(), {"counted": hook}, iterations=200)
    for step in range(1, 201):
        d2.loss(step, make_views()[0])
        d2.step(step)
    assert hook.edits == [2, 7, 12, 17, 22, 27, 32, 37]
    assert hook.losses == [step for step in hook.edits for _ in range(4)]
    inserted = [entry.step for entry in d2.trace if entry.action == "insert" and entry.count]
    assert inserted
    assert all(step % 4 == 0 for step in inserted)
    assert "200 steps are worth 50 of Adam's" in caplog.text


def test_a_schedule_of_the_users_own_counts_the_same_way() -> None:
    config = D2Config.from_dict({"iterations": 400, "densify": {"stop": 30}}, pace=lambda step: step // 4)
    assert config.densify == D2Config.from_dict({"iterations": 100, "densify": {"stop": 30}}).densify
