"""The folder in which a mimic trains: a prior as `d2 priors` leaves it, and a d2.toml."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny import ALL_HOOKS, HEIGHT, WIDTH, TinyStore, make_views

from d2_plugin.config import DensifyConfig, DepthLossConfig, PruneConfig
from d2_plugin.protocol import Points
from d2_plugin.store.maps import FusedPrior
from d2_plugin.store.store import PriorStore

HOOKS = replace(
    ALL_HOOKS,
    densify=DensifyConfig(start=5, stop=95, every=10, budget_per_view=15),
    prune=PruneConfig(start=5, stop=90, every=10, patience=2, tau_p=0.6),
    depth_loss=DepthLossConfig(every=1),
)


def furnish(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Write the exact prior of the tiny scene and all hooks, and make `folder` the working directory."""
    store = PriorStore.create(folder / "prior", ["cam0", "cam1", "cam2"], [0, 1], {"recording": "tiny"})
    for view in make_views():
        prior = TinyStore().prior(view.camera, view.frame)
        camera = {"K": view.K.tolist(), "T_camera_world": view.T_camera_world.tolist()}
        image = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
        sigma = np.where(prior.trusted.numpy(), np.float32(0), np.float32(np.inf))
        fused = FusedPrior(prior.depth.numpy(), prior.labels.numpy(), sigma, image)
        store.write(view.camera, view.frame, fused, {"camera": camera})
    (folder / "d2.toml").write_text(replace(HOOKS, prior="prior").to_toml())
    monkeypatch.chdir(folder)
    return folder


def some_points(count: int) -> Points:
    generator = torch.Generator().manual_seed(1)
    positions = torch.rand(count, 3, generator=generator) + torch.tensor([-0.5, -0.5, 2.5])
    ones = torch.ones(count)
    return Points(positions, torch.rand(count, 3, generator=generator), ones / 2, ones / 10, ones / 2)
