"""The slice of a 4D Gaussian at an instant, against golden vectors of the reference implementation."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from slice_scenes import GOLDEN

from d2_plugin.gaussians.rotation4d import (
    condition_on_time,
    covariances_from_factors,
    normalized_quaternions,
    rotation_matrices_3d,
    rotation_matrices_4d,
    temporal_marginal,
    time_row,
)


def tensor(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def random_quaternions(seed: int, count: int, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return normalized_quaternions(torch.randn(4, count, generator=generator, dtype=torch.float64)).to(dtype)


@pytest.mark.parametrize("name", GOLDEN)
def test_slice_agrees_with_the_reference_implementation(name: str) -> None:
    mean, mean_time, scales, left, right, instant, at, covariance, marginal, variance, velocity = GOLDEN[name]
    left, right = normalized_quaternions(tensor(*left)[:, None]), normalized_quaternions(tensor(*right)[:, None])
    factors = rotation_matrices_4d(left, right) * tensor(*scales)[:, None]
    spatial, speed = condition_on_time(factors)
    v_t = (time_row(left, right) * tensor(*scales)[:, None]).square().sum(0)
    np.testing.assert_allclose(v_t[0], variance, rtol=1e-12)
    np.testing.assert_allclose(tensor(*mean) + speed[:, 0] * (instant - mean_time), tensor(*at), atol=5e-9)
    np.testing.assert_allclose(covariances_from_factors(spatial)[0], tensor(*covariance), atol=5e-9)
    np.testing.assert_allclose(temporal_marginal(tensor(instant - mean_time), v_t)[0], marginal, rtol=1e-12)
    if velocity is not None:
        np.testing.assert_allclose(speed[:, 0], tensor(*velocity), atol=5e-9)


def test_rotations_are_proper_and_time_row_is_their_last_row() -> None:
    left, right = random_quaternions(0, 200), random_quaternions(1, 200)
    rotation = rotation_matrices_4d(left, right)
    matrices = rotation.movedim(-1, 0)
    torch.testing.assert_close(matrices @ matrices.mT, torch.eye(4, dtype=torch.float64).expand_as(matrices))
    torch.testing.assert_close(torch.linalg.det(matrices), torch.ones(200, dtype=torch.float64))
    torch.testing.assert_close(time_row(left, right), rotation[3])


def test_equal_quaternions_leave_time_alone_and_rotate_space_with_x_and_z_swapped() -> None:
    q = random_quaternions(2, 50)
    rotation = rotation_matrices_4d(q, q)
    swap = torch.tensor([2, 1, 0])
    torch.testing.assert_close(rotation[:3, :3], rotation_matrices_3d(q)[swap][:, swap])
    torch.testing.assert_close(rotation[3], tensor(0, 0, 0, 1)[:, None].expand(4, 50))


def test_factor_form_equals_the_schur_complement_in_float64() -> None:
    scales = tensor(0.1, 0.2, 0.05, 0.5)[:, None]
    factors = rotation_matrices_4d(random_quaternions(3, 100), random_quaternions(4, 100)) * scales
    sigma = torch.einsum("ikn,jkn->nij", factors, factors)
    u, v = sigma[:, :3, 3], sigma[:, 3, 3]
    schur = sigma[:, :3, :3] - u[:, :, None] * u[:, None] / v[:, None, None]
    spatial, velocity = condition_on_time(factors)
    torch.testing.assert_close(torch.einsum("ikn,jkn->nij", spatial, spatial), schur)
    torch.testing.assert_close(velocity.T, u / v[:, None])
