"""What lies over the image of a page: the recording's cameras with their images, and the prior as points."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from d2_plugin.recordings import Camera
from d2_plugin.recordings.cameras.rotations import quaternion_of_rotation
from d2_plugin.viewing.live.cloud import cloud_of
from d2_plugin.viewing.live.page import Page
from d2_plugin.viewing.panels import fitted
from d2_plugin.viewing.subject import Subject

THUMBNAIL = 128
"""Width of an image in a frustum, pixels."""
TRAINING, HELD_OUT = (70, 160, 255), (255, 150, 40)
"""RGB of cameras that train and of those that are held out."""


@dataclass
class Overlay:
    """The overlays of one page, changed only where something is different."""

    page: Page
    unit: float
    """Size of a frustum in world units."""
    frusta: dict[str, Any] = field(default_factory=dict)
    cloud: Any = None
    _images_of: int | None = None
    _cloud_of: tuple[int, str] | None = None

    def refresh(self, subject: Subject, time: float, moving: bool) -> None:
        """Bring everything up to date; images and points wait while something moves."""
        frame = subject.frame_at(time)
        self.page.say("frame", str(frame))
        self._show_frusta(subject, frame, moving)
        if subject.store is not None:
            self._show_cloud(subject, frame, moving)

    def _show_frusta(self, subject: Subject, frame: int, moving: bool) -> None:
        visible = bool(self.page.value("frusta", True))
        if visible and (set(self.frusta) != set(subject.recording.cameras)):
            self._add_frusta(subject)
        scale = self.unit * float(self.page.value("size_of_frusta", 1.0))
        eye = np.asarray(self.page.client.camera.position)
        for name, handle in self.frusta.items():
            # One that stands where we do would fill the screen with its small image.
            near = np.linalg.norm(subject.recording.cameras[name].centre - eye) < 1.5 * scale
            if handle.visible != (visible and not near):
                handle.visible = visible and not near
            if handle.scale != scale:
                handle.scale = scale
        if visible and not moving and frame != self._images_of:
            self._images_of = frame
            for name, handle in self.frusta.items():
                handle.image = _thumbnail(subject, name, frame)

    def _add_frusta(self, subject: Subject) -> None:
        for number, (name, camera) in enumerate(subject.recording.cameras.items()):
            if name not in self.frusta:
                self.frusta[name] = self._frustum(number, camera, name in subject.train_cameras)
        self._images_of = None

    def _frustum(self, number: int, camera: Camera, trains: bool) -> Any:
        # Numbered: a name with a slash would be a path in the scene.
        handle = self.page.client.scene.add_camera_frustum(
            f"/cameras/{number}",
            2 * math.atan(camera.height / 2 / camera.K[1, 1]),
            camera.width / camera.height,
            scale=self.unit,
            thickness=0.04 * self.unit,
            color=TRAINING if trains else HELD_OUT,
            wxyz=quaternion_of_rotation(camera.T_camera_world[:3, :3].T),
            position=camera.centre,
        )
        handle.on_click(lambda _: self.page.stand_at(camera.name))
        return handle

    def _show_cloud(self, subject: Subject, frame: int, moving: bool) -> None:
        by = self.page.value("cloud", "none")
        size = self.unit * 0.03 * float(self.page.value("point_size", 1.0))
        if by == "none":
            if self.cloud is not None:
                self.cloud.remove()
            self.cloud = self._cloud_of = None
            return
        if (frame, by) != self._cloud_of and (not moving or self.cloud is None):
            self._cloud_of = frame, by
            positions, colors = cloud_of(subject, frame, by)
            self.cloud = self.page.client.scene.add_point_cloud(
                "/prior", positions, colors, point_size=size, point_shape="circle", precision="float32"
            )
        if self.cloud is not None and self.cloud.point_size != size:
            self.cloud.point_size = size


def frustum_size(subject: Subject) -> float:
    """A tenth of the way from the cameras to what they look at, or less where cameras stand close together."""
    centres = np.stack([camera.centre for camera in subject.recording.cameras.values()])
    gaps = np.linalg.norm(centres[:, None] - centres[None], axis=-1)
    gaps[gaps == 0] = math.inf
    # The usual gap: a held-out camera that nearly touches another must not make all of them too small to see.
    usual = float(np.median(gaps.min(axis=1)))
    size = min((subject.depth or math.inf) / 10, 0.5 * usual)
    return size if math.isfinite(size) else 0.2


def rig_of(subject: Subject) -> tuple[np.ndarray, float]:
    """Where the cameras' middle is, [3], and how far one has to be from it to see all of them."""
    centres = np.stack([camera.centre for camera in subject.recording.cameras.values()])
    middle = centres.mean(axis=0)
    return middle, max(float(np.linalg.norm(centres - middle, axis=1).max()), 3 * frustum_size(subject))


def _thumbnail(subject: Subject, name: str, frame: int) -> np.ndarray:
    image = subject.recording.image(name, frame)
    height, width = image.shape[:2]
    if width <= THUMBNAIL:
        return image
    return fitted(image, THUMBNAIL, max(round(height * THUMBNAIL / width), 1))
