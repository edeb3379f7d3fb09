"""Rigs with true depth on which geometric depth is measured: rendered ones, and recordings from disk.

The rendered rooms are textured on most surfaces, with sensor noise of 1 % and exposures that differ by up to 5 %. Depth
ranges come from the truth, a quarter wider on both sides.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from d2_plugin.errors import refuse_unknown
from d2_plugin.priors.geometry import Projection, pixel_grid, view_pair
from d2_plugin.recordings import open_recording
from d2_plugin.recordings.recording import Camera, Recording
from d2_plugin.recordings.synthetic import materials
from d2_plugin.recordings.synthetic.raycast import render_color, render_depth
from d2_plugin.recordings.synthetic.room import arc_cameras, furnished_room

STUDIO_CAMERAS = ("00", "02", "05", "07")
STUDIO_FRAMES = (0, 5, 10, 15, 19)
MIDDLEBURY = ("art", "laundry", "motorcycle", "teddy")
ARCS = {2: 10.0, 3: 50.0, 4: 30.0}
"""Degrees over which the cameras of a rendered rig are spread, per number of cameras: narrow, wide, and as in N3DV."""
RENDERED = {f"synthetic{views}": views for views in ARCS}
"""Numbers of cameras of the rendered rigs, by name."""
FROM_DISK = ("studio", *MIDDLEBURY)

NOISE = 0.01
"""Standard deviation of the sensor noise of rendered rigs, of values in 0..1."""
OCCLUSION = 0.02
"""Two views see the same surface where its depth agrees to this share."""


@dataclass(frozen=True, eq=False)
class Rig:
    """Synchronized images with the true depth of at least one of them."""

    name: str
    images: list[np.ndarray]  # uint8 [H, W, 3]
    cameras: list[Camera]
    truths: list[np.ndarray | None]  # planar depth float32 [H, W], 0 where unknown

    @cached_property
    def depth_range(self) -> tuple[float, float]:
        """Nearest and farthest true depth, a quarter wider on both sides."""
        known = np.concatenate([truth[truth > 0] for truth in self.truths if truth is not None])
        return float(known.min()) / 1.25, float(known.max()) * 1.25

    @cached_property
    def covisible(self) -> list[np.ndarray]:
        """Per view bool [H, W]: true depth is known and at least one other view sees that surface."""
        return [_covisible(self, index) for index in range(len(self.cameras))]


def _covisible(rig: Rig, index: int) -> np.ndarray:
    truth, camera = rig.truths[index], rig.cameras[index]
    if truth is None:
        return np.zeros((camera.height, camera.width), bool)
    seen = np.zeros(truth.shape, bool)
    u, v = pixel_grid(camera)
    for other, source in enumerate(rig.cameras):
        if other == index:
            continue
        at = view_pair(camera, source).project(u, v, truth)
        surface = rig.truths[other]
        if surface is None:
            surface = _nearest_surface(at.x, at.y, np.where(truth > 0, at.z, 0), source)
        there = sample_nearest(surface, at)
        seen |= (truth > 0) & (np.abs(there - at.z) < OCCLUSION * at.z)
    return seen


def sample_nearest(depth: np.ndarray, at: Projection) -> np.ndarray:
    """`depth` at the nearest pixel of `at`, 0 outside of the image or behind the camera.

    Nearest on purpose: a value interpolated across an occlusion edge belongs to no surface.
    """
    height, width = depth.shape
    inside = (at.z > 0) & (at.x > -0.5) & (at.y > -0.5) & (at.x < width - 0.5) & (at.y < height - 0.5)
    column = np.rint(np.where(inside, at.x, 0)).astype(np.int32)
    row = np.rint(np.where(inside, at.y, 0)).astype(np.int32)
    return np.where(inside, depth[row, column], 0)


def _nearest_surface(x: np.ndarray, y: np.ndarray, z: np.ndarray, source: Camera) -> np.ndarray:
    """Depth map [H, W] of the source that the points (x, y, z) make: for sources whose own truth is not published."""
    surface = np.full((source.height, source.width), np.inf, np.float32)
    column, row = np.rint(x), np.rint(y)
    inside = (z > 0) & (column >= 0) & (row >= 0) & (column < source.width) & (row < source.height)
    np.minimum.at(surface, (row[inside].astype(int), column[inside].astype(int)), z[inside])
    return np.where(np.isfinite(surface), surface, 0)


def textured_rig(views: int, width: int = 320, height: int = 180, seed: int = 0) -> Rig:
    """A rendered room seen by 2, 3 or 4 cameras, with sensor noise and unequal gains."""
    rng = np.random.default_rng([seed, views])
    scene = furnished_room(seed, moving=False)
    walls = (
        (materials.confetti(rng, (0.7, 0.75, 0.6)), materials.bricks(rng)),
        (materials.plaster(rng), materials.bricks(rng)),
        (materials.planks(rng), materials.plaster(rng)),
    )
    scene = replace(scene, room=replace(scene.room, textures=walls))
    cameras = list(arc_cameras(views, 0, width, height, ARCS[views]).values())
    images = []
    for camera in cameras:
        clean = render_color(scene, camera, 0.0) * rng.uniform(0.95, 1.05)
        images.append(np.clip(np.rint(clean + rng.normal(0, 255 * NOISE, clean.shape)), 0, 255).astype(np.uint8))
    truths: list[np.ndarray | None] = [render_depth(scene, camera, 0.0) for camera in cameras]
    return Rig(f"synthetic{views}", images, cameras, truths)


def rig_of(recording: Recording, name: str, cameras: Sequence[str], frame: int) -> Rig:
    """One frame of a recording that has true depth."""
    images = [recording.image(camera, frame) for camera in cameras]
    truths = [recording.depth(camera, frame) for camera in cameras]
    return Rig(name, images, [recording.cameras[camera] for camera in cameras], truths)


def load_rigs(name: str, data: Path | None, width: int = 320) -> list[Rig]:
    """The rigs that are measured together under one name.

    Args:
        name: `synthetic2`, `synthetic3`, `synthetic4`, `studio`, or a Middlebury pair (`art`, `laundry`, ...).
        data: folder that holds `studio` and `middlebury`; not needed for rendered rigs.
        width: of rendered images, pixels; they are 16:9.

    Raises:
        D2Error: the name is unknown, or its recording is not in `data`.
    """
    refuse_unknown("rig", [name], (*RENDERED, *FROM_DISK))
    if name in RENDERED:
        return [textured_rig(RENDERED[name], width, round(width * 9 / 16))]
    folder = data or Path()
    if name == "studio":
        recording = open_recording(folder / "studio", cameras=STUDIO_CAMERAS, frames=STUDIO_FRAMES)
        return [rig_of(recording, name, STUDIO_CAMERAS, frame) for frame in STUDIO_FRAMES]
    recording = open_recording(folder / "middlebury" / name)
    return [rig_of(recording, name, ("left", "right"), 0)]
