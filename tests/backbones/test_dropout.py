"""Gaussians left out at random in training: the mean image stays, evaluation sees all, a resume is bitwise."""

from __future__ import annotations

import io

import pytest
import torch
from tiny import ALL_HOOKS, BACKBONES, make_model, make_trainer, make_views, parameters, same

from d2_plugin.backbones.dropout import Dropout


def test_opacity_is_right_in_the_mean_and_the_chance_grows_with_the_step() -> None:
    dropout = Dropout(0.4)
    faint = torch.full((20_000,), 0.2)
    assert torch.equal(dropout.thinned(faint), faint), "nothing is left out at the first step"
    dropout.advance(50, 100)
    found = dropout.thinned(faint)
    assert (found == 0).float().mean().item() == pytest.approx(0.2, abs=0.02)
    assert found.mean().item() == pytest.approx(0.2, abs=0.01)
    assert dropout.thinned(torch.ones(100)).max() == 1


def test_only_training_renders_leave_gaussians_out() -> None:
    model, view = make_model(dropout=0.9), make_views()[0]
    model.dropout.advance(1, 1)
    with torch.no_grad():
        assert torch.equal(model.render(view).alpha, make_model().render(view).alpha)
    assert not torch.equal(model.render(view).alpha, make_model().render(view).alpha)


@pytest.mark.parametrize("backbone", BACKBONES)
def test_a_resumed_run_is_bitwise_the_uninterrupted_one(backbone: str) -> None:
    whole, first = (make_trainer(ALL_HOOKS, backbone=backbone, dropout=0.3) for _ in range(2))
    whole.run()
    first.run(until=17)
    buffer = io.BytesIO()
    torch.save(first.state_dict(), buffer)
    buffer.seek(0)
    second = make_trainer(ALL_HOOKS, backbone=backbone, seed=99, dropout=0.3)
    second.load_state_dict(torch.load(buffer, weights_only=True))
    second.run()
    assert same(parameters(whole), parameters(second))
