"""The same small recording in every layout that can be read, for tests that damage it."""

from pathlib import Path

import numpy as np
import pytest
from stand_in_recordings import renamed, smooth_recording, write_rows, write_videos

from d2_plugin.recordings import Recording
from d2_plugin.recordings.cameras.rotations import quaternion_of_rotation
from d2_plugin.recordings.export.export import export_recording
from d2_plugin.recordings.export.folder import save_recording
from d2_plugin.recordings.export.ply import PointCloud
from d2_plugin.recordings.images import write_png
from d2_plugin.recordings.synthetic.room import synthetic_recording

W, H = 48, 32

CLOUD = PointCloud(np.eye(3) + 2, np.full((3, 3), 0.5), np.zeros(3))
"""The points of a model of COLMAP's."""


def small_recording() -> Recording:
    """Two cameras, two frames, true depth and monocular maps; it declares near and far."""
    room = synthetic_recording(cameras=2, held_out=0, frames=2, width=W, height=H)
    return renamed(room, ("cam00", "cam01"), near_far=(1.0, 9.0))


def write_layout(name: str, path: Path) -> Path:
    """The recording in one layout: `folder`, `n3dv`, `videos`, `technicolor`, `enerf`, `transforms` or `colmap*`."""
    recording = small_recording()
    if name == "folder":
        return save_recording(recording, path)
    if name == "videos":
        return write_videos(smooth_recording(("00", "01"), frames=3), path)
    if name == "n3dv":
        for camera in recording.cameras:
            _images(recording, camera, path / camera)
        return write_rows(recording, path)
    if name == "technicolor":
        return _technicolor(recording, path)
    if name == "enerf":
        return _enerf(recording, path)
    export_recording(recording, name.removesuffix("_text"), path, cloud=CLOUD)
    if name == "colmap_text":
        model = path / "sparse" / "0"
        pytest.importorskip("pycolmap").Reconstruction(str(model)).write_text(str(model))
        for file in model.glob("*.bin"):
            file.unlink()
    return path


def _images(recording: Recording, camera: str, folder: Path, pattern: str = "{:05d}.png") -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for frame in recording.frames:
        write_png(folder / pattern.format(frame), recording.image(camera, frame))


def _technicolor(recording: Recording, path: Path) -> Path:
    lines = ["f cu cv ar sk d1 d2 qw qx qy qz tx ty tz"]
    for number, (name, camera) in enumerate(recording.cameras.items()):
        K, T = camera.K, camera.T_camera_world
        numbers = [K[0, 0], K[0, 2], K[1, 2], K[1, 1] / K[0, 0], 0.0, 0.01, 0.0]
        numbers += [*quaternion_of_rotation(T[:3, :3]), *T[:3, 3]]
        lines.append(" ".join(f"{value:.17g}" for value in numbers))
        _images(recording, name, path, "scene_{:05d}" + f"_{number:02d}.png")
    (path / "cameras_parameters.txt").write_text("\n".join(lines))
    return path


def _enerf(recording: Recording, path: Path) -> Path:
    for module in ("cv2", "yaml", "scipy"):
        pytest.importorskip(module)
    from calibration_writers import Known, easymocap

    known, half = [], np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    for name, camera in recording.cameras.items():
        _images(recording, name, path / "images" / name)
        size, T = (camera.width, camera.height), camera.T_camera_world
        known.append(Known(name, size, camera.K - half, (0.01, 0, 0, 0, 0), T[:3, :3], T[:3, 3]))
    return easymocap(path, known)
