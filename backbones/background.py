"""What lies behind all Gaussians: a colour at infinity that depends on the direction alone.

For skies, and for what no training camera has seen: there a held-out camera would look through into black.
Spherical harmonics of the viewing direction, so a held-out camera sees the same sky, and too smooth to stand in for a
surface. Composited with what the Gaussians leave of a ray: color + (1 - alpha) background. That smooth a colour needs
no evaluation at each pixel: it is computed at a few directions and interpolated.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from typing import Any

import torch
from torch import Tensor, nn

from d2_plugin.gaussians.native_background import can_composite, composite_background
from d2_plugin.gaussians.spherical_harmonics import SH_C0, basis
from d2_plugin.rasterizer import Render, View

from .appearance import changed

DEGREE = 3
"""Of the harmonics."""
RATE = 1e-2
"""Learning rate of the constant term; the others learn at a fifth of it."""
NODES = 40
"""Directions across the image at which the colour is computed; smaller images have one at each pixel."""
STARTING_IMAGES = 32
"""Images that its first colours are fitted to."""
RIDGE = 3e-2
"""Weight of the squared coefficients, times the square of their degree, beside the mean squared error."""
UNSEEN = 0.3
"""Weight of half the squared difference from the first colours where no training view looks, mean over all directions.
Colours of a sky or of a wall that are learnt beside it would else go on to there."""
DIRECTIONS = 4000
"""At how many of them that is known."""
FAR_AWAY = 1e9
"""So far away that it does not matter where a camera stands, world units."""
KEPT_CAMERAS = 256
"""Cameras whose harmonics are kept."""


class Background:
    """Colours at infinity with their optimizer."""

    def __init__(self, device: torch.device) -> None:
        self.constant = nn.Parameter(torch.zeros(1, 3, device=device))
        self.harmonics = nn.Parameter(torch.zeros((DEGREE + 1) ** 2 - 1, 3, device=device))
        groups = [{"params": [self.constant], "lr": RATE}, {"params": [self.harmonics], "lr": RATE / 5}]
        self.optimizer = torch.optim.Adam(groups, eps=1e-15, fused=True)
        self.first = torch.zeros((DEGREE + 1) ** 2, 3, device=device)
        """The coefficients of the first colours."""
        self.unseen = torch.zeros((DEGREE + 1) ** 2, (DEGREE + 1) ** 2, device=device)
        """What a squared difference of colours is in coefficients, where no training view looks."""
        self._bases: dict[tuple[Any, ...], Tensor] = {}

    @torch.no_grad()
    def start_from(
        self,
        views: Sequence[View],
        images: Callable[[int], Tensor],
        recorded: Callable[[int], Tensor | None] = lambda index: None,
    ) -> None:
        """Begin with what the images show in each direction, as if all of it were at infinity.

        Least squares over the nodes of at most `STARTING_IMAGES` views, spread evenly. A ridge that grows with the
        degree keeps directions that no camera sees near the mean colour, and `optimize` pulls them back to it.

        Args:
            images: the image [H, W, 3] in 0..1 of each, by its index in `views`.
            recorded: which of its pixels [H, W] were recorded; None for all: lenses leave black where nothing was.
        """
        if not views:
            return
        chosen = sorted({round(index) for index in torch.linspace(0, len(views) - 1, STARTING_IMAGES).tolist()})
        seen = [self._seen(views[index], images(index), recorded(index)) for index in chosen]
        values = torch.cat([harmonics for harmonics, _ in seen]).double()
        colors = torch.cat([color for _, color in seen]).double() - 0.5
        degrees = torch.tensor([degree for degree in range(DEGREE + 1) for _ in range(2 * degree + 1)])
        ridge = (RIDGE * len(colors) * degrees.square()).to(values)
        solved = torch.linalg.solve(values.T @ values + torch.diag(ridge), values.T @ colors)
        self.constant.copy_(solved[:1])
        self.harmonics.copy_(solved[1:])
        self.first.copy_(solved)
        around = _fibonacci_sphere(DIRECTIONS).to(values.device)
        seen_from = torch.stack([views[index].sees(FAR_AWAY * around) for index in chosen])
        unseen = basis(around[~seen_from.any(0)], DEGREE)
        self.unseen.copy_(unseen.T @ unseen / DIRECTIONS)

    def behind(self, render: Render, view: View, change: Tensor | None = None) -> Render:
        """The render with the background, after a `change` of colour, where the Gaussians leave some of a ray."""
        basis = self._basis(view)
        constant: Tensor = self.constant
        harmonics: Tensor = self.harmonics
        if change is not None:
            constant = (changed(SH_C0 * constant + 0.5, change) - 0.5) / SH_C0
            harmonics = changed(harmonics, torch.cat([change[:, :3], torch.zeros_like(change[:, 3:])], 1))
        if can_composite(render.color, render.alpha, basis):
            parts = render.color, render.alpha, basis, constant, harmonics
            return render._replace(color=composite_background(*parts, _nodes(view)))
        image = self._interpolated(view, basis, torch.cat([constant, harmonics]))
        return render._replace(color=render.color + (1 - render.alpha)[..., None] * image)

    def _interpolated(self, view: View, basis: Tensor, coefficients: Tensor) -> Tensor:
        """The background [H, W, 3] in torch: any dtype and device, and the oracle of the kernel."""
        rows, columns, stride = _nodes(view)
        # Not a matrix product: BLAS sums in an order that depends on the number of threads.
        summands = basis[..., None] * coefficients
        coarse = (summands.sum(1) + 0.5).clamp(0, 1)
        nodes = coarse.view(rows, columns, 3).permute(2, 0, 1)
        fine = _refined(_refined(nodes, stride).transpose(1, 2), stride).transpose(1, 2)
        return fine[:, : view.height, : view.width].permute(1, 2, 0)

    def optimize(self, share: float = 1.0) -> None:
        """One optimizer step, gradients cleared; the next one has this share of the learning rates."""
        if self.constant.grad is not None and self.harmonics.grad is not None:
            off = torch.cat([self.constant, self.harmonics]).detach() - self.first
            pull = UNSEEN * (self.unseen[..., None] * off).sum(1)  # not a matrix product, as above
            self.constant.grad += pull[:1]
            self.harmonics.grad += pull[1:]
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
        for group, rate in zip(self.optimizer.param_groups, (RATE, RATE / 5)):
            group["lr"] = share * rate

    def _seen(self, view: View, image: Tensor, recorded: Tensor | None) -> tuple[Tensor, Tensor]:
        """Harmonics [nodes, (DEGREE + 1)^2] and colours [nodes, 3] at those nodes of a view inside of its image."""
        rows, columns, stride = _nodes(view)
        row = stride * torch.arange(rows, device=image.device)
        column = stride * torch.arange(columns, device=image.device)
        row, column = row[row < view.height], column[column < view.width]
        harmonics = self._basis(view).view(rows, columns, -1)[: len(row), : len(column)]
        harmonics, colors = harmonics.flatten(0, 1), image[row][:, column].flatten(0, 1).to(self.constant)
        if recorded is None:
            return harmonics, colors
        kept = recorded[row][:, column].flatten()
        return harmonics[kept], colors[kept]

    def _basis(self, view: View) -> Tensor:
        """Harmonics of the nodes' directions [nodes, (DEGREE + 1)^2]; kept, since cameras mostly stand still."""
        camera = torch.cat([view.T_camera_world[:3, :3].flatten(), view.K.to(view.T_camera_world).flatten()])
        key = (view.width, view.height, *camera.tolist())
        if key not in self._bases:
            values = basis(_directions(view), DEGREE).to(self.constant)
            if len(self._bases) >= KEPT_CAMERAS:
                self._bases.clear()
            self._bases[key] = values
        return self._bases[key]

    def state_dict(self) -> dict[str, Any]:
        """Colours, those of the beginning, and optimizer."""
        return {
            "constant": self.constant.detach().clone(),
            "harmonics": self.harmonics.detach().clone(),
            "first": self.first.clone(),
            "unseen": self.unseen.clone(),
            "optimizer": deepcopy(self.optimizer.state_dict()),
        }

    @torch.no_grad()
    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from `state_dict()`."""
        self.constant.copy_(state["constant"])
        self.harmonics.copy_(state["harmonics"])
        for name in {"first", "unseen"} & {*state}:  # versions before saved none
            getattr(self, name).copy_(state[name])
        self.optimizer.load_state_dict(deepcopy(state["optimizer"]))


def _nodes(view: View) -> tuple[int, int, int]:
    """Rows and columns of nodes and the pixels between them; the last ones lie beyond the image."""
    stride = max(1, view.width // NODES)
    return (view.height - 1) // stride + 2, (view.width - 1) // stride + 2, stride


def _refined(nodes: Tensor, stride: int) -> Tensor:
    """Linear interpolation along the middle axis: [C, N, M] -> [C, (N - 1) stride, M].

    `F.interpolate` rounds otherwise with one thread than with two, and a run must not.
    """
    share = (torch.arange(stride, dtype=nodes.dtype, device=nodes.device) / stride)[:, None]
    return ((1 - share) * nodes[:, :-1, None] + share * nodes[:, 1:, None]).flatten(1, 2)


def _directions(view: View) -> Tensor:
    """Unit directions in the world [nodes, 3] of the nodes' pixel centres, row by row."""
    like = view.T_camera_world
    *counts, stride = _nodes(view)
    axes = [stride * torch.arange(count, dtype=like.dtype, device=like.device) + 0.5 for count in counts]
    rows, columns = torch.meshgrid(*axes, indexing="ij")
    pixels = torch.stack([columns, rows, torch.ones_like(rows)], -1).reshape(-1, 3)
    rays = torch.linalg.solve(view.K.to(like), pixels.T).T @ view.T_camera_world[:3, :3]
    return rays / rays.norm(dim=-1, keepdim=True)


def _fibonacci_sphere(count: int) -> Tensor:
    """Unit directions [count, 3], float64, evenly spread over all."""
    index = torch.arange(count, dtype=torch.float64) + 0.5
    z, turn = 1 - 2 * index / count, math.pi * (1 + math.sqrt(5)) * index
    return torch.stack([(1 - z * z).sqrt() * turn.cos(), (1 - z * z).sqrt() * turn.sin(), z], -1)
