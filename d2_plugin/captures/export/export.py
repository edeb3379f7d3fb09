"""Any capture written out in the input layout of the public 4DGS repositories, from which it reads back the same.

    transforms   fudan-zvg/4d-gaussian-splatting: transforms_train.json, transforms_test.json, images/, points3d.ply
    n3dv         ingra14m/Deformable-3D-Gaussians: poses_bounds.npy, frames/, points3D.ply
    multipleview hustvl/4DGaussians, its layout for own recordings: sparse_/, camNN/frame_NNNNN.jpg
    colmap       everything that reads a COLMAP model: sparse/0, images/

`export.json` beside the pictures says which camera and which frame of the source became which of the export.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from d2_plugin.captures.capture import Camera, Capture
from d2_plugin.captures.export.ply import PointCloud
from d2_plugin.captures.pictures import write_png
from d2_plugin.errors import D2Error, unknown_name

EXPORT_FILE = "export.json"
"""Written last: a folder without it is half an export."""


@dataclass(frozen=True)
class Export:
    """What a layout is written from: a capture, which of its cameras are held out, and where Gaussians start."""

    capture: Capture
    test_cameras: tuple[str, ...]
    cloud: PointCloud | None
    folder: Path

    @property
    def train_cameras(self) -> tuple[str, ...]:
        """The cameras that are not held out, in the capture's order."""
        return tuple(name for name in self.capture.cameras if name not in self.test_cameras)

    def write_pictures(self, place: Callable[[str, int], Path]) -> None:
        """Every frame of every camera as a lossless PNG at `place(camera, frame)`."""
        for camera in self.capture.cameras:
            for frame in self.capture.frames:
                target = place(camera, frame)
                target.parent.mkdir(parents=True, exist_ok=True)
                write_png(target, self.capture.image(camera, frame))


Names = dict[str, str]
"""Camera of the source -> camera of the export."""


def export_capture(
    capture: Capture,
    layout: str,
    path: Path | str,
    *,
    test_cameras: Sequence[str] = (),
    cloud: PointCloud | None = None,
) -> Path:
    """Write `capture` under `path` in the layout `transforms`, `n3dv`, `multipleview` or `colmap`; returns the path.

    Args:
        capture: cameras and frames to write; restrict it with `select_cameras`, `select_frames` and `downscale`.
        layout: see the module's description.
        path: a folder that does not exist or is empty.
        test_cameras: held out, in the way the layout can say it: a file of their own, or the first place.
        cloud: initial points; times are seconds since the first frame. None leaves them to the trainer.

    Raises:
        D2Error: what the layout cannot hold (principal points, several focal lengths, skew), by camera.
    """
    from d2_plugin.captures.export.colmap import write_colmap, write_multipleview
    from d2_plugin.captures.export.n3dv import write_n3dv
    from d2_plugin.captures.export.transforms_json import write_transforms

    writers: dict[str, Callable[[Export], Names]] = {
        "transforms": write_transforms,
        "n3dv": write_n3dv,
        "multipleview": write_multipleview,
        "colmap": write_colmap,
    }
    if layout not in writers:
        raise unknown_name("layout", layout, writers)
    folder = _empty(Path(path))
    export = Export(_without_skew(capture), _known(capture, test_cameras), cloud, folder)
    names = writers[layout](export)
    frames = {frame: number for number, frame in enumerate(capture.frames, 1)} if layout == "multipleview" else None
    description = {"source": capture.name, "layout": layout, "cameras": names}
    description["frames"] = frames or {frame: frame for frame in capture.frames}
    description |= {"fps": capture.fps, "test_cameras": [names[name] for name in export.test_cameras if name in names]}
    (folder / EXPORT_FILE).write_text(json.dumps(description, indent=1) + "\n")
    return folder


def refuse_off_centre(camera: Camera, layout: str) -> None:
    """Raise `D2Error` for a camera that one focal length and a centred principal point do not describe."""
    fx, fy, cx, cy = (float(camera.K[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
    slack = 1e-6 * camera.width
    if abs(fx - fy) > slack or abs(cx - camera.width / 2) > slack or abs(cy - camera.height / 2) > slack:
        raise D2Error(
            f"camera {camera.name} has fx {fx:g}, fy {fy:g} and principal point ({cx:g}, {cy:g}) but layout {layout} "
            f"holds one focal length and the centre ({camera.width / 2:g}, {camera.height / 2:g}) only: "
            "choose the layout transforms"
        )


def _known(capture: Capture, test_cameras: Sequence[str]) -> tuple[str, ...]:
    for name in test_cameras:
        if name not in capture.cameras:
            raise unknown_name("camera", name, capture.cameras)
    if set(test_cameras) >= set(capture.cameras):
        raise D2Error(f"all cameras of {capture.name} are held out: leave at least one to train on")
    return tuple(test_cameras)


def _without_skew(capture: Capture) -> Capture:
    for camera in capture.cameras.values():
        if camera.K[0, 1] != 0:
            raise D2Error(
                f"camera {camera.name} has skew {camera.K[0, 1]:g}, which no layout holds: undistort it first"
            )
    return capture


def _empty(folder: Path) -> Path:
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise D2Error(f"{folder} already exists and is not empty: choose another folder, nothing was written")
    folder.mkdir(parents=True, exist_ok=True)
    return folder
