"""A depth prior as coloured points in the world."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
import torch

from d2_plugin.priors.sheet import label_colors, sigma_colors
from d2_plugin.protocol import DepthPrior, Label
from d2_plugin.recordings import Camera
from d2_plugin.viewing.subject import Subject

ColorBy = Literal["image", "label", "sigma"]
MOST_POINTS = 60_000
"""Of all cameras together: a browser draws them at every frame."""


class Cloud(NamedTuple):
    """Points with colours."""

    positions: np.ndarray  # [P, 3] float32, world
    colors: np.ndarray  # [P, 3] uint8


def cloud_of(subject: Subject, frame: int, by: ColorBy, most: int = MOST_POINTS) -> Cloud:
    """The prior of all cameras at one frame, thinned evenly; sky has no place and is left out."""
    store = subject.store
    found = [] if store is None else [(name, prior) for name in store.cameras if (prior := store.prior(name, frame))]
    kept = [(name, prior) for name, prior in found if name in subject.recording.cameras]
    pixels = sum(prior.depth.numel() for _, prior in kept)
    stride = max(int(np.ceil(np.sqrt(pixels / most))), 1)
    parts = [_points(subject.recording.cameras[name], prior, by, stride) for name, prior in kept]
    if not parts:
        return Cloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8))
    return Cloud(*(np.concatenate(values) for values in zip(*parts, strict=True)))


def _points(camera: Camera, prior: DepthPrior, by: ColorBy, stride: int) -> Cloud:
    """One pixel of every `stride` by `stride`, where there is a depth."""
    rows, columns = (torch.arange(stride // 2, side, stride) for side in prior.depth.shape)
    thin = DepthPrior._make(None if map_ is None else map_[rows][:, columns] for map_ in prior)
    depth = thin.depth.numpy()
    shown = (depth > 0) & (thin.labels != Label.FAR).numpy()
    y, x = np.meshgrid(rows.numpy() + 0.5, columns.numpy() + 0.5, indexing="ij")
    rays = np.stack([x, y, np.ones_like(x)], -1)[shown] @ np.linalg.inv(camera.K).T
    R, t = camera.T_camera_world[:3, :3], camera.T_camera_world[:3, 3]
    return Cloud(((rays * depth[shown][:, None] - t) @ R).astype(np.float32), _painted(thin, by)[shown])


def _painted(prior: DepthPrior, by: ColorBy) -> np.ndarray:
    """RGB uint8 [h, w, 3] of every pixel."""
    if by == "label":
        return label_colors(prior.labels.numpy())
    if by == "sigma":
        sigma = torch.full_like(prior.depth, torch.inf) if prior.sigma is None else prior.sigma
        return sigma_colors(sigma.numpy(), prior.depth.numpy())
    grey = torch.full((*prior.depth.shape, 3), 160, dtype=torch.uint8)
    return (grey if prior.colors is None else prior.colors).numpy()
