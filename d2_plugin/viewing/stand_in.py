"""A recording where none is at hand: from a prior store, which keeps the images, or from the views of a trainer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.protocol import View
from d2_plugin.recordings import Camera, Recording
from d2_plugin.store.store import PriorStore
from d2_plugin.viewing.subject import Subject

UNSEEN = 60
"""Grey of an image that nobody kept."""


@dataclass(frozen=True)
class KeptImages:
    """Images as the depth prior kept them; grey where there is none."""

    cameras: dict[str, Camera]
    store: Any = None
    """Anything with `prior(camera, frame) -> DepthPrior | None`."""

    def image(self, camera: str, frame: int) -> np.ndarray:
        """RGB uint8 [H, W, 3]."""
        size = self.cameras[camera].height, self.cameras[camera].width, 3
        try:
            prior = None if self.store is None else self.store.prior(camera, frame)
        except D2Error:  # a camera that has no prior
            prior = None
        colors = None if prior is None or prior.colors is None else prior.colors.cpu().numpy()
        return colors if colors is not None and colors.shape == size else np.full(size, UNSEEN, np.uint8)

    def depth(self, camera: str, frame: int) -> None:
        """No truth."""

    def mono(self, camera: str, frame: int) -> None:
        """No monocular maps."""


def subject_of_store(store: PriorStore, fps: float = 30.0) -> Subject:
    """The cameras that a prior was built for, with the images that it kept.

    Raises:
        D2Error: the store is empty, or does not say where its cameras stood.
    """
    found = {name: camera for name in store.cameras if (camera := _stored_camera(store, name)) is not None}
    if not found:
        raise D2Error(f"{store.path} has no prior that says where its camera stood: give --recording, or build it anew")
    recording = Recording(store.path.name, found, store.frames, fps, KeptImages(found, store))
    return Subject(store.path.name, recording, tuple(found), store=store)


def _stored_camera(store: PriorStore, name: str) -> Camera | None:
    for frame in store.frames:
        record, prior = store.camera(name, frame), store.prior(name, frame)
        if record is not None and prior is not None:
            height, width = prior.depth.shape
            return Camera(name, width, height, record.K.numpy(), record.T_camera_world.numpy())
    return None


def subject_of_views(views: Sequence[View], backbone: Any, store: Any, name: str) -> Subject:
    """The cameras that a trainer has used so far; its times are taken to grow evenly from frame to frame."""
    cameras = {view.camera: _camera_of(view) for view in views}
    times = {view.frame: view.time for view in views}
    frames = tuple(sorted(times))
    first, last = times[frames[0]], times[frames[-1]]
    span = last - first
    fps = (frames[-1] - frames[0]) / span if len(frames) > 1 and span > 0 else 1.0
    recording = Recording(name, cameras, frames, fps, KeptImages(cameras, store))
    device = str(views[0].T_camera_world.device)
    kept = store if isinstance(store, PriorStore) else None
    return Subject(name, recording, tuple(cameras), (), backbone, kept, device=device, time_offset=first)


def _camera_of(view: View) -> Camera:
    K, T = (tensor.detach().double().cpu().numpy() for tensor in (view.K, view.T_camera_world))
    return Camera(view.camera, view.width, view.height, K, T)
