"""The deformation field of 4DGaussians, rebuilt from its weights.

A point (x, y, z, t) looks into six planes, one for each pair of its coordinates, on several levels; on a level the six
features are multiplied, the levels stand beside each other. One hidden layer or more follows, and a head of two layers
for each attribute that is deformed: offsets of raw positions, log scales, quaternions, opacity logits and harmonics.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from d2_plugin.errors import D2Error

PAIRS = tuple(itertools.combinations(range(4), 2))
"""Of x, y, z, t: which two coordinates each plane of a level has."""
HEADS = {
    "no_dx": "pos_deform",
    "no_ds": "scales_deform",
    "no_dr": "rotations_deform",
    "no_do": "opacity_deform",
    "no_dshs": "shs_deform",
}
"""The option that leaves an attribute as it is, and the head that else deforms it, in the order of the attributes."""
UNUSED = ("no_grid", "grid_pe", "static_mlp", "empty_voxel", "apply_rotation")
"""Options that no configuration of the repository uses."""


class PlaneField:
    """What the adapter `hust4d` calls as `_deformation`."""

    def __init__(self, state: Mapping[str, Tensor], options: Mapping[str, Any], path: Path) -> None:
        """Take the weights and the options that say which attributes they deform.

        Raises:
            D2Error: other weights, an option that is not known here, or one that is not told.
        """
        chosen = [name for name in UNUSED if options.get(name)]
        if chosen:
            raise D2Error(
                f"{path} was trained with {chosen[0]}, which cannot be shown here: use Viewer(d2) in its train.py"
            )
        untold = [name for name in HEADS if not isinstance(options.get(name), bool)]
        if untold:
            raise D2Error(
                f"the options of {path} do not say {untold[0]}: expected the cfg_args that its train.py wrote"
            )
        prefix = "deformation_net."
        self.state = {name[len(prefix) :]: value for name, value in state.items() if name.startswith(prefix)}
        self.heads = {name: head for name, head in HEADS.items() if not options[name]}
        needed = ["grid.aabb", "grid.grids.0.5", "feature_out.0.weight", *(f"{head}.3.bias" for head in HEADS.values())]
        missing = [name for name in needed if name not in self.state]
        if missing:
            raise D2Error(f"{path} has no {prefix}{missing[0]}: it is no deformation field of 4DGaussians")

    @property
    def get_aabb(self) -> tuple[Tensor, Tensor]:
        """The corners of the box that the planes span."""
        return self.state["grid.aabb"][0], self.state["grid.aabb"][1]

    @torch.no_grad()
    def __call__(self, *attributes: Tensor) -> tuple[Tensor, ...]:
        """Positions [N, 3], log scales, quaternions, opacity logits [N, 1], harmonics [N, C, 3] and times [N, 1], all
        raw -> the first five at those times."""
        *raw, times = attributes
        hidden = self._hidden(raw[0], times)
        return tuple(
            values + self._head(self.heads[option], hidden).view_as(values) if option in self.heads else values
            for option, values in zip(HEADS, raw, strict=True)
        )

    def _hidden(self, positions: Tensor, times: Tensor) -> Tensor:
        first, last = self.get_aabb
        point = torch.cat([(positions - first) * (2 / (last - first)) - 1, times], -1)
        levels = sum(name.startswith("grid.grids.") and name.endswith(".0") for name in self.state)
        hidden = torch.cat([self._level(level, point) for level in range(levels)], -1)
        layers = sorted(int(name.split(".")[1]) for name in self.state if name.startswith("feature_out."))
        for layer in sorted(set(layers)):
            hidden = self._through(f"feature_out.{layer}", hidden.relu() if layer else hidden)
        return hidden

    def _level(self, level: int, point: Tensor) -> Tensor:
        """The product of the six planes of one level at points [N, 4]: [N, features]."""
        product = torch.ones(())
        for i, pair in enumerate(PAIRS):
            plane, places = self.state[f"grid.grids.{level}.{i}"], point[None, None, :, list(pair)]
            seen = functional.grid_sample(plane, places, align_corners=True, padding_mode="border")
            product = product * seen[0, :, 0].T
        return product

    def _head(self, name: str, hidden: Tensor) -> Tensor:
        return self._through(f"{name}.3", self._through(f"{name}.1", hidden.relu()).relu())

    def _through(self, name: str, values: Tensor) -> Tensor:
        return functional.linear(values, self.state[f"{name}.weight"], self.state[f"{name}.bias"])
