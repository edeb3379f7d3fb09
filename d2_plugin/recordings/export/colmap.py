"""COLMAP models with known poses, in the places where trainers look for them."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.recordings.cameras.rotations import quaternion_of_rotation
from d2_plugin.recordings.export.base import Export, Written, refuse_off_centre
from d2_plugin.recordings.export.n3dv import depth_bounds, llff_row
from d2_plugin.recordings.export.ply import PointCloud, color_bytes, write_point_cloud
from d2_plugin.recordings.images import opencv
from d2_plugin.recordings.recording import Camera

PINHOLE = 1
"""COLMAP's number of the camera model with fx, fy, cx, cy."""

JPEG_QUALITY = 98
"""Of the images that 4DGaussians insists to be JPEG."""


class Image(NamedTuple):
    """A registered image: its file name and the number and calibration of its camera."""

    name: str
    number: int
    camera: Camera


def write_colmap(export: Export) -> Written:
    """sparse/0/{cameras,images,points3D}.bin and images/CAMERA_FRAME.png; names are kept.

    COLMAP's models know no time, so the first frame alone is registered: a trainer of still scenes sees one instant,
    and 4C4D gives further images of a camera (named camNN) that camera's pose, as `open_recording` does.
    """
    recording = export.recording
    export.write_images(lambda camera, frame: export.folder / "images" / f"{camera}_{frame:04d}.png")
    first = recording.frames[0]
    images = [
        Image(f"{name}_{first:04d}.png", index + 1, camera)
        for index, (name, camera) in enumerate(recording.cameras.items())
    ]
    write_model(export.folder / "sparse" / "0", images, export.cloud)
    if export.cloud is not None:
        write_point_cloud(export.folder / "sparse" / "0" / "points3D.ply", export.cloud)
    return export.written()


def write_multipleview(export: Export) -> Written:
    """4DGaussians' layout of own recordings: sparse_/, camNN/frame_NNNNN.jpg, points3D_multipleview.ply and
    poses_bounds_multipleview.npy.

    Cameras become cam01, cam02, ... and frames count from 1, since its reader makes up these names. It takes the first
    camera's focal length for all, and tests on frames of the cameras it trains on: held-out cameras are not written.
    """
    if export.cloud is None:
        raise D2Error("the layout multipleview needs initial points, because its reader makes none: give some")
    kept = {name: export.recording.cameras[name] for name in export.train_cameras}
    for camera in kept.values():
        refuse_off_centre(camera, "multipleview")
    names = {name: f"cam{index + 1:02d}" for index, name in enumerate(kept)}
    for name in kept:
        for index, frame in enumerate(export.recording.frames):
            _write_jpeg(export.folder / names[name] / f"frame_{index + 1:05d}.jpg", export.recording.image(name, frame))
    # Its reader takes the digits behind the fifth letter of an image's name for the number of the camera.
    images = [Image(f"image{index + 1}.jpg", index + 1, camera) for index, camera in enumerate(kept.values())]
    write_model(export.folder / "sparse_", images, export.cloud)
    rows = [llff_row(camera, depth_bounds(camera, export.cloud)) for camera in kept.values()]
    np.save(export.folder / "poses_bounds_multipleview.npy", np.stack(rows))
    write_point_cloud(export.folder / "points3D_multipleview.ply", export.cloud)
    return export.written(names, {frame: index + 1 for index, frame in enumerate(export.recording.frames)})


def write_model(folder: Path, images: list[Image], cloud: PointCloud | None) -> None:
    """cameras.bin, images.bin and points3D.bin; images have no observations and points no tracks."""
    folder.mkdir(parents=True)
    cameras = {image.number: image.camera for image in images}
    (folder / "cameras.bin").write_bytes(
        struct.pack("<Q", len(cameras)) + b"".join(_camera_record(*item) for item in cameras.items())
    )
    records = [_image_record(index + 1, image) for index, image in enumerate(images)]
    (folder / "images.bin").write_bytes(struct.pack("<Q", len(images)) + b"".join(records))
    (folder / "points3D.bin").write_bytes(_point_records(cloud))


def _camera_record(number: int, camera: Camera) -> bytes:
    intrinsics = (camera.K[place] for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return struct.pack("<iiQQ4d", number, PINHOLE, camera.width, camera.height, *intrinsics)


def _image_record(identity: int, image: Image) -> bytes:
    pose = image.camera.T_camera_world
    head = struct.pack("<I7dI", identity, *quaternion_of_rotation(pose[:3, :3]), *pose[:3, 3], image.number)
    return head + image.name.encode() + b"\0" + struct.pack("<Q", 0)


def _point_records(cloud: PointCloud | None) -> bytes:
    if cloud is None:
        return struct.pack("<Q", 0)
    colors = color_bytes(cloud.colors).tolist()
    rows = zip(np.asarray(cloud.positions, float).tolist(), colors)
    records = [struct.pack("<Q3d3BdQ", index + 1, *xyz, *rgb, 0.0, 0) for index, (xyz, rgb) in enumerate(rows)]
    return struct.pack("<Q", len(records)) + b"".join(records)


def _write_jpeg(path: Path, image: np.ndarray) -> None:
    cv2 = opencv("writing the JPEG images of the layout multipleview")
    path.parent.mkdir(parents=True, exist_ok=True)
    written, encoded = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not written:
        raise D2Error(f"cannot encode {path} of {image.shape[1]}x{image.shape[0]} pixels as JPEG: downscale it")
    path.write_bytes(encoded.tobytes())
