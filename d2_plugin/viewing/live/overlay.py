"""What lies over the image of a page: the recording's cameras with their images, and the prior as points."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from d2_plugin.priors.sheet import label_colors, sigma_colors
from d2_plugin.protocol import DepthPrior, Label
from d2_plugin.recordings import Camera
from d2_plugin.recordings.cameras.rotations import quaternion_of_rotation
from d2_plugin.viewing.camera_paths import Rig
from d2_plugin.viewing.live.page import Page, vertical_angle
from d2_plugin.viewing.panels import fitted
from d2_plugin.viewing.viewed import ViewedRun

THUMBNAIL = 128
"""Width of an image in a frustum, pixels."""
TRAINING, HELD_OUT = (70, 160, 255), (255, 150, 40)
"""RGB of cameras that train and of those that are held out."""
FRUSTUM, NEAR = 0.03, 12.0
"""Size of a frustum relative to the distance of what the cameras look at; how near, in its sizes, it is hidden."""
MOST_POINTS = 60_000
"""Of all cameras together: a browser draws them at every frame."""


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

    def refresh(self, viewed: ViewedRun, time: float, moving: bool) -> None:
        """Bring everything up to date; images and points wait while something moves."""
        frame = viewed.frame_at(time)
        self.page.set_text("frame", str(frame))
        self._show_frusta(viewed, frame, moving)
        if viewed.store is not None:
            self._show_cloud(viewed, frame, moving)

    def _show_frusta(self, viewed: ViewedRun, frame: int, moving: bool) -> None:
        last = self.page.last
        # Those around would stand before the image of the camera where we stand.
        visible = self.page.ticked("frusta", True) and (last is None or last.standing is None)
        if visible and set(self.frusta) != set(viewed.recording.cameras):
            for number, (name, camera) in enumerate(viewed.recording.cameras.items()):
                if name not in self.frusta:
                    self.frusta[name] = self._frustum(number, camera, name in viewed.train_cameras)
            self._images_of = None
        for name, handle in self.frusta.items():
            # One beside us would fill the screen with its small image.
            apart = np.linalg.norm(viewed.recording.cameras[name].centre - (last.pose[:3] if last else 0))
            shown = visible and bool(apart > NEAR * self.unit)
            if handle.visible != shown:
                handle.visible = shown
        if visible and not moving and frame != self._images_of:
            self._images_of = frame
            for name, handle in self.frusta.items():
                image = viewed.recording.image(name, frame)
                width = min(image.shape[1], THUMBNAIL)
                handle.image = fitted(image, width, max(round(image.shape[0] * width / image.shape[1]), 1))

    def _frustum(self, number: int, camera: Camera, trains: bool) -> Any:
        # Numbered: a name with a slash would be a path in the scene.
        handle = self.page.client.scene.add_camera_frustum(
            f"/cameras/{number}",
            vertical_angle(camera),
            camera.width / camera.height,
            scale=self.unit,
            thickness=1.5,
            thickness_units="screen",
            color=TRAINING if trains else HELD_OUT,
            wxyz=quaternion_of_rotation(camera.T_camera_world[:3, :3].T),
            position=camera.centre,
        )
        handle.on_click(lambda _: self.page.stand_at(camera.name))
        return handle

    def _show_cloud(self, viewed: ViewedRun, frame: int, moving: bool) -> None:
        by = self.page.word("cloud", "none")
        if by == "none" and self.cloud is not None:
            self.cloud.remove()
            self.cloud = self._cloud_of = None
        if by == "none":
            return
        if (frame, by) != self._cloud_of and (not moving or self.cloud is None):
            self._cloud_of = frame, by
            positions, colors = cloud_of(viewed, frame, by)
            self.cloud = self.page.client.scene.add_point_cloud(
                "/prior", positions, colors, point_size=0.06 * self.unit, point_shape="circle", precision="float32"
            )


def frustum_size(viewed: ViewedRun) -> float:
    """A part of the way from the cameras to what they look at."""
    rig = Rig.of(list(viewed.recording.cameras.values()), viewed.depth)
    return max(FRUSTUM * float(np.linalg.norm(rig.middle - rig.focus)), 1e-6)


Cloud = tuple[np.ndarray, np.ndarray]
"""Positions in the world, [P, 3] float32, and colours, [P, 3] uint8."""


def cloud_of(viewed: ViewedRun, frame: int, by: str, most: int = MOST_POINTS) -> Cloud:
    """The prior of all cameras at one frame, thinned evenly; sky has no place and is left out."""
    store, cameras = viewed.store, viewed.recording.cameras
    known = () if store is None else ((name, store.prior(name, frame)) for name in store.cameras if name in cameras)
    priors = [(cameras[name], prior) for name, prior in known if prior is not None]
    stride = max(int(np.ceil(np.sqrt(sum(prior.depth.numel() for _, prior in priors) / most))), 1)
    parts = [_points(camera, prior, by, stride) for camera, prior in priors]
    if not parts:
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    positions, colors = (np.concatenate(values) for values in zip(*parts, strict=True))
    return positions, colors


def _points(camera: Camera, prior: DepthPrior, by: str, stride: int) -> Cloud:
    """One pixel of every `stride` by `stride`, where there is a depth."""
    rows, columns = (torch.arange(stride // 2, side, stride) for side in prior.depth.shape)
    thin = DepthPrior._make(None if map_ is None else map_[rows][:, columns] for map_ in prior)
    depth = thin.depth.numpy()
    shown = (depth > 0) & (thin.labels != Label.FAR).numpy()
    pixels = np.stack(np.meshgrid(columns.numpy() + 0.5, rows.numpy() + 0.5), -1)
    if by == "image":
        grey = torch.full((*depth.shape, 3), 160, dtype=torch.uint8)
        colors = (grey if thin.colors is None else thin.colors).numpy()
    elif by == "label":
        colors = label_colors(thin.labels.numpy())
    else:  # grey where no deviation is declared
        colors = sigma_colors(None if thin.sigma is None else thin.sigma.numpy(), depth)
    return camera.world(pixels[shown], depth[shown]).astype(np.float32), colors[shown]
