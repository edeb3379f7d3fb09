"""Stopping early: patches that no loss sees, an end when their error rises, and a resume that knows of it."""

from __future__ import annotations

import io

import pytest
import torch
from tiny import HEIGHT, WIDTH, TinyFrames, make_trainer, parameters, same

from d2_plugin.backbones.early_stop import EarlyStop, EarlyStopSettings


def test_patches_cover_the_share_and_are_the_same_each_time() -> None:
    stop = EarlyStop(EarlyStopSettings(share=0.2), seed=1)
    masks = [stop.mask(index, 180, 320) for index in range(20)]
    assert torch.stack(masks).float().mean().item() == pytest.approx(0.2, abs=0.03)
    assert torch.equal(masks[3], EarlyStop(EarlyStopSettings(share=0.2), seed=1).mask(3, 180, 320))
    assert not torch.equal(masks[3], masks[4])


def test_no_gradient_comes_from_a_held_out_patch() -> None:
    stop = EarlyStop(EarlyStopSettings(share=0.3), seed=0)
    rendered, image = torch.rand(HEIGHT, WIDTH, 3, requires_grad=True), torch.rand(HEIGHT, WIDTH, 3)
    (rendered - stop.target(0, image, rendered)).abs().sum().backward()
    assert rendered.grad is not None
    assert torch.equal(rendered.grad.abs().sum(-1) == 0, stop.mask(0, HEIGHT, WIDTH))


def test_it_stops_when_the_smallest_error_is_old() -> None:
    stop = EarlyStop(EarlyStopSettings(share=0.1, patience=2), seed=0)
    for error, stopped in ((3.0, False), (1.0, False), (1.5, False), (0.9, False), (1.0, False), (2.0, True)):
        stop.rounds.append(error)
        assert stop.stopped is stopped


class Worse(TinyFrames):
    """Images that are other ones in every round: what is learnt in one does not hold in the next."""

    def __init__(self) -> None:
        super().__init__()
        self.shown = 0

    def image(self, index: int) -> torch.Tensor:
        self.shown += 1
        return (super().image(index) + 0.4 * (self.shown // len(self.views))).clamp(0, 3)


def test_a_run_ends_early_and_a_resumed_one_stays_ended() -> None:
    trainer = make_trainer(iterations=60, early_stop=EarlyStopSettings(share=0.3, patience=2))
    trainer.frames = Worse()
    trainer.run()
    assert trainer.stopped
    assert trainer.step < 60
    buffer = io.BytesIO()
    torch.save(trainer.state_dict(), buffer)
    buffer.seek(0)
    resumed = make_trainer(iterations=60, early_stop=EarlyStopSettings(share=0.3, patience=2))
    resumed.load_state_dict(torch.load(buffer, weights_only=True))
    resumed.run()
    assert resumed.step == trainer.step
    assert same(parameters(resumed), parameters(trainer))


def test_a_resumed_run_is_bitwise_the_uninterrupted_one() -> None:
    chosen = {"early_stop": EarlyStopSettings(share=0.2, patience=50)}
    whole, first, second = (make_trainer(**chosen) for _ in range(3))
    whole.run()
    first.run(until=17)  # in the middle of a round
    second.load_state_dict(first.state_dict())
    second.run()
    assert same(parameters(whole), parameters(second))
    assert whole.early_stop.rounds == second.early_stop.rounds != []
