"""Noise on the places of Gaussians while they train: with few cameras each otherwise relies on where the others are.

Gaussians that reproduce the training images only where each stands exactly show something else from aside. Chen et al.
2025 call it co-adaptation, and put noise on opacities; noise on places loses nothing beyond errors (docs/evidence.md).
"""

from __future__ import annotations

import torch
from torch import Tensor

from d2_plugin.rasterizer import Splats


@torch.no_grad()
def offsets(covariances: Tensor, generator: torch.Generator) -> Tensor:
    """A draw [M, 3] from each of M Gaussians around 0 with `covariances` [M, 6] (xx xy xz yy yz zz).

    L v for a standard normal v, where L = (a; b d; c e f) is the covariance's Cholesky factor. One that rounding left
    indefinite, as that of a very thin Gaussian, gives a draw no wider than it is along each axis of the world.
    `generator` is one of the CPU.
    """
    xx, xy, xz, yy, yz, zz = covariances.unbind(-1)
    least = torch.finfo(xx.dtype).tiny
    if xx.is_cuda:  # drawn there, without a wait
        generator = torch.Generator(xx.device).manual_seed(int(torch.randint(1 << 62, (), generator=generator)))
    x, y, z = torch.randn(3, len(xx), generator=generator, dtype=xx.dtype, device=xx.device)
    a = xx.clamp(min=least).sqrt()
    b, c = _within(xy / a, yy), _within(xz / a, zz)
    d, rest = (yy - b * b).clamp(min=least).sqrt(), zz - c * c
    e = _within((yz - b * c) / d, rest)
    f = (rest - e * e).clamp(min=0).sqrt()
    return torch.stack([a * x, b * x + d * y, c * x + e * y + f * z], -1)


def jittered(splats: Splats, spread: float, generator: torch.Generator) -> Splats:
    """Each Gaussian at a place drawn from itself, `spread` times as wide; gradients are those of its own place."""
    return splats._replace(means=splats.means + spread * offsets(splats.covariances, generator))


def _within(values: Tensor, squares: Tensor) -> Tensor:
    limits = squares.clamp(min=0).sqrt()
    return values.clamp(-limits, limits)
