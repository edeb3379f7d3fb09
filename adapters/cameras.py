"""Camera objects of the Inria family as views: one way that serves all their variants.

What such a trainer draws is decided by `world_view_transform` and `projection_matrix`, both stored transposed.
Intrinsics are read from the projection, not from the fields of view: those are -1 where fudan's reader found focal
lengths, and say nothing of a principal point off the centre (SpacetimeGaussians, fudan).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

from d2_plugin.protocol import View

from .keys import PriorKey


def inria_view(camera: Any, key: PriorKey, time: float, like: Tensor) -> View:
    """The view of a camera object, on the device of `like`; `time` is in the trainer's unit."""
    width, height = int(camera.image_width), int(camera.image_height)
    pose = camera.world_view_transform.detach().T
    return View(
        camera=key.camera,
        frame=key.frame,
        time=time,
        T_camera_world=pose.to(like, non_blocking=True).contiguous(),
        K=intrinsics(camera, width, height).to(like, non_blocking=True),
        width=width,
        height=height,
    )


def intrinsics(camera: Any, width: int, height: int) -> Tensor:
    """K [3, 3] float64 in pixels, with pixel centres at i + 0.5, as the trainer's rasterizer has it.

    From the projection P (clip = P camera, w = z): f_x = P_00 W / 2 and c_x = (P_02 + 1) W / 2, rows alike. It is made
    where P is, so that nothing waits for a GPU.
    """
    P = camera.projection_matrix.detach().T.double()
    K = torch.eye(3, dtype=torch.float64, device=P.device)
    for row, half in enumerate((width / 2, height / 2)):
        K[row, row] = P[row, row] * half
        K[row, 2] = (P[row, 2] + 1) * half
    return K


def correct_fields_of_view(cameras: Iterable[Any]) -> int:
    """Set fields of view of -1 from the camera's focal lengths; returns how many cameras were mended.

    fudan's reader leaves -1 where transforms.json has fl_x (dataset_readers.py:276), and its rasterizer then takes
    tan(-0.5) for the Jacobian of every Gaussian: footprints come out 1.69 and 1.27 times too large and sheared (issue
    64 of fudan-zvg/4d-gaussian-splatting).
    """
    count = 0
    for camera in cameras:
        if camera.FoVx < 0 and camera.fl_x > 0:
            camera.FoVx = 2 * math.atan(camera.image_width / (2 * camera.fl_x))
            camera.FoVy = 2 * math.atan(camera.image_height / (2 * camera.fl_y))
            count += 1
    return count
