"""Any recording written out in the input layout of the public 4DGS repositories, from which it reads back the same.

    transforms   fudan-zvg/4d-gaussian-splatting: transforms_train.json, transforms_test.json, images/, points3d.ply
    n3dv         ingra14m/Deformable-3D-Gaussians: poses_bounds.npy, frames/, points3D.ply
    multipleview hustvl/4DGaussians, its layout for own recordings: sparse_/, camNN/frame_NNNNN.jpg
    colmap       everything that reads a COLMAP model: sparse/0, images/
    colmap_frames oppo-us-research/SpacetimeGaussians, juno181/Ex4DGS: colmap_N/ folders, camNN/N.png
    gsplat       nerfstudio-project/gsplat's examples: sparse/0, images/, one instant

`export.json` beside the images says which camera and which frame of the source became which of the export.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from pathlib import Path

from d2_plugin.errors import D2Error, refuse_unknown
from d2_plugin.protocol import EXPORT_FILE
from d2_plugin.reading import json_text
from d2_plugin.recordings.cameras.formats.cameras_json import refuse_skew
from d2_plugin.recordings.export.base import Export, Written, whole_folder
from d2_plugin.recordings.export.colmap import write_colmap, write_colmap_frames, write_gsplat, write_multipleview
from d2_plugin.recordings.export.n3dv import write_n3dv
from d2_plugin.recordings.export.ply import PointCloud
from d2_plugin.recordings.export.transforms_json import write_transforms
from d2_plugin.recordings.recording import Recording
from d2_plugin.values import checked_arguments

WRITERS: dict[str, Callable[[Export], Written]] = {
    "transforms": write_transforms,
    "n3dv": write_n3dv,
    "multipleview": write_multipleview,
    "colmap": write_colmap,
    "colmap_frames": write_colmap_frames,
    "gsplat": write_gsplat,
}
"""By the name of the layout. A new layout is one function in a module beside this one and one row here."""


@checked_arguments
def export_recording(
    recording: Recording,
    layout: str,
    path: Path | str,
    *,
    test_cameras: Sequence[str] = (),
    cloud: PointCloud | None = None,
) -> Path:
    """Write `recording` under `path` in one of the layouts of `WRITERS`; returns the path.

    Args:
        recording: cameras and frames to write; restrict it with `select_cameras`, `select_frames` and `downscale`.
        path: a folder that does not exist or is empty.
        test_cameras: held out, in the way the layout can say it: a file of their own, or the first place.
        cloud: initial points; times are seconds since the first frame. None leaves them to the trainer.

    Raises:
        D2Error: what the layout cannot hold (principal points, several focal lengths, skew), by camera.
    """
    refuse_unknown("layout", [layout], WRITERS)
    held_out = _known(recording, test_cameras)
    if cloud is not None:
        cloud.check()
    for camera in recording.cameras.values():
        refuse_skew(camera.name, camera.K)
    if recording.late and layout != "transforms":
        logging.getLogger(__name__).warning(
            "images have instants of their own, which %s cannot say: choose transforms", layout
        )
    with whole_folder(path) as folder:
        written = WRITERS[layout](Export(recording, held_out, cloud, folder))
        description = {
            "source": recording.name,
            "layout": layout,
            "cameras": written.cameras,
            "frames": written.frames,
            "calibrations": {name: camera.calibration() for name, camera in recording.cameras.items()},
            "fps": recording.fps,
            "test_cameras": [written.cameras[name] for name in held_out if name in written.cameras],
        }
        # Written last: a folder without it is half an export.
        (folder / EXPORT_FILE).write_text(json_text(description, EXPORT_FILE, indent=1) + "\n")
    return Path(path)


def _known(recording: Recording, test_cameras: Sequence[str]) -> tuple[str, ...]:
    refuse_unknown("camera", test_cameras, recording.cameras)
    if set(test_cameras) >= set(recording.cameras):
        raise D2Error(f"all cameras of {recording.name} are held out: leave at least one to train on")
    return tuple(test_cameras)
