"""4D Gaussians sliced at an instant: rotations from two quaternions and the conditional 3D Gaussian.

Axes are (x, y, z, t). Source of the conventions: fudan-zvg/4d-gaussian-splatting (general_utils.py, forward.cu).

Components come first here, Gaussians last ([4, N] quaternions, [4, 4, N] matrices): every operation then runs over
contiguous rows of N numbers, which on a CPU is some twenty times faster than batches of small matrices.
"""

from __future__ import annotations

import torch
from torch import Tensor

SMALL_NORM = 1e-30
"""Quaternions shorter than this have no direction and are read as the identity; float32 can invert longer ones."""


def normalized_quaternions(quaternions: Tensor) -> Tensor:
    """Unit quaternions [4, N], w first; zero, vanishing and non-finite ones become the identity with zero gradient."""
    largest = quaternions.detach().abs().amax(0)
    ok = (largest > SMALL_NORM) & torch.isfinite(largest)
    if ok.is_cuda or not ok.all():  # to ask a GPU would be to wait for it
        identity = torch.zeros_like(quaternions)
        identity[0] = 1
        quaternions = torch.where(ok, quaternions, identity)
        largest = torch.where(ok, largest, torch.ones_like(largest))
    scaled = quaternions / largest  # keeps the squares inside the range of float32
    return scaled * scaled.square().sum(0).rsqrt()


def unit_quaternions(rows: Tensor) -> Tensor:
    """Unit quaternions [4, N], components first, from raw rows [N, 4]."""
    return normalized_quaternions(rows.T.contiguous())


def rotation_matrices_4d(left: Tensor, right: Tensor) -> Tensor:
    """R [4, 4, N] = J (M_l M_r) J from unit quaternions left, right [4, N]; J reverses the order of the axes.

    Meaning: R v = q_l v conj(q_r) for v = (t, z, y, x) read as a quaternion with real part t.
    """
    a, b, c, d = left
    p, q, r, s = right
    j_left = torch.stack([d, -c, b, a, c, d, a, -b, b, a, -d, c, a, -b, -c, -d]).view(4, 4, 1, -1)  # J M_l
    right_j = torch.stack([s, r, q, p, r, -s, p, -q, -q, p, s, -r, p, q, -r, -s]).view(4, 4, -1)  # M_r J
    return (j_left * right_j).sum(1)


def time_row(left: Tensor, right: Tensor) -> Tensor:
    """Last row of `rotation_matrices_4d`, [4, N]: enough for the temporal variance of every Gaussian."""
    a, b, c, d = left
    p, q, r, s = right
    return torch.stack(
        [
            a * s - b * r + c * q - d * p,
            a * r + b * s - c * p - d * q,
            a * q - b * p - c * s + d * r,
            a * p + b * q + c * r + d * s,
        ]
    )


def rotation_matrices_3d(quaternions: Tensor) -> Tensor:
    """R [3, 3, N] from unit quaternions [4, N], w first."""
    w, x, y, z = quaternions
    return torch.stack(
        [
            1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
        ]
    ).view(3, 3, -1)  # fmt: skip


def covariances_from_factors(factors: Tensor) -> Tensor:
    """Rows xx xy xz yy yz zz, [N, 6], of A A^T for factors A [3, K, N]."""
    x, y, z = factors
    pairs = ((x, x), (x, y), (x, z), (y, y), (y, z), (z, z))
    return torch.stack([(u * v).sum(0) for u, v in pairs], -1)


def temporal_marginal(offset: Tensor, variance: Tensor) -> Tensor:
    """F(t) = exp(-offset^2 / (2 variance)) in 0..1, not normalised; both [N], variance > 0."""
    return torch.exp(-0.5 * offset * offset / variance)


def condition_on_time(factors: Tensor) -> tuple[Tensor, Tensor]:
    """The spatial Gaussian given time, from factors L [4, 4, N] of Sigma = L L^T.

    A Householder reflection H turns the last row of L into (0, 0, 0, l); then L H = [[A, w], [0, l]] and the
    conditional covariance is A A^T, the velocity w / l. Subtracting u u^T / v_t from the covariance instead loses
    positive definiteness in float32 for up to 76 % of rotations at sigma_t = 100.

    Returns A [3, 3, N] and the velocity [3, N] (world units per unit of time).
    """
    spatial, last = factors[:3], factors[3]
    length = last.square().sum(0).sqrt()
    unit = last / length
    sign = torch.where(unit[3] >= 0, 1.0, -1.0).to(unit)
    axis = torch.cat([unit[:3], (unit[3] + sign)[None]])  # no cancellation: the signs agree
    along = (spatial * axis).sum(1) / (1 + unit[3] * sign)
    rotated = spatial - along[:, None] * axis
    return rotated[:, :3], rotated[:, 3] / (-sign * length)


def identities(count: int, like: Tensor) -> Tensor:
    """Quaternions [count, 4], w first, that turn nothing, with the dtype and device of `like`."""
    identity = like.new_zeros(count, 4)
    identity[:, 0] = 1
    return identity
