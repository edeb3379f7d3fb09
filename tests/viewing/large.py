"""A scene as large as people train them, made without training: surfaces of Gaussians that move, 60 frames at 30 per
second, four cameras of 640x360."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from d2_plugin.backbones import deform, yang4d
from d2_plugin.backbones.deform import DeformSettings
from d2_plugin.backbones.deform_fields import Box, HexPlaneSettings
from d2_plugin.backbones.model import SplatModel
from d2_plugin.backbones.yang4d import Yang4DSettings
from d2_plugin.protocol import View
from d2_plugin.recordings import Camera
from d2_plugin.viewing.export.scene import Clip, ExportScene, background_of, slicer

WIDTH, HEIGHT, FOCAL = 640, 360, 560.0
FRAMES, FPS = 60, 30.0
DURATION = (FRAMES - 1) / FPS
DISTANCE = 4.0
AREA = 36.0
"""Of all surfaces together, in world units: what a Gaussian covers follows from their number."""


def large_model(count: int, backbone: str = "yang4d", sh_degree: int = 0, sh_time_degree: int = 0) -> SplatModel:
    """`count` Gaussians on spheres in a room, each about as wide as its neighbours are away; "yang4d" or "hexplane"."""
    generator = torch.Generator().manual_seed(2)
    positions, colors, times = _surfaces(count, generator)
    scales, opacities = torch.full((count,), math.sqrt(AREA / count)), torch.full((count,), 0.9)
    if backbone == "hexplane":
        field = HexPlaneSettings(features=8, resolutions=(32, 64))
        settings = DeformSettings(field="hexplane", warm_up=0.0, hexplane=field, sh_degree=sh_degree)
        rows = deform.initial_rows(positions, colors, scales, opacities, settings)
        box = Box.around(positions, 4.0)
        model: SplatModel = deform.Deform(rows, settings, 4.0, DURATION, box)
        _bend(model, generator)
    else:
        chosen = Yang4DSettings(sh_degree=sh_degree, sh_time_degree=sh_time_degree)
        rows = yang4d.initial_rows(positions, colors, times, scales, opacities, chosen, DURATION)
        model = yang4d.Yang4D(rows, chosen, 4.0, DURATION)
    _vary(model, generator)
    return model


def _surfaces(count: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
    """Points [N, 3] on a back wall, a floor and spheres before them, patterned colours [N, 3], times [N]."""
    u, v = torch.rand(2, count, generator=generator)
    kind = torch.arange(count) % 6
    directions = torch.randn(count, 3, generator=generator)
    spheres = 0.45 * directions / directions.norm(dim=1, keepdim=True)
    spheres[:, 0] += (kind - 1.5) * 1.1
    wall = torch.stack([6 * u - 3, 3 * v - 1.7, torch.full_like(u, 1.5)], -1)
    floor = torch.stack([6 * u - 3, torch.full_like(u, 1.3), 4 * v - 2], -1)
    positions = torch.where((kind == 4)[:, None], wall, torch.where((kind == 5)[:, None], floor, spheres))
    waves = torch.stack([7 * positions[:, 0], 9 * positions[:, 1], 8 * positions[:, 2] + 2 * positions[:, 0]], -1)
    return positions, 0.5 + 0.4 * torch.sin(waves), DURATION * torch.rand(count, generator=generator)


@torch.no_grad()
def _vary(model: SplatModel, generator: torch.Generator) -> None:
    """All shapes, opacities and, of 4D Gaussians, lifetimes and velocities; harmonics that fall with their degree."""
    rows, count = model.gaussians.parameters, len(model)

    def noise(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    rows["log_scales"] += 0.4 * noise(count, 3) - 0.5
    rows["opacity_logits"] += 1.5 * noise(count)
    turns = rows["left" if "left" in rows else "rotations"]
    turns += 0.5 * noise(count, 4)
    if "right" in rows:
        rows["right"].copy_(turns + 0.02 * noise(count, 4))
        rows["log_time_scales"].copy_(math.log(0.3 * DURATION) + 0.7 * noise(count))
    if "harmonics" in rows:
        rows["harmonics"] += 0.05 * noise(*rows["harmonics"].shape)
    if model.background is not None:
        model.background.constant.normal_(0, 0.2, generator=generator)


@torch.no_grad()
def _bend(model: SplatModel, generator: torch.Generator) -> None:
    model.deforms = True
    for plane in model.field.time:
        plane += 0.15 * torch.randn(plane.shape, generator=generator)
    model.field.heads.weight.normal_(0, 0.03, generator=generator)


def large_cameras() -> dict[str, Camera]:
    """Four cameras on an arc that look at the middle of the room."""
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    found = {}
    for number, angle in enumerate(np.radians([-15, -5, 5, 15])):
        T = np.eye(4)
        T[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
        T[2, 3] = DISTANCE
        found[f"cam{number}"] = Camera(f"cam{number}", WIDTH, HEIGHT, K, T)
    return found


def large_view(time: float, width: int = WIDTH, height: int = HEIGHT) -> View:
    """What the last camera, which is held out, sees at `time`."""
    camera = large_cameras()["cam3"]
    K = torch.tensor(camera.K, dtype=torch.float32)
    K[0] *= width / WIDTH
    K[1] *= height / HEIGHT
    return View(camera.name, 0, time, torch.tensor(camera.T_camera_world, dtype=torch.float32), K, width, height)


def large_scene(model: SplatModel) -> ExportScene:
    """The model with its cameras and its clip."""
    cameras = tuple(large_cameras().values())
    clip = Clip(tuple(range(FRAMES)), tuple(frame / FPS for frame in range(FRAMES)), FPS)
    harmonics = model.harmonics()
    return ExportScene(
        *("large", clip, cameras[:3], cameras[3:], model.settings.raster),
        harmonics._replace(coefficients=harmonics.coefficients.detach().double()),
        slicer(model, large_view(0.0)),
        model.moving(),
        background_of(model),
    )
