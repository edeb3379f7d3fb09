"""The layout of NeRF's Blender scenes with times: what fudan-zvg/4d-gaussian-splatting and D-NeRF readers take."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from d2_plugin.reading import json_text
from d2_plugin.recordings.cameras.camera import OPENGL_TO_OPENCV
from d2_plugin.recordings.export.base import Export, Written
from d2_plugin.recordings.export.ply import write_point_cloud
from d2_plugin.recordings.recording import Camera


def write_transforms(export: Export) -> Written:
    """transforms_train.json, transforms_test.json, images/CAMERA_FRAME.png and points3d.ply; names are kept.

    `time` is when the camera took the image, in seconds since the first; where cameras did not expose together, `late`
    says how far that is from the instant of its frame. `transform_matrix` maps an OpenGL camera to the world.
    """
    begin = min(0.0, *(export.recording.seconds(export.recording.frames[0], name) for name in export.recording.cameras))
    export.write_images(lambda camera, frame: export.folder / f"{_stem(camera, frame)}.png")
    for split, cameras in (("train", export.train_cameras), ("test", export.test_cameras)):
        content = _transforms(export, cameras or export.train_cameras[:1], begin)
        content["frames"] = content["frames"] if cameras else []
        path = export.folder / f"transforms_{split}.json"
        path.write_text(json_text(content, path.name, indent=1) + "\n")
    if export.cloud is not None:
        times = None if export.cloud.times is None else export.cloud.times - begin
        write_point_cloud(export.folder / "points3d.ply", export.cloud._replace(times=times))
    return export.written()


def _stem(camera: str, frame: int) -> str:
    return f"images/{camera}_{frame:04d}"


def _transforms(export: Export, cameras: tuple[str, ...], begin: float) -> dict[str, Any]:
    recording = export.recording
    described = [recording.cameras[name] for name in cameras]
    alike = _by_angle_alone(list(recording.cameras.values()))
    content: dict[str, Any] = {"fps": recording.fps, "w": described[0].width, "h": described[0].height}
    content["camera_angle_x"] = 2 * math.atan(described[0].width / (2 * float(described[0].K[0, 0])))
    content["frames"] = [
        {
            "file_path": _stem(camera.name, frame),
            "time": recording.seconds(frame, camera.name) - begin,
            **({"late": recording.late.get(camera.name, {}).get(frame, 0.0)} if recording.late else {}),
            "transform_matrix": (np.linalg.inv(camera.T_camera_world) @ OPENGL_TO_OPENCV).tolist(),
            **({} if alike else _intrinsics(camera)),
        }
        for camera in described
        for frame in recording.frames
    ]
    return content


def _by_angle_alone(cameras: list[Camera]) -> bool:
    """Whether the horizontal field of view says all of K for every camera.

    Intrinsics are written only where it does not: fudan's reader sets the field of view to -1 where it finds them, and
    then draws every footprint too large (its issue 64).
    """
    first = cameras[0]
    centred = np.array([[first.K[0, 0], 0, first.width / 2], [0, first.K[0, 0], first.height / 2], [0, 0, 1]])
    return all(
        np.array_equal(camera.K, centred) and (camera.width, camera.height) == (first.width, first.height)
        for camera in cameras
    )


def _intrinsics(camera: Camera) -> dict[str, float | int]:
    K = camera.K
    focal = {"fl_x": float(K[0, 0]), "fl_y": float(K[1, 1]), "cx": float(K[0, 2]), "cy": float(K[1, 2])}
    return {**focal, "w": camera.width, "h": camera.height}
