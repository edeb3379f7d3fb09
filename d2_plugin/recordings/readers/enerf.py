"""ENeRF-Outdoor and other recordings of EasyMocap and EasyVolcap: intri.yml and extri.yml beside images/<camera>/.

Both are OpenCV's YAML. intri.yml: K_<camera> and D_<camera> or dist_<camera>; extri.yml: R_<camera> (rotation vector)
or Rot_<camera> (matrix) and T_<camera>, mapping world to camera. OpenCV's pixels have their centres at whole numbers,
so half a pixel is added to principal points. Images are undistorted on load with K kept.
"""

from __future__ import annotations

from pathlib import Path

from d2_plugin.errors import D2Error, unknown_name
from d2_plugin.recordings.assembly import assembled
from d2_plugin.recordings.cameras.formats.easymocap import EXTRINSICS, INTRINSICS, OpencvYaml, entry_of
from d2_plugin.recordings.cameras.lens import Lens
from d2_plugin.recordings.files import FrameFiles, common_frames, numbered_files
from d2_plugin.recordings.images import image_size
from d2_plugin.recordings.recording import Camera, Recording

ENERF_FPS = 60.0
"""Frame rate at which EasyVolcap plays the data set; the files name none."""

NOT_USED = ("bkgd", "vhull", "background.ply")
"""What recordings of this layout may also hold."""


def is_enerf(path: Path) -> bool:
    """Whether `path` looks like the layout of EasyMocap and EasyVolcap."""
    return (path / INTRINSICS).is_file()


def open_enerf(path: Path, cameras: tuple[str, ...] | None = None, intersect: bool = False) -> Recording:
    """Read the layout of EasyMocap and EasyVolcap; of the images only headers are opened.

    The published files name cameras of which only some have a pose or images: the others are left out with a note,
    whatever `intersect` says. A camera that is asked for by name must have all three.
    """
    intrinsics, extrinsics = OpencvYaml(path / INTRINSICS), OpencvYaml(path / EXTRINSICS)
    folders = {folder.name: folder for folder in sorted((path / "images").glob("*")) if folder.is_dir()}
    names, notes = _agreed(intrinsics, extrinsics, list(folders), cameras, path)
    images = {name: numbered_files(folders[name]) for name in names}
    frames, frame_notes = common_frames(images, path / "images")
    calibrated = {name: _camera(name, intrinsics, extrinsics, images[name], frames[0]) for name in names}
    unused = [name for name in NOT_USED if (path / name).exists()]
    return assembled(
        path,
        {name: camera for name, (camera, _) in calibrated.items()},
        images,
        frames,
        ENERF_FPS,
        (*notes, *frame_notes, *((f"not used: {', '.join(unused)}",) if unused else ())),
        {name: lens for name, (_, lens) in calibrated.items()},
    )


def _agreed(
    intrinsics: OpencvYaml, extrinsics: OpencvYaml, folders: list[str], asked: tuple[str, ...] | None, path: Path
) -> tuple[list[str], tuple[str, ...]]:
    """(cameras with intrinsics, pose and images, notes)."""
    listed = list(dict.fromkeys([*extrinsics.names(), *intrinsics.names(), *folders]))
    lacks = {
        name: [
            *([INTRINSICS] if intrinsics.matrix(f"K_{name}") is None else []),
            *([EXTRINSICS] if extrinsics.matrix(f"T_{name}") is None else []),
            *(["images"] if name not in folders else []),
        ]
        for name in listed
    }
    complete = sorted(name for name in listed if not lacks[name])
    for name in asked or ():
        if name not in lacks:
            raise unknown_name("camera", name, complete)
        if lacks[name]:
            raise D2Error(
                f"camera {name} of {path} is missing in {' and '.join(lacks[name])}: choose among {', '.join(complete)}"
            )
    if not complete:
        raise D2Error(
            f"no camera of {path} has intrinsics in {INTRINSICS}, a pose in {EXTRINSICS} and a folder in images: "
            "name the folders as the files name the cameras"
        )
    missing = [f"{name} (no {', '.join(lacks[name])})" for name in listed if lacks[name]]
    notes = (f"left out, calibration or images missing: {', '.join(missing)}",) if missing and asked is None else ()
    return list(asked) if asked is not None else complete, notes


def _camera(
    name: str, intrinsics: OpencvYaml, extrinsics: OpencvYaml, files: FrameFiles, frame: int
) -> tuple[Camera, Lens]:
    """The pinhole camera of the undistorted images, and the lens of the recorded ones."""
    size, where = image_size(files[frame]), f"{intrinsics.path} and {EXTRINSICS}"
    near, far = extrinsics.number(f"n_{name}"), extrinsics.number(f"f_{name}")
    near_far = (near, far) if near is not None and far is not None else None
    camera = entry_of(name, intrinsics, extrinsics).recorded(size, where)
    return camera.pinhole(where, near_far), camera.lens
