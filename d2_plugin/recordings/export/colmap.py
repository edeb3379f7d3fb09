"""Layouts that are COLMAP models with known poses, in the places where trainers look for them."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from d2_plugin.durable import write
from d2_plugin.errors import D2Error
from d2_plugin.recordings.cameras.rotations import quaternion_of_rotation
from d2_plugin.recordings.export.base import Export, Written, refuse_off_centre
from d2_plugin.recordings.export.n3dv import depth_bounds, llff_row
from d2_plugin.recordings.export.ply import PointCloud, write_point_cloud
from d2_plugin.recordings.images import color_bytes, encode_jpeg
from d2_plugin.recordings.recording import Camera

PINHOLE = 1  # COLMAP's number of the camera model with fx, fy, cx, cy
JPEG_QUALITY = 98  # of the images that 4DGaussians insists to be JPEG
LEAST_POINTS = 100  # fewer points of its own than this, and an instant starts from those of all instants


def write_colmap(export: Export) -> Written:
    """sparse/0/{cameras,images,points3D}.bin and images/CAMERA_FRAME.png; names are kept.

    COLMAP's models know no time, so the first frame alone is registered: a trainer of still scenes sees one instant,
    and 4C4D gives further images of a camera (named camNN) that camera's pose, as `open_recording` does.
    """
    recording = export.recording
    export.write_images(lambda camera, frame: export.folder / "images" / f"{camera}_{frame:04d}.png")
    first = recording.frames[0]
    images = {f"{name}_{first:04d}.png": camera for name, camera in recording.cameras.items()}
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
            path = export.folder / names[name] / f"frame_{index + 1:05d}.jpg"
            write(path, encode_jpeg(export.recording.image(name, frame), JPEG_QUALITY), synced=False)
    # Its reader takes the digits behind the fifth letter of an image's name for the number of the camera.
    images = {f"image{index + 1}.jpg": camera for index, camera in enumerate(kept.values())}
    write_model(export.folder / "sparse_", images, export.cloud)
    rows = [llff_row(camera, depth_bounds(camera, export.cloud)) for camera in kept.values()]
    np.save(export.folder / "poses_bounds_multipleview.npy", np.stack(rows))
    write_point_cloud(export.folder / "points3D_multipleview.ply", export.cloud)
    return export.written(names, {frame: index + 1 for index, frame in enumerate(export.recording.frames)})


def write_colmap_frames(export: Export) -> Written:
    """The layout of SpacetimeGaussians and Ex4DGS for N3V: a COLMAP model and a folder of images for each instant.

        DATA/poses_bounds.npy               of which the image's size and focal length are read
        DATA/camNN/J.png                    read by Ex4DGS
        DATA/colmap_J/images/camNN.png      the same images, read by SpacetimeGaussians (a link)
        DATA/colmap_J/sparse/0/*.bin        cameras and initial points

    Both readers hold out the camera whose name has cam00 in it and train on all others; frames count from 0. The
    held-out camera becomes cam00, the others cam01, cam02, ... Every instant starts from the points of its time, or
    from all of them where points have none.
    """
    if export.cloud is None:
        raise D2Error("the layout colmap_frames needs initial points, because its readers make none: give some")
    if len(export.test_cameras) > 1:
        raise D2Error(
            f"the readers of the layout colmap_frames hold out one camera, got {', '.join(export.test_cameras)}: "
            "they would train on the others, so hold out one"
        )
    first = 0 if export.test_cameras else 1
    ordered = [*export.test_cameras, *export.train_cameras]
    names = {name: f"cam{index + first:02d}" for index, name in enumerate(ordered)}
    cameras = {names[name]: export.recording.cameras[name] for name in ordered}
    for camera in cameras.values():
        refuse_off_centre(camera, "colmap_frames")
    frames = {frame: index for index, frame in enumerate(export.recording.frames)}
    export.write_images(lambda camera, frame: export.folder / names[camera] / f"{frames[frame]}.png")
    images = {f"{name}.png": camera for name, camera in cameras.items()}
    for frame, index in frames.items():
        folder = export.folder / f"colmap_{index}"
        write_model(folder / "sparse" / "0", images, _of_time(export.cloud, export.recording.seconds(frame)))
        (folder / "images").mkdir()
        for name in cameras:
            (folder / "images" / f"{name}.png").symlink_to(Path("..") / ".." / name / f"{index}.png")
    rows = [llff_row(camera, depth_bounds(camera, export.cloud)) for camera in cameras.values()]
    np.save(export.folder / "poses_bounds.npy", np.stack(rows))
    return export.written(names, frames)


def _of_time(cloud: PointCloud, seconds: float) -> PointCloud:
    """The points of one instant; all of them where too few carry its time, since a trainer cannot start from none."""
    if cloud.times is None:
        return cloud
    now = np.isclose(cloud.times, seconds, atol=1e-6)
    if now.sum() < LEAST_POINTS:
        return cloud
    return PointCloud(cloud.positions[now], cloud.colors[now], cloud.times[now])


def write_gsplat(export: Export) -> Written:
    """gsplat's examples: sparse/0/*.bin and images/camNN_FRAME.png of the first frame; cameras are renamed.

    The parser sorts images by name and holds out every N-th from the first on (`--test_every N`), so a held-out
    camera gets every N-th name. N is the number of all cameras divided by that of the held-out ones.
    """
    every = test_every(len(export.train_cameras), len(export.test_cameras))
    held_out, trained = list(export.test_cameras), list(export.train_cameras)
    total = len(held_out) + len(trained)
    ordered = [held_out.pop(0) if index % every == 0 else trained.pop(0) for index in range(total)]
    digits = max(2, len(str(total - 1)))
    names = {name: f"cam{index:0{digits}d}" for index, name in enumerate(ordered)}
    frame = export.recording.frames[0]
    export.write_images(
        lambda camera, _: export.folder / "images" / f"{names[camera]}_{frame:04d}.png", frames=(frame,)
    )
    images = {f"{names[name]}_{frame:04d}.png": export.recording.cameras[name] for name in ordered}
    write_model(export.folder / "sparse" / "0", images, export.cloud)
    return export.written({name: names[name] for name in export.recording.cameras}, {frame: frame})


def test_every(trained: int, held_out: int) -> int:
    """N so that every N-th image from the first on is held out, and no other.

    Raises:
        D2Error: no N does that.
    """
    total = trained + held_out
    for every in range(total, 0, -1):
        if -(-total // every) == held_out:
            return every
    raise D2Error(
        f"gsplat's parser holds out every N-th image, the first at least, and no N gives {held_out} of {total}: "
        "name one camera with --test-cameras, or as many as are trained on"
    )


def write_model(folder: Path, images: Mapping[str, Camera], cloud: PointCloud | None) -> None:
    """cameras.bin, images.bin and points3D.bin of images by the names of their files, each with a camera of its own;
    images have no observations and points no tracks."""
    folder.mkdir(parents=True)
    cameras, shots = [], []
    for number, (name, camera) in enumerate(images.items(), start=1):
        intrinsics = (camera.K[place] for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
        cameras.append(struct.pack("<iiQQ4d", number, PINHOLE, camera.width, camera.height, *intrinsics))
        pose = camera.T_camera_world
        head = struct.pack("<I7dI", number, *quaternion_of_rotation(pose[:3, :3]), *pose[:3, 3], number)
        shots.append(head + name.encode() + b"\0" + struct.pack("<Q", 0))
    for part, records in (("cameras", cameras), ("images", shots)):
        (folder / f"{part}.bin").write_bytes(struct.pack("<Q", len(records)) + b"".join(records))
    (folder / "points3D.bin").write_bytes(_point_records(cloud))


def _point_records(cloud: PointCloud | None) -> bytes:
    if cloud is None:
        return struct.pack("<Q", 0)
    colors = color_bytes(cloud.colors).tolist()
    rows = zip(np.asarray(cloud.positions, float).tolist(), colors)
    records = [struct.pack("<Q3d3BdQ", index + 1, *xyz, *rgb, 0.0, 0) for index, (xyz, rgb) in enumerate(rows)]
    return struct.pack("<Q", len(records)) + b"".join(records)
