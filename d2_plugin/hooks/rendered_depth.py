"""Rendered depth, its validity and its disagreement with the prior (paper, section "Densification and Pruning")."""

from __future__ import annotations

import torch
from torch import Tensor

EPSILON = 1e-8
"""The paper's epsilon: only keeps 0/0 away. What bounds the gradient of a depth is tau_v, not epsilon."""


def rendered_depth(depth_sum: Tensor, alpha: Tensor, tau_v: float) -> tuple[Tensor, Tensor]:
    """D_hat = sum w z / (A + eps) and M^r = [A > tau_v], both [H, W].

    Where M^r is 0 the depth is 0 with no gradient; the denominator is made safe before the division, since a mask
    applied afterwards would turn inf * 0 into NaN.
    """
    valid = alpha > tau_v
    safe = torch.where(valid, alpha + EPSILON, torch.ones_like(alpha))
    return torch.where(valid, depth_sum, torch.zeros_like(depth_sum)) / safe, valid


def relative_discrepancy(depth: Tensor, prior: Tensor) -> Tensor:
    """delta = |D_hat - D*| / (D* + eps), [H, W]; meaningful where the prior has support (D* > 0)."""
    return torch.abs(depth - prior) / (prior + EPSILON)
