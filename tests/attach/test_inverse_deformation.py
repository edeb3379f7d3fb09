"""Inversion of a deformation field: exact where it can be, damped where it must be, honest where it cannot be."""

import pytest
import torch
from torch import Tensor

from d2_plugin.adapters.inverse_deformation import invert_at_times, invert_deformation, neighbour_offsets
from d2_plugin.protocol import Points


def targets_of(count: int = 200, seed: int = 0) -> Tensor:
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(seed)) * 4 - 2


NOBODY = torch.empty(0, 3)


def smooth(x: Tensor) -> Tensor:
    return x + 0.3 * torch.sin(x.roll(1, -1)) + torch.tensor([1.0, -0.5, 0.2])


def steep(x: Tensor) -> Tensor:
    """Monotone with slopes from 0.1 to 3.1; from 2 on the plain fixed point jumps past the root and away."""
    return 1.6 * x + 0.25 * torch.sin(6 * x)


def test_a_smooth_field_is_inverted_within_the_tolerance() -> None:
    inversion = invert_deformation(smooth, targets_of(), NOBODY, NOBODY, tolerance=1e-3, steps=12)
    assert inversion.accepted.all()
    assert (smooth(inversion.positions) - targets_of()).norm(dim=-1).max() <= 1e-3


def test_damping_converges_where_the_plain_fixed_point_does_not() -> None:
    targets = targets_of()
    plain = targets.clone()
    for _ in range(30):
        plain = plain + (targets - steep(plain))
    stuck = (targets - steep(plain)).norm(dim=-1) > 1e-2
    assert stuck.float().mean() > 0.2, "the plain fixed point converges too: this test could not fail"
    damped = invert_deformation(steep, targets, NOBODY, NOBODY, tolerance=1e-2, steps=30)
    assert damped.accepted[stuck].float().mean() > 0.97


def test_a_point_that_no_canonical_position_reaches_keeps_its_neighbours_offset() -> None:
    def squash(x: Tensor) -> Tensor:
        return torch.tanh(x)  # nothing is ever deformed beyond 1

    targets = torch.tensor([[0.5, 0.0, 0.0], [3.0, 0.0, 0.0]])
    means, offsets = torch.tensor([[2.5, 0.0, 0.0]]), torch.tensor([[0.25, 0.0, 0.0]])
    inversion = invert_deformation(squash, targets, means, offsets, tolerance=1e-2, steps=20)
    assert inversion.accepted.tolist() == [True, False]
    assert torch.equal(inversion.positions[1], targets[1] - offsets[0])
    assert inversion.residuals[1] > 1


def test_a_field_that_returns_nan_is_not_accepted_and_stays_finite() -> None:
    def broken(x: Tensor) -> Tensor:
        return torch.where(x[:, :1] > 0, torch.full_like(x, torch.nan), x)

    targets = targets_of(50)
    inversion = invert_deformation(broken, targets, NOBODY, NOBODY, tolerance=0.1)
    assert torch.equal(inversion.accepted, targets[:, 0] <= 0)
    assert inversion.positions.isfinite().all()


def test_every_point_is_inverted_at_its_own_time() -> None:
    targets, times, ones = targets_of(3), torch.tensor([0.0, 1.0, 2.0]), torch.ones(3)
    wind = torch.tensor([1.0, 0.0, 0.0])
    inversion = invert_at_times(Points(targets, targets, times, ones, ones), lambda x, time: x + time * wind, NOBODY)
    torch.testing.assert_close(inversion.positions, targets - times[:, None] * wind)
    assert inversion.accepted.all()


@pytest.mark.parametrize("count", [1, 7, 300])
def test_the_nearest_gaussian_lends_its_offset_even_far_from_the_origin(count: int) -> None:
    shift = torch.tensor([1e4, -2e4, 5e3])
    means = torch.cat([targets_of(count, seed=1) + shift, torch.full((1, 3), torch.nan)])  # the last one is nowhere
    offsets = torch.arange(3.0 * count + 3).view(-1, 3)
    there = (means[:-1] - shift).double()
    exact = torch.cdist(targets_of().double(), there, compute_mode="donot_use_mm_for_euclid_dist")
    lent = neighbour_offsets(targets_of() + shift, means, offsets)
    assert (lent == offsets[exact.argmin(1)]).all(1).float().mean() > 0.97
