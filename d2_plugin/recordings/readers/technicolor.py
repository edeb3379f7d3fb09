"""Technicolor (Sabater 2017): a 4 x 4 rig in one folder of images <Scene>_undist_<frame>_<camera>.png.

cameras_parameters.txt has a header line and one line per camera, row by row of the rig: f cu cv ar sk qw qx qy qz tx
ty tz in the undistorted release, with d1 d2 after sk in the distorted one. The pose maps world to camera. The
principal point is not the centre of the image, and fy is ar * f. The camera and the frame are the last two numbers
in an image's name.

The release does not document its distortion: d1 and d2 are taken as k1 and k2 of OpenCV's model, for images whose
name does not say `undist`.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.reading import parsing, read_text
from d2_plugin.recordings.assembly import assembled
from d2_plugin.recordings.cameras.camera import LARGEST_NUMBER, CalibratedCamera, pinhole, rigid
from d2_plugin.recordings.cameras.lens import checked_lens
from d2_plugin.recordings.cameras.rotations import rotation_of_quaternion
from d2_plugin.recordings.files import FrameFiles, Shot, by_camera, cameras_with_images, common_frames, frame_number
from d2_plugin.recordings.images import IMAGE_SUFFIXES, image_size
from d2_plugin.recordings.recording import Recording

PARAMETERS = "cameras_parameters.txt"
UNDISTORTED, DISTORTED = 12, 14  # numbers in a line of the two releases

TECHNICOLOR_FPS = 30.0

DAMAGED = {"birthday": {("09", 12): 13, ("09", 173): 172, ("02", 255): 254}}
"""Images of the data set that cannot be decoded, by scene, camera and frame, and the frame that stands in for each.
Public loaders of the data set do the same."""

NEAR_FAR = {
    "painter": (1.75, 10.0),
    "birthday": (1.75, 10.0),
    "train": (0.65, 10.0),
    "theater": (0.65, 10.0),
    "fabien": (0.35, 2.0),
}
"""Depth bounds by scene, metres, as HyperReel chose them."""

_NAME = re.compile(r"(?P<scene>(?!\.)[^_]*)_.*?(?P<frame>\d+)_(?P<camera>\d+)$")


def open_technicolor(path: Path, cameras: tuple[str, ...] | None = None, intersect: bool = False) -> Recording:
    """Read the Technicolor layout; of the images only headers are opened.

    Cameras are named 00 to 15. Those without images are refused by name, or left out with a note where `intersect`.
    """
    rows = _rows(path / PARAMETERS)
    pictured, scene = _images(path)
    names, notes = cameras_with_images(sorted(rows), pictured, cameras, intersect, path / PARAMETERS)
    images, damage_notes = _repaired({name: pictured[name] for name in names}, scene)
    frames, frame_notes = common_frames(images, path)
    calibrated = {name: _camera(name, rows[name], images[name][frames[0]], scene, path) for name in names}
    where = str(path / PARAMETERS)
    return assembled(path, calibrated, images, frames, TECHNICOLOR_FPS, where, (*notes, *damage_notes, *frame_notes))


def _rows(path: Path) -> dict[str, np.ndarray]:
    with parsing(str(path), "expected a header and one line of numbers per camera"):
        lines = [line.split() for line in read_text(path).splitlines()[1:] if line.strip()]
        rows = [np.array([float(field) for field in line]) for line in lines]
    for number, row in enumerate(rows):
        if row.size not in (UNDISTORTED, DISTORTED):
            raise D2Error(
                f"line {number + 2} of {path} has {row.size} numbers, expected {UNDISTORTED} (undistorted release) or "
                f"{DISTORTED} (distorted): restore the file"
            )
    if not rows:
        raise D2Error(f"{path} describes no camera: expected a header and one line of numbers per camera")
    return {f"{number:02d}": row for number, row in enumerate(rows)}


def _images(path: Path) -> tuple[dict[str, FrameFiles], str]:
    """Files by camera and frame, and the scene's name in lower case."""
    folder = path / "images" if (path / "images").is_dir() else path
    shots: dict[str, Shot] = {}
    files: dict[str, Path] = {}
    scenes: set[str] = set()
    for file in sorted(folder.iterdir()):
        match = _NAME.match(file.stem) if file.suffix.lower() in IMAGE_SUFFIXES else None
        if match:
            camera, frame = (frame_number(match[part], file) for part in ("camera", "frame"))
            shots[file.name], files[file.name] = Shot(f"{camera:02d}", frame), file
            scenes.add(match["scene"].lower())
    if not files:
        raise D2Error(f"no images in {folder}: expected names like Birthday_undist_00151_00.png")
    if len(scenes) > 1:
        raise D2Error(f"{folder} holds images of several scenes ({', '.join(sorted(scenes))}): give one folder each")
    return by_camera(shots, files), scenes.pop()


def _repaired(images: dict[str, FrameFiles], scene: str) -> tuple[dict[str, FrameFiles], tuple[str, ...]]:
    """The same files with those known to be damaged replaced, or dropped where nothing can stand in; and notes."""
    repaired, notes = {name: dict(files) for name, files in images.items()}, []
    for (camera, frame), stand_in in DAMAGED.get(scene, {}).items():
        if frame not in images.get(camera, {}):
            continue
        if stand_in in images[camera]:
            repaired[camera][frame] = images[camera][stand_in]
            notes.append(f"frame {frame} of camera {camera} is known to be damaged: frame {stand_in} stands in")
        else:
            del repaired[camera][frame]
            notes.append(f"frame {frame} of camera {camera} is known to be damaged and left out")
    return repaired, tuple(notes)


def _camera(name: str, row: np.ndarray, image: Path, scene: str, path: Path) -> CalibratedCamera:
    where = f"camera {name} in {path / PARAMETERS}"
    focal, cu, cv, aspect, skew = row[:5]
    distortion = row[5:-7] if "undist" not in image.stem.lower() else ()
    if not np.abs(row).max() <= LARGEST_NUMBER:
        raise D2Error(f"{where} has a number beyond {LARGEST_NUMBER:g}: correct the calibration")
    K = pinhole(focal, aspect * focal, cu, cv)
    K[0, 1] = skew
    with parsing(f"the rotation of {where}", "correct the calibration"):
        pose = rigid(rotation_of_quaternion(row[-7:-3]), row[-3:])
    return CalibratedCamera(
        name, *image_size(image), checked_lens(K, "opencv", distortion, where), pose, NEAR_FAR.get(scene)
    )
