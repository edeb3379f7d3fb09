"""Readers of recordings into one `Capture`."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from d2_plugin.captures.capture import Camera, Capture, MonoKind, Source
from d2_plugin.captures.folder import open_folder
from d2_plugin.captures.n3dv import open_n3dv
from d2_plugin.captures.transforms import downscale as _downscale
from d2_plugin.captures.transforms import select_cameras, select_frames
from d2_plugin.errors import D2Error, unknown_name

__all__ = ["Camera", "Capture", "MonoKind", "Source", "open_capture", "select_cameras", "select_frames"]

LAYOUTS = ("folder", "n3dv")


def open_capture(
    path: Path | str,
    *,
    cameras: Iterable[str] | None = None,
    frames: Iterable[int] | None = None,
    downscale: int = 1,
    layout: str | None = None,
    intersect: bool = False,
) -> Capture:
    """Open the recording in `path`; pictures are read when asked for.

    Args:
        path: a folder in one of the layouts `folder` (cameras.json, images/) or `n3dv` (poses_bounds.npy and videos or
            extracted frames); one that holds both is read as `folder`.
        cameras: names to read, in this order; all of them otherwise. Only those read are checked.
        frames: frame numbers to read; all that every camera has otherwise.
        downscale: every block of this many by this many pixels becomes one.
        layout: read `path` in this layout whatever else it holds.
        intersect: leave out, with a note, cameras with pictures but no calibration or the other way round.

    Raises:
        D2Error: one sentence for anything that is missing or contradicts itself.
    """
    folder = Path(path)
    layout = layout or _recognised(folder)
    names = None if cameras is None else tuple(cameras)
    if names is not None and len(set(names)) < max(len(names), 1):
        raise D2Error(f"camera names '{', '.join(names)}' are empty or repeated: name each camera once")
    if layout == "folder":
        capture = open_folder(folder, names, intersect)
    elif layout == "n3dv":
        capture = open_n3dv(folder, names)
    else:
        raise unknown_name("layout", layout, LAYOUTS)
    if frames is not None:
        capture = select_frames(capture, frames)
    return _downscale(capture, downscale)


def _recognised(folder: Path) -> str:
    if not folder.is_dir():
        raise D2Error(f"no such capture: {folder} is not a folder; give the folder that holds the recording")
    calibrated, pictures = (folder / "cameras.json").is_file(), (folder / "images").is_dir()
    if calibrated and pictures:
        return "folder"
    if (folder / "poses_bounds.npy").is_file():
        return "n3dv"
    if calibrated:
        raise D2Error(f"{folder} has cameras.json but no folder images: put pictures at images/<camera>/<frame>.png")
    if pictures:
        raise D2Error(f"{folder} has images but no cameras.json: write the calibration of every camera there")
    raise D2Error(
        f"{folder} is no capture: expected cameras.json and images/<camera>/<frame>.png, or poses_bounds.npy and "
        "camXX.mp4"
    )
