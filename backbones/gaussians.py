"""Per-Gaussian parameters whose Adam rows and statistics change together with them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import deepcopy
from typing import Any

import torch
from torch import Tensor, nn


class Gaussians:
    """N Gaussians as named tensors with one row each, and one Adam with a parameter group per name.

    Structure changes through two functions only: `append` adds rows at the end, `select` keeps rows by index. Both
    carry the Adam moments and the `statistics` (tensors with one row per Gaussian) along; new rows start at zero.
    """

    def __init__(self, rows: Mapping[str, Tensor], learning_rates: Mapping[str, float]) -> None:
        self.parameters = {name: nn.Parameter(value.detach().clone()) for name, value in rows.items()}
        self.statistics: dict[str, Tensor] = {}
        groups = [{"params": [p], "lr": learning_rates[name], "name": name} for name, p in self.parameters.items()]
        self.optimizer = torch.optim.Adam(groups, lr=0.0, eps=1e-15, fused=True)

    def __len__(self) -> int:
        return len(next(iter(self.parameters.values())))

    def __getitem__(self, name: str) -> Tensor:
        return self.parameters[name]

    @property
    def device(self) -> torch.device:
        """Device of the parameters."""
        return next(iter(self.parameters.values())).device

    def append(self, rows: Mapping[str, Tensor]) -> None:
        """Add K rows (each tensor [K, ...]) at the end; their moments and statistics are zero."""
        count = len(next(iter(rows.values())))
        for name in self.parameters:
            self._replace(name, lambda old, new=rows[name]: torch.cat([old, new.to(old)]), zeros=rows[name])
        for name, value in self.statistics.items():
            self.statistics[name] = torch.cat([value, value.new_zeros(count, *value.shape[1:])])

    def select(self, index: Tensor) -> None:
        """Keep the rows `index` (int64 [K], in this order), their moments and statistics."""
        for name in self.parameters:
            self._replace(name, lambda old: old[index])
        self.statistics = {name: value[index] for name, value in self.statistics.items()}

    def state_dict(self) -> dict[str, Any]:
        """Everything that an exact continuation needs."""
        return {
            "parameters": {name: value.detach().clone() for name, value in self.parameters.items()},
            "statistics": {name: value.clone() for name, value in self.statistics.items()},
            "optimizer": deepcopy(self.optimizer.state_dict()),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from `state_dict()`, whatever the present number of Gaussians."""
        for name, value in state["parameters"].items():
            self._replace(name, lambda old, new=value: new.to(old, copy=True), keep_moments=False)
        self.statistics = {name: value.to(self.device, copy=True) for name, value in state["statistics"].items()}
        self.optimizer.load_state_dict(deepcopy(state["optimizer"]))

    @torch.no_grad()
    def _replace(
        self, name: str, change: Callable[..., Tensor], zeros: Tensor | None = None, keep_moments: bool = True
    ) -> None:
        """Swap one Parameter for a changed one, its Adam moments changed alike (`zeros`: rows appended with none)."""
        old = self.parameters[name]
        new = nn.Parameter(change(old.detach()).contiguous())
        moments = self.optimizer.state.pop(old, None)
        if moments and keep_moments:
            for key in ("exp_avg", "exp_avg_sq"):
                value = moments[key]
                moments[key] = change(value) if zeros is None else torch.cat([value, torch.zeros_like(zeros).to(value)])
            self.optimizer.state[new] = moments
        for group in self.optimizer.param_groups:
            if group["name"] == name:
                group["params"][0] = new
        self.parameters[name] = new
