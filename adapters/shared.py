"""What adapters share: listeners, the renders of a step, and points and splats in the shapes that trainers have."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import replace
from functools import lru_cache
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor

from d2_plugin.gaussians.rotation4d import covariances_from_factors, rotation_matrices_3d
from d2_plugin.gaussians.spherical_harmonics import channel_count
from d2_plugin.gaussians.spherical_harmonics import colors as harmonic_colors
from d2_plugin.protocol import Points, ResizeListener, Splats, View

Render = TypeVar("Render")
Renders = dict[tuple[str, int], Render]
"""Renders of the views of one step, a batch of them as well, by camera and frame; each is handed out once (`pop`).

A render holds a graph, and is out of date once the parameters change: whoever keeps them clears all of them then.
"""

Answer = TypeVar("Answer")


class Resizing:
    """The listeners to structural changes."""

    def __init__(self) -> None:
        self._listeners: list[ResizeListener] = []

    def on_resize(self, listener: ResizeListener) -> None:
        """Register a listener for every structural change, the trainer's own densification included."""
        self._listeners.append(listener)

    def _report(self, index: Tensor) -> None:
        for listener in self._listeners:
            listener(index)


def once_per_camera(name: str, ask: Callable[[Any], Answer]) -> Callable[[Any], Answer]:
    """`ask` of a camera object, asked again if its tensor `name` changed: each question may wait for a GPU."""
    answers: WeakKeyDictionary[Any, tuple[Tensor, int, Answer]] = WeakKeyDictionary()

    def asked(camera: Any) -> Answer:
        tensor = getattr(camera, name)
        if not (isinstance(tensor, Tensor) and isinstance(camera, Hashable) and hasattr(camera, "__weakref__")):
            return ask(camera)
        known = answers.get(camera)
        if known is None or known[0] is not tensor or known[1] != tensor._version:
            known = answers[camera] = tensor, tensor._version, ask(camera)
        return known[2]

    return asked


def optional(owner: Any, name: str, default: Any = None) -> Any:
    """An attribute that some versions of a repository lack or leave at None; `default` there."""
    value = getattr(owner, name, None)
    return default if value is None else value


def steps_of_adam(optimizer: object, step: int) -> float:
    """As how many of Adam's steps the first `step` of an optimizer count: as many, but for RAdam.

    Its steps are a share of Adam's that grows from 0 over some 2 / (1 - beta2): with .999 .05 at 10, .52 at 600.
    Source: Liu et al., On the variance of the adaptive learning rate and beyond (ICLR 2020), as torch.optim has it.
    """
    if not isinstance(optimizer, torch.optim.RAdam):
        return step
    step = max(step, 0)
    return float(_sums_of_shares(optimizer.param_groups[0]["betas"][1], 1 << step.bit_length())[step])


@lru_cache
def _sums_of_shares(beta: float, steps: int) -> np.ndarray:
    """Entry t is the sum of the first t shares, float64 [steps].

    With a beta up to .6 RAdam never adapts its steps to the gradients: they are as large at first as later.
    """
    t = np.arange(1, steps)
    longest, power = 2 / (1 - beta) - 1, beta**t
    if longest <= 5:
        return np.arange(steps, dtype=np.float64)
    length = np.fmax(longest - 2 * t * power / (1 - power), 5)  # of the moving average; at 5 and below nothing adapts
    share = np.sqrt((length - 4) * (length - 2) * longest / ((longest - 4) * (longest - 2) * length))
    return np.concatenate([[0.0], np.cumsum(share * (length > 5))])


def on_device(view: View, like: Tensor) -> View:
    """The view with its matrices where the Gaussians are."""
    pose, K = (matrix.to(like, non_blocking=True) for matrix in (view.T_camera_world, view.K))
    return view if pose is view.T_camera_world and K is view.K else replace(view, T_camera_world=pose, K=K)


def finite(points: Points) -> Points:
    """The points that can be inserted."""
    return points.select(torch.isfinite(points.positions).all(-1) & torch.isfinite(points.scales) & (points.scales > 0))


def splats_of(
    means: Tensor, scales: Tensor, rotations: Tensor, opacities: Tensor, rows: Tensor | None = None
) -> Splats:
    """Splats from activated values: scales [M, 3], quaternions [M, 4], whose length scales the covariance if it is not
    1, and opacities [M]; all rows where none are given."""
    factors = rotation_matrices_3d(rotations.T) * scales.T
    rows = torch.arange(len(means), device=means.device) if rows is None else rows
    return Splats(means, covariances_from_factors(factors), opacities, rows)


def seen_colors(
    harmonics: Tensor, view: View, splats: Splats, degree: int, phase: Tensor | None = None, time_degree: int = 0
) -> Tensor:
    """RGB [M, 3] of splats as seen in `view`, from the spherical harmonics [N, C, 3] of all rows."""
    centre = -view.T_camera_world[:3, :3].T @ view.T_camera_world[:3, 3]
    chosen = harmonics[splats.rows, : channel_count(degree, time_degree)]
    return harmonic_colors(chosen, splats.means - centre, phase, degree, time_degree)


def appended(before: int, after: int, device: torch.device) -> Tensor:
    """The index of a change that appends rows at the end."""
    index = torch.arange(after, device=device)
    index[before:] = -1
    return index


def with_rows(optimizer: torch.optim.Optimizer, old: Tensor, rows: Tensor) -> torch.nn.Parameter:
    """A parameter with new rows at the end in the place of `old` in its optimizer, with moments of zero there."""
    grown = torch.cat([old.detach(), rows.to(old)])
    return replaced(optimizer, old, grown, lambda moment: torch.cat([moment, torch.zeros_like(rows).to(moment)]))


def replaced(
    optimizer: torch.optim.Optimizer, old: Tensor, values: Tensor, change: Callable[[Tensor], Tensor]
) -> torch.nn.Parameter:
    """A parameter with these values in the place of `old` in its optimizer, whose moments of rows are changed."""
    new = torch.nn.Parameter(values, requires_grad=old.requires_grad)
    moments = optimizer.state.pop(old, {})
    for name, value in moments.items():
        if isinstance(value, Tensor) and value.shape[:1] == old.shape[:1] and name != "step":
            moments[name] = change(value)
    if moments:
        optimizer.state[new] = moments
    for group in optimizer.param_groups:
        group["params"] = [new if parameter is old else parameter for parameter in group["params"]]
    return new
