"""Noise on the places of Gaussians while they train: how wide it is, also for thin ones, and which runs have it.

That a run with it is resumed bitwise is tested with everything else that a run keeps (test_both_backbones.py).
"""

import pytest
import torch
from tiny import BACKBONES, make_model, make_trainer, make_views, parameters, same

from d2_plugin import D2Config
from d2_plugin.backbones import trainer as training
from d2_plugin.backbones.jitter import offsets


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def packed(covariance: torch.Tensor) -> torch.Tensor:
    """[..., 3, 3] as [..., 6]: xx xy xz yy yz zz."""
    rows, columns = torch.triu_indices(3, 3)
    return covariance[..., rows, columns]


def test_places_are_drawn_from_the_gaussian_itself() -> None:
    factor = torch.tensor([[1.0, 0, 0], [-0.9, 0.4, 0], [0.2, 0.3, 0.05]], dtype=torch.float64)
    drawn = offsets(packed(factor @ factor.T).expand(100_000, 6), generator())
    torch.testing.assert_close(drawn.T @ drawn / len(drawn), factor @ factor.T, rtol=0.02, atol=0.005)


@pytest.mark.parametrize("axes", [(1e2, 1e-3, 1e-6), (1e6, 1e6, 1e-6), (1e-18, 1e-18, 1e-18), (1e15, 1.0, 1.0)])
def test_a_draw_is_no_wider_than_the_gaussian_however_thin_that_is(axes: tuple[float, float, float]) -> None:
    """In single precision the covariances of thin ones are indefinite by rounding."""
    turned = torch.linalg.qr(torch.randn(2000, 3, 3, generator=generator(1))).Q
    covariance = packed((turned * torch.tensor(axes) ** 2) @ turned.mT)
    drawn = offsets(covariance, generator())
    widths = covariance[:, [0, 3, 5]].sqrt()
    assert (drawn.abs() <= 8 * widths + 1e-18).all()
    assert (drawn.abs().amax(0) > 0.1 * widths.amax(0)).all()


def test_a_gaussian_without_extent_stays() -> None:
    assert offsets(torch.zeros(10, 6), generator()).abs().max() < 1e-15
    broken = torch.tensor([[0.0, 1, 1, 1, 1, 1], [1, 5, 5, 1, 5, 1]])  # no covariances at all
    assert offsets(broken, generator()).abs().max() < 10


@pytest.mark.parametrize("name", BACKBONES)
def test_only_a_training_step_moves_gaussians_aside(name: str) -> None:
    model, [view, *_] = make_model(20, backbone=name), make_views()
    still, aside, again, other = (
        model.render(view, generator=g).color for g in (None, generator(), generator(), generator(1))
    )
    assert torch.equal(still, model.render(view).color)
    assert torch.equal(aside, again)
    assert not torch.equal(aside, still)
    assert not torch.equal(aside, other)


def test_short_runs_and_runs_without_jitter_have_none(monkeypatch: pytest.MonkeyPatch) -> None:
    def trained(steps: int, **settings: float) -> dict[str, torch.Tensor]:
        made = make_trainer(D2Config(), steps, **settings)
        made.run()
        return parameters(made)

    without = trained(8, jitter=0.0)
    assert same(trained(8), without)
    monkeypatch.setattr(training, "JITTER_FROM", 8)
    assert same(trained(8, jitter=0.0), without)
    assert not same(trained(8), without)
