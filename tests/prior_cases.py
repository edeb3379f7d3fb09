"""For tests of priors: sources that show something else, stores byte by byte, depth maps as COLMAP writes them."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.emulated_multiview import emulated_multiview
from d2_plugin.priors.frame import describe_recording
from d2_plugin.priors.geometry import viewing_rays
from d2_plugin.protocol import Label
from d2_plugin.recordings.recording import Camera, Recording, Source
from d2_plugin.store.maps import FusedPrior
from d2_plugin.store.store import PriorStore

Shown = Callable[[str, int], "np.ndarray | None"]


MAPS = ("image", "depth", "mono")


def showing(recording: Recording, instead: dict[str, Shown], **changes: object) -> Recording:
    """The recording with other images, depth or monocular maps, and other values of `changes`."""
    source = Source()
    vars(source).update({kind: getattr(recording.source, kind) for kind in MAPS} | instead)
    return replace(recording, source=source, **changes)


def camera_at(
    place: Sequence[float] = (0, 0, 0),
    turn: float = 0,
    *,
    size: tuple[int, int],
    focal: float | None = None,
    principal: Sequence[float] = (0.5, 0.5),
) -> Camera:
    """Turned by `turn` about the vertical; a focal length of the width where none is given; `principal` in shares."""
    T = np.eye(4)
    T[:3, :3] = [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
    T[:3, 3] = -T[:3, :3] @ place
    length = focal or size[0]
    K = np.array([[length, 0, principal[0] * size[0]], [0, length, principal[1] * size[1]], [0, 0, 1.0]])
    return Camera("camera", *size, K, T)


def world_points(camera: Camera, depth: np.ndarray) -> np.ndarray:
    """World point [H * W, 3] of every pixel centre at its planar depth [H, W]."""
    in_camera = (viewing_rays(camera, np.float64) * depth[..., None]).reshape(-1, 3)
    return (in_camera - camera.T_camera_world[:3, 3]) @ camera.T_camera_world[:3, :3]


def plane_seen_by(camera: Camera, normal: Sequence[float], offset: float) -> np.ndarray:
    """Planar depth [H, W] of the plane normal . X = offset of the world, 0 where a ray does not meet it."""
    R, t = camera.T_camera_world[:3, :3], camera.T_camera_world[:3, 3]
    toward = viewing_rays(camera, np.float64) @ (R @ normal)
    reached = offset + (R @ normal) @ t
    met = toward * np.sign(reached) > 1e-3
    return np.where(met, reached / np.where(met, toward, 1), 0)


def contents(path: Path) -> dict[str, bytes]:
    return {str(file.relative_to(path)): file.read_bytes() for file in sorted(path.rglob("*")) if file.is_file()}


def write_dense_array(path: Path, depth: np.ndarray) -> None:
    """Write a depth map [H, W] as COLMAP would."""
    height, width = depth.shape
    path.write_bytes(f"{width}&{height}&1&".encode() + np.ascontiguousarray(depth, dtype="<f4").tobytes())


def write_prior(recording: Recording, path: Path, depth_of: Callable[[int], float]) -> PriorStore:
    """Verified depth of all views, in every pixel the one of the frame."""
    store = PriorStore.create(path, [*recording.cameras], recording.frames, describe_recording(recording))
    for name, frame in itertools.product(recording.cameras, recording.frames):
        image = recording.image(name, frame)
        depth, labels = np.float32(depth_of(frame)), np.uint8(Label.VERIFIED)
        maps = (np.full(image.shape[:2], value) for value in (depth, labels, np.float32(0)))
        store.write(name, frame, FusedPrior(*maps, image), {})
    return store


def write_multiview(
    recording: Recording,
    names: list[str],
    folder: Path,
    posed: bool = False,
    turned: Callable[[dict[str, np.ndarray], int], None] | None = None,
) -> Path:
    """Emulated multi-view predictions of all frames; `turned` may spoil the arrays of a frame."""
    folder.mkdir(parents=True)
    cameras = [recording.cameras[name] for name in names]
    for frame in recording.frames:
        arrays = emulated_multiview([recording.depth(name, frame) for name in names], cameras, 100 + frame, posed)
        if turned is not None:
            turned(arrays, frame)
        np.savez(folder / f"{frame:05d}.npz", **arrays)
    return folder
