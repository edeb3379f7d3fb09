"""What cem-4dgs calls of pytorch3d: products of quaternions.

Quaternions [..., 4] have w first. As in pytorch3d nothing is normalised here, and a product has w >= 0.
"""

from __future__ import annotations

import torch
from torch import Tensor


def quaternion_multiply(a: Tensor, b: Tensor) -> Tensor:
    """The rotation b and then a, with w >= 0."""
    product = _product(a, b)
    return torch.where(product[..., :1] < 0, -product, product)


def quaternion_invert(quaternion: Tensor) -> Tensor:
    """The conjugate: the inverse of a unit quaternion."""
    return torch.cat([quaternion[..., :1], -quaternion[..., 1:]], -1)


def quaternion_apply(quaternion: Tensor, point: Tensor) -> Tensor:
    """Points [..., 3], turned by q p q*; a quaternion that is not of unit length scales them by its square."""
    pure = torch.cat([torch.zeros_like(point[..., :1]), point], -1)
    return _product(_product(quaternion, pure), quaternion_invert(quaternion))[..., 1:]


def _product(a: Tensor, b: Tensor) -> Tensor:
    scalar = a[..., :1] * b[..., :1] - (a[..., 1:] * b[..., 1:]).sum(-1, keepdim=True)
    crossed = torch.linalg.cross(*torch.broadcast_tensors(a[..., 1:], b[..., 1:]))
    return torch.cat([scalar, a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:] + crossed], -1)
