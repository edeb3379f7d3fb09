"""ENeRF-Outdoor and other recordings of EasyMocap and EasyVolcap: intri.yml and extri.yml beside images/<camera>/.

How the two files are read is in `d2_plugin.recordings.cameras.formats.easymocap`.
"""

from __future__ import annotations

from pathlib import Path

from d2_plugin.recordings.assembly import assembled
from d2_plugin.recordings.cameras.formats.easymocap import EXTRINSICS, INTRINSICS, read_rig
from d2_plugin.recordings.files import camera_folders, cameras_with_images, common_frames, numbered_files
from d2_plugin.recordings.images import image_size
from d2_plugin.recordings.recording import Recording

ENERF_FPS = 60.0  # frame rate at which EasyVolcap plays the data set; the files name none
NOT_USED = ("bkgd", "vhull", "background.ply")  # what recordings of this layout may also hold


def open_enerf(path: Path, cameras: tuple[str, ...] | None = None, intersect: bool = False) -> Recording:
    """Read the layout of EasyMocap and EasyVolcap; of the images only headers are opened.

    The published files name cameras of which only some have a pose or images: the others are left out with a note,
    whatever `intersect` says. A camera that is asked for by name must have all three.
    """
    calibrated = {camera.name: camera for camera in read_rig(path)}
    folders = camera_folders(path / "images")
    names, notes = cameras_with_images(sorted(calibrated), folders, cameras, True, path / EXTRINSICS)
    images = {name: numbered_files(folders[name]) for name in names}
    frames, frame_notes = common_frames(images, path / "images")
    where = f"{path / INTRINSICS} and {EXTRINSICS}"
    sized = {name: calibrated[name].of_size(image_size(images[name][frames[0]]), where) for name in names}
    unused = [name for name in NOT_USED if (path / name).exists()]
    more = (f"not used: {', '.join(unused)}",) if unused else ()
    return assembled(path, sized, images, frames, ENERF_FPS, where, (*notes, *frame_notes, *more))
