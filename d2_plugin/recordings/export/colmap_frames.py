"""The layout of SpacetimeGaussians and Ex4DGS for N3V: a COLMAP model and a folder of images for each instant.

    DATA/poses_bounds.npy               of which the image's size and focal length are read
    DATA/camNN/J.png                    read by Ex4DGS
    DATA/colmap_J/images/camNN.png      the same images, read by SpacetimeGaussians (a link)
    DATA/colmap_J/sparse/0/*.bin        cameras and initial points

Both readers hold out the camera whose name has cam00 in it and train on all others; frames count from 0.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.recordings.export.base import Export, Written, refuse_off_centre
from d2_plugin.recordings.export.colmap import Image, write_model
from d2_plugin.recordings.export.n3dv import depth_bounds, llff_row
from d2_plugin.recordings.export.ply import PointCloud


def write_colmap_frames(export: Export) -> Written:
    """The files above; the held-out camera becomes cam00, the others cam01, cam02, ...

    Every instant starts from the points of its time, or from all of them where points have none.
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
    images = [Image(f"{name}.png", index + 1, camera) for index, (name, camera) in enumerate(cameras.items())]
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


LEAST_POINTS = 100
"""Fewer points of its own than this, and an instant starts from those of all instants."""
