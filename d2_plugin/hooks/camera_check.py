"""Whether a prior was built for the camera that asks for it.

Depth along a pixel is only meaningful for the K and the pose it was computed with. Trainers may place the world anew,
which changes no depth as long as it is a rotation and a shift, the same for all cameras; a change of scale does.
"""

from __future__ import annotations

import logging
import math

import torch
from torch import Tensor

from d2_plugin.errors import D2Error
from d2_plugin.protocol import CameraRecord, View

log = logging.getLogger(__name__)

FOCAL_TOLERANCE = 0.01
"""Largest relative difference of focal lengths."""

CENTRE_TOLERANCE = 0.01
"""Largest difference of principal points, relative to the image's width and height."""

ANGLE_TOLERANCE = 0.2
"""Largest difference of directions, in degrees."""

POSITION_TOLERANCE = 0.005
"""Largest difference of camera centres, relative to the median depth of the prior."""


class CameraCheck:
    """Compares views with the cameras their priors were built for; the first view fixes how the world was moved."""

    def __init__(self) -> None:
        self._first: tuple[View, Tensor, Tensor] | None = None

    def check(self, view: View, record: CameraRecord, depth: Tensor) -> None:
        """Refuse a view whose K or pose is not that of its prior; `depth` is D*, which says how large the scene is.

        Raises:
            D2Error: with the values of both.
        """
        self._check_intrinsics(view, record.K)
        pose, built = view.T_camera_world.detach().double().cpu(), record.T_camera_world
        if self._first is None:
            self._first = (view, pose, built)
            if not torch.allclose(pose, built, atol=1e-3):
                log.info("the trainer's world is not that of the prior: taken as moved by what %s shows", view.camera)
            return
        first, first_pose, first_built = self._first
        known = depth[depth > 0]
        if known.numel():
            slack = POSITION_TOLERANCE * float(known.median())
            self._check_pose(view, first, _relative(pose, first_pose), _relative(built, first_built), slack)

    def _check_intrinsics(self, view: View, built: Tensor) -> None:
        K, size = view.K.detach().double().cpu(), torch.tensor([view.width, view.height], dtype=torch.float64)
        focal = K.diagonal()[:2], built.diagonal()[:2]
        centre = K[:2, 2], built[:2, 2]
        if ((focal[0] / focal[1] - 1).abs() > FOCAL_TOLERANCE).any():
            raise D2Error(
                f"the prior of camera {view.camera}, frame {view.frame} was built for focal lengths {_text(focal[1])} "
                f"but the view has {_text(focal[0])}: build the prior with the cameras that are trained with"
            )
        if ((centre[0] - centre[1]).abs() > CENTRE_TOLERANCE * size).any():
            raise D2Error(
                f"the prior of camera {view.camera}, frame {view.frame} was built for the principal point "
                f"{_text(centre[1])} but the view has {_text(centre[0])}: build the prior with the trainer's cameras"
            )

    def _check_pose(self, view: View, first: View, here: Tensor, built: Tensor, slack: float) -> None:
        """Compare poses [4, 4] relative to the first view's; `slack` is a distance."""
        angle = _angle(here[:3, :3] @ built[:3, :3].T)
        centres = _centre(here), _centre(built)
        if angle > ANGLE_TOLERANCE or float((centres[0] - centres[1]).norm()) > slack:
            raise D2Error(
                f"the prior of camera {view.camera}, frame {view.frame} was built for a camera at {_text(centres[1])} "
                f"as seen from {first.camera} but the view is at {_text(centres[0])}, turned by {angle:.2f} degrees: "
                "the key names another camera, or the trainer's world is scaled; build the prior with its cameras"
            )


def _relative(pose: Tensor, first: Tensor) -> Tensor:
    """From the first camera's axes to this camera's; no rigid motion of the world changes it."""
    return pose @ torch.linalg.inv(first)


def _angle(rotation: Tensor) -> float:
    """Degrees; by its skew part, since the cosine alone turns an orthonormality of 1e-4 into half a degree."""
    sine = float((rotation - rotation.T).norm()) / (2 * math.sqrt(2))
    return math.degrees(math.atan2(sine, float((rotation.diagonal().sum() - 1) / 2)))


def _centre(pose: Tensor) -> Tensor:
    return -pose[:3, :3].T @ pose[:3, 3]


def _text(values: Tensor) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in values.tolist()) + ")"
