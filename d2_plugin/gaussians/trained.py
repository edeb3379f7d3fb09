"""The tensors that a model of Gaussians trains, by name."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor


def trained_tensors(model: Any) -> Iterator[tuple[str, Tensor]]:
    """Of its Gaussians and of each network or background that it holds."""
    for owner, part in vars(model).items():
        own_parameters = getattr(part, "parameters", None)
        if isinstance(own_parameters, dict):
            yield from own_parameters.items()
        elif isinstance(part, torch.nn.Module):
            yield from ((f"{owner}.{name}", value) for name, value in part.named_parameters())
        elif hasattr(part, "__dict__"):
            own = vars(part).items()
            yield from ((f"{owner}.{name}", value) for name, value in own if isinstance(value, torch.nn.Parameter))
