"""The layout of Neural 3D Video with extracted frames, which Deformable-3D-Gaussians reads.

It takes the focal length of the first row for all cameras, holds out the first camera and reads 24 frames. 4DGaussians
wants the videos beside the frames, images of 1352 x 1014 pixels and rows that say 2704 x 2028: for own recordings it
has another layout, `multipleview`.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.recordings.export.base import Export, Written, refuse_off_centre
from d2_plugin.recordings.export.ply import PointCloud, write_point_cloud
from d2_plugin.recordings.recording import Camera

log = logging.getLogger(__name__)

READ_FRAMES = 24  # frames of each camera that Deformable-3D-Gaussians reads (scene/__init__.py), however many there are


def write_n3dv(export: Export) -> Written:
    """poses_bounds.npy, CAMERA/images/CAMERA_FRAME.png, frames/ with a link to each, and points3D.ply.

    A camera keeps its name where all begin with `cam` and the held-out one comes first in sorted order; a name of
    digits gets `cam` before it; otherwise they become cam00, cam01, ..., the held-out ones first.
    """
    cameras = export.recording.cameras
    for camera in cameras.values():
        refuse_off_centre(camera, "n3dv")
    _say_what_is_lost(list(cameras.values()), len(export.recording.frames))
    names = sorted_names([*export.test_cameras, *export.train_cameras], len(export.test_cameras))
    (export.folder / "frames").mkdir()
    for name in names.values():
        (export.folder / "frames" / name).symlink_to(Path("..") / name / "images")
    # Deformable-3D-Gaussians knows an image by its file's name alone, so that has to name the camera, too.
    export.write_images(
        lambda camera, frame: export.folder / names[camera] / "images" / f"{names[camera]}_{frame:04d}.png"
    )
    rows = {names[name]: llff_row(camera, depth_bounds(camera, export.cloud)) for name, camera in cameras.items()}
    np.save(export.folder / "poses_bounds.npy", np.stack([rows[name] for name in sorted(rows)]))
    if export.cloud is not None:
        write_point_cloud(export.folder / "points3D.ply", export.cloud)
    return export.written(names)


def sorted_names(cameras: list[str], held_out: int) -> dict[str, str]:
    """Names that begin with `cam` and whose sorted order puts the first `held_out` of `cameras` first."""
    kept = {name: name if name.startswith("cam") else f"cam{name}" for name in cameras}
    plain = all(name.startswith("cam") or name.isdigit() for name in cameras)
    ordered = sorted(kept.values())
    if plain and set(ordered[:held_out]) == {kept[name] for name in cameras[:held_out]}:
        return kept
    digits = max(2, len(str(len(cameras) - 1)))
    return {name: f"cam{index:0{digits}d}" for index, name in enumerate(cameras)}


def llff_row(camera: Camera, near_far: tuple[float, float]) -> np.ndarray:
    """Row [17] of poses_bounds.npy: a 3 x 5 matrix of the down, right and back axes, the centre and (height, width,
    focal length), then the bounds."""
    right, down, forward = camera.T_camera_world[:3, :3]
    size = np.array([camera.height, camera.width, camera.K[0, 0]])
    return np.concatenate([np.stack([down, right, -forward, camera.centre, size], -1).ravel(), near_far])


def depth_bounds(camera: Camera, cloud: PointCloud | None) -> tuple[float, float]:
    """Near and far depth: as declared, or from the points."""
    if camera.near_far is not None:
        return camera.near_far
    if cloud is not None:
        depths = cloud.positions @ camera.T_camera_world[2, :3] + camera.T_camera_world[2, 3]
        if (depths > 0).sum() >= 10:
            low, high = np.percentile(depths[depths > 0], [1, 99])
            return 0.75 * float(low), 1.25 * float(high)
    raise D2Error(
        f"camera {camera.name} declares no depth bounds and fewer than ten points lie before it, but poses_bounds.npy "
        "needs bounds: declare them in cameras.json or choose the layout transforms"
    )


def _say_what_is_lost(cameras: list[Camera], frames: int) -> None:
    if frames > READ_FRAMES:
        log.warning("%d frames written, but Deformable-3D-Gaussians reads the first %d", frames, READ_FRAMES)
    focals = sorted({round(float(camera.K[0, 0]), 3) for camera in cameras})
    if len(focals) > 1:
        log.warning(
            "focal lengths differ (%g to %g pixels), but the reader of this layout takes the first camera's for all: "
            "choose the layout transforms",
            focals[0],
            focals[-1],
        )
