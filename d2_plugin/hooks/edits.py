"""What becomes of the hooks' edits before the backbone makes them."""

from __future__ import annotations

import torch
from torch import Tensor


def spread_over(mask: Tensor, most: int) -> Tensor:
    """`most` of the True rows of `mask` [N], spread evenly over them."""
    rows = torch.nonzero(mask).squeeze(1)
    chosen = torch.arange(most, device=mask.device) * len(rows) // max(most, 1)
    return torch.zeros_like(mask).index_fill(0, rows[chosen], True)
