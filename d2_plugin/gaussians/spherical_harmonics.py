"""View- and time-dependent colour: real spherical harmonics times cosines in time (4D spherical harmonics).

Source: fudan-zvg/4d-gaussian-splatting sh_utils.py: coefficient (n, k) multiplies cos(2 pi n dt / duration) Y_k(d).
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

SH_C0 = 0.28209479177387814
"""Y_0, the constant harmonic: a colour c in 0..1 is stored as the coefficient (c - 0.5) / Y_0."""


def basis(directions: Tensor, degree: int) -> Tensor:
    """Real spherical harmonics Y_k [M, (degree + 1)^2] of unit directions [M, 3]; degree 0..3, Inria's signs."""
    x, y, z = directions.unbind(-1)
    values = [torch.full_like(x, SH_C0)]
    if degree >= 1:
        values += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        values += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * zz - xx - yy),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
        ]
    if degree >= 3:
        values += [
            -0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy),
            0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.4570457994644658 * x * (4 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ]
    return torch.stack(values, -1)


def channel_count(degree: int, time_degree: int) -> int:
    """Coefficients per colour channel: (degree + 1)^2 for each of the time_degree + 1 cosines."""
    return (degree + 1) ** 2 * (time_degree + 1)


def colors(coefficients: Tensor, directions: Tensor, phase: Tensor | None, degree: int, time_degree: int) -> Tensor:
    """RGB [M, 3] >= 0 from coefficients [M, channel_count, 3].

    `directions` [M, 3] point from the camera centre to the Gaussian (any length); `phase` [M] is
    (t - mu_t) / duration, None when time_degree is 0.
    """
    if degree == 0 and not time_degree:
        return constant_colors(coefficients)
    if degree == 0:
        values = coefficients.new_full((len(coefficients), 1), SH_C0)
    else:
        values = basis(torch.nn.functional.normalize(directions, dim=-1), degree)
    if time_degree:
        assert phase is not None, "see above"
        waves = torch.stack([torch.cos(phase * (2 * math.pi * n)) for n in range(time_degree + 1)], -1)
        values = (waves[:, :, None] * values[:, None]).flatten(1)
    return not_negative((values[..., None] * coefficients).sum(1) + 0.5)


def constant_colors(coefficients: Tensor) -> Tensor:
    """RGB [M, 3] >= 0 from coefficients [M, 1, 3], which depend on neither direction nor time."""
    return not_negative(SH_C0 * coefficients[:, 0] + 0.5)


def not_negative(values: Tensor) -> Tensor:
    """max(values, 0), any shape; below 0 a gradient that would raise a value passes, where relu has none.

    With relu black is a trap: a step too long takes a colour below 0, and nothing ever leads it back.
    """
    result: Tensor = _NotNegative.apply(values)
    return result


class _NotNegative(torch.autograd.Function):
    @staticmethod
    def forward(context: Any, values: Tensor) -> Tensor:
        context.save_for_backward(values > 0)
        return torch.relu(values)

    @staticmethod
    def backward(context: Any, *gradients: Tensor) -> Tensor:
        (gradient,), (above,) = gradients, context.saved_tensors
        return torch.where(above | (gradient < 0), gradient, 0)


def coefficients_from_rgb(rgb: Tensor, degree: int, time_degree: int) -> Tensor:
    """Coefficients [N, channel_count, 3] of constant colours rgb [N, 3]."""
    coefficients = rgb.new_zeros(len(rgb), channel_count(degree, time_degree), 3)
    coefficients[:, 0] = (rgb - 0.5) / SH_C0
    return coefficients
