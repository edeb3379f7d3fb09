"""Readers of recordings into one `Capture`."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

from d2_plugin.captures.capture import Camera, Capture, MonoKind, Source
from d2_plugin.captures.readers.colmap import open_colmap
from d2_plugin.captures.readers.colmap_model import find_model
from d2_plugin.captures.readers.enerf import open_enerf
from d2_plugin.captures.readers.folder import open_folder
from d2_plugin.captures.readers.n3dv import open_n3dv
from d2_plugin.captures.readers.technicolor import PARAMETERS as TECHNICOLOR_FILE
from d2_plugin.captures.readers.technicolor import open_technicolor
from d2_plugin.captures.readers.transforms_json import FILES as TRANSFORMS_FILES
from d2_plugin.captures.readers.transforms_json import open_transforms
from d2_plugin.captures.selection import downscale as _downscale
from d2_plugin.captures.selection import select_cameras, select_frames
from d2_plugin.errors import D2Error, unknown_name

__all__ = ["LAYOUTS", "Camera", "Capture", "MonoKind", "Source", "open_capture", "select_cameras", "select_frames"]

Reader = Callable[[Path, tuple[str, ...] | None, bool], Capture]
"""(folder, cameras to read or None, whether to leave out cameras without counterpart) -> capture."""

LAYOUTS: dict[str, Reader] = {
    "folder": open_folder,
    "n3dv": lambda path, cameras, _: open_n3dv(path, cameras),
    "technicolor": open_technicolor,
    "enerf": open_enerf,
    "transforms": open_transforms,
    "colmap": open_colmap,
}
"""Readers by the name of what they read; a folder that fits several is read as the first of them."""


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
        path: a folder in one of the layouts `folder` (cameras.json, images/), `n3dv` (poses_bounds.npy and videos or
            extracted frames), `technicolor` (cameras_parameters.txt), `enerf` (intri.yml, extri.yml), `transforms`
            (transforms.json or transforms_train.json) and `colmap` (sparse/0, images/); see docs/captures.md. The
            first that fits is taken.
        cameras: names to read, in this order; all of them otherwise. Only those read are checked.
        frames: frame numbers to read; all that every camera has otherwise.
        downscale: every block of this many by this many pixels becomes one.
        layout: read `path` in this layout whatever else it holds.
        intersect: leave out, with a note, cameras with pictures but no calibration or the other way round.

    Raises:
        D2Error: one sentence for anything that is missing or contradicts itself.
    """
    folder = Path(path)
    if layout is not None and layout not in LAYOUTS:
        raise unknown_name("layout", layout, LAYOUTS)
    layout = layout or _recognised(folder)
    names = None if cameras is None else tuple(cameras)
    if names is not None and len(set(names)) < max(len(names), 1):
        raise D2Error(f"camera names '{', '.join(names)}' are empty or repeated: name each camera once")
    capture = replace(LAYOUTS[layout](folder, names, intersect), layout=layout)
    if frames is not None:
        capture = select_frames(capture, frames)
    return _downscale(capture, downscale)


def _recognised(folder: Path) -> str:
    if not folder.is_dir():
        raise D2Error(f"no such capture: {folder} is not a folder; give the folder that holds the recording")
    calibrated, pictures = (folder / "cameras.json").is_file(), (folder / "images").is_dir()
    signs = {
        "folder": calibrated and pictures,
        "n3dv": (folder / "poses_bounds.npy").is_file(),
        "technicolor": (folder / TECHNICOLOR_FILE).is_file(),
        "enerf": (folder / "intri.yml").is_file(),
        "transforms": any((folder / name).is_file() for name in TRANSFORMS_FILES),
        "colmap": find_model(folder) is not None,
    }
    for layout, found in signs.items():
        if found:
            return layout
    if calibrated:
        raise D2Error(f"{folder} has cameras.json but no folder images: put pictures at images/<camera>/<frame>.png")
    if pictures:
        raise D2Error(f"{folder} has images but no cameras.json: write the calibration of every camera there")
    raise D2Error(
        f"{folder} is no capture: expected cameras.json and images/<camera>/<frame>.png, or the files of another "
        f"layout ({', '.join(list(LAYOUTS)[1:])}; see docs/captures.md)"
    )
