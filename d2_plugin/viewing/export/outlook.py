"""Where a viewer may start: what the training cameras look at, which way is up, how near and far things are."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from d2_plugin.protocol import Splats, View
from d2_plugin.rasterizer import rasterize
from d2_plugin.recordings import Camera
from d2_plugin.viewing.export.scene import ExportScene

SIDE = 160
"""Pixels of the longer side of the images by which this is measured."""
CAMERAS = 4
"""Cameras that are asked at most."""
SOLID = 0.5
"""Least alpha of a pixel whose depth counts."""


class Outlook(NamedTuple):
    """In world units."""

    focus: list[float]
    up: list[float]
    depth_range: tuple[float, float]
    """From the hundredth-nearest to the hundredth-farthest pixel of the training cameras over the clip."""


def look_around(scene: ExportScene) -> Outlook:
    """By small images of the depth at the first, the middle and the last frame."""
    cameras = scene.train_cameras[:: -(-len(scene.train_cameras) // CAMERAS)]
    seconds = scene.clip.seconds
    times = sorted({seconds[0], seconds[len(seconds) // 2], seconds[-1]})
    drawn = [(time, scene.splats_at(time)) for time in times]  # once for all cameras: a large field takes long
    depths, looked_at = [np.zeros(0)], []
    for camera in cameras:
        seen = [_depths(scene, camera, time, splats) for time, splats in drawn]
        depths += [depth for depth, _ in seen]
        looked_at.append(camera.centre + camera.T_camera_world[2, :3] * float(np.median([ahead for _, ahead in seen])))
    every = np.concatenate(depths)
    near, far = (float(np.quantile(every, q)) for q in (0.01, 0.99)) if len(every) else (1.0, 2.0)
    up = -np.mean([camera.T_camera_world[1, :3] for camera in cameras], axis=0)
    up = up / np.linalg.norm(up) if np.linalg.norm(up) > 1e-6 else -cameras[0].T_camera_world[1, :3]
    return Outlook(np.mean(looked_at, axis=0).tolist(), up.tolist(), (near, max(far, near * (1 + 1e-6))))


@torch.no_grad()
def _depths(scene: ExportScene, camera: Camera, time: float, splats: Splats) -> tuple[np.ndarray, float]:
    """Depths of the solid pixels, and the median in the middle of the image (of all, or 1, where nothing is)."""
    scale = min(SIDE / max(camera.width, camera.height), 1.0)
    width, height = max(int(camera.width * scale), 1), max(int(camera.height * scale), 1)
    intrinsics = torch.tensor(camera.K, dtype=torch.float32)
    intrinsics[0] *= width / camera.width
    intrinsics[1] *= height / camera.height
    pose = torch.tensor(camera.T_camera_world, dtype=torch.float32)
    view = View(camera.name, 0, time, pose, intrinsics, width, height)
    render = rasterize(splats, torch.zeros(len(splats.means), 1), view, scene.raster)
    solid = render.alpha > SOLID
    depth = torch.where(solid, render.depth_sum / render.alpha.clamp(min=SOLID), torch.nan).numpy()
    middle = depth[height // 3 : -(height // 3) or None, width // 3 : -(width // 3) or None]
    for part in (middle, depth):
        if np.isfinite(part).any():
            return depth[np.isfinite(depth)], float(np.nanmedian(part))
    return np.zeros(0), 1.0
