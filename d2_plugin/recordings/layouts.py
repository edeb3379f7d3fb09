"""The layouts that can be read, in one table, and `open_recording`, which finds the right one."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, Optional

from d2_plugin.errors import D2Error, unknown_name
from d2_plugin.reading import reaching
from d2_plugin.recordings.cameras.formats.easymocap import INTRINSICS
from d2_plugin.recordings.importing.video import videos_below
from d2_plugin.recordings.readers.colmap import is_colmap, open_colmap
from d2_plugin.recordings.readers.enerf import open_enerf
from d2_plugin.recordings.readers.folder import CALIBRATION, is_folder, open_folder
from d2_plugin.recordings.readers.n3dv import POSES, open_n3dv
from d2_plugin.recordings.readers.technicolor import PARAMETERS, open_technicolor
from d2_plugin.recordings.readers.transforms_json import FILES, open_transforms
from d2_plugin.recordings.readers.videos import TABLE, open_videos
from d2_plugin.recordings.recording import Recording
from d2_plugin.recordings.selection import downscale as downscaled
from d2_plugin.recordings.selection import select_frames
from d2_plugin.values import checked_arguments

Reader = Callable[[Path, Optional[tuple[str, ...]], bool], Recording]  # noqa: UP045  at run time, on Python 3.9 too
"""(folder, cameras to read or None, whether to leave out cameras without counterpart) -> recording."""


class Layout(NamedTuple):
    """One layout of recordings."""

    recognised: Callable[[Path], bool]  # whether a folder looks like this layout; it only asks which files are there
    open: Reader


def _holds(*names: str) -> Callable[[Path], bool]:
    return lambda folder: any((folder / name).is_file() for name in names)


LAYOUTS: dict[str, Layout] = {
    "folder": Layout(is_folder, open_folder),
    "videos": Layout(_holds(TABLE), open_videos),
    "n3dv": Layout(_holds(POSES), open_n3dv),
    "technicolor": Layout(_holds(PARAMETERS), open_technicolor),
    "enerf": Layout(_holds(INTRINSICS), open_enerf),
    "transforms": Layout(_holds(*FILES), open_transforms),
    "colmap": Layout(is_colmap, open_colmap),
}
"""By name, in the order in which a folder is tried. A new layout is one module in readers/ and one row here."""


@checked_arguments
def open_recording(
    path: Path | str,
    *,
    cameras: Iterable[str] | None = None,
    frames: Iterable[int] | None = None,
    downscale: int = 1,
    layout: str | None = None,
    intersect: bool = False,
) -> Recording:
    """Open the recording in `path`; images are read when asked for.

    Args:
        path: a folder in one of the layouts of `LAYOUTS`, which docs/recordings.md describes. The first that fits is
            taken.
        cameras: names to read, in this order; all of them otherwise. Only those read are checked.
        frames: frame numbers to read; all that every camera has otherwise.
        downscale: every block of this many by this many pixels becomes one.
        layout: read `path` in this layout whatever else it holds.
        intersect: leave out, with a note, cameras with images but no calibration or the other way round.

    Raises:
        D2Error: one sentence for anything that is missing or contradicts itself.
    """
    folder = Path(path)
    if layout is not None and layout not in LAYOUTS:
        raise unknown_name("layout", layout, LAYOUTS)
    with reaching(folder, "make the folder readable"):
        layout = layout or _recognised(folder)
    names = None if cameras is None else tuple(cameras)
    if names is not None and len(set(names)) < max(len(names), 1):
        raise D2Error(f"camera names '{', '.join(names)}' are empty or repeated: name each camera once")
    with reaching(folder, "make the folder readable"):
        recording = replace(LAYOUTS[layout].open(folder, names, intersect), layout=layout)
    if frames is not None:
        recording = select_frames(recording, frames)
    return downscaled(recording, downscale)


def _recognised(folder: Path) -> str:
    if not folder.is_dir():
        raise D2Error(f"no such recording: {folder} is not a folder; give the folder that holds the recording")
    for name, layout in LAYOUTS.items():
        if layout.recognised(folder):
            return name
    if videos_below(folder):
        raise D2Error(
            f"{folder} holds videos and no calibration that goes with them: make a recording of them with `d2 import`, "
            "or give `d2 train` the --calibration FILE"
        )
    missing = [part for part in (CALIBRATION, "images") if not (folder / part).exists()]
    half = f", as it has no {missing[0]}" if len(missing) == 1 else ""
    others = ", ".join(name for name in LAYOUTS if name != "folder")
    raise D2Error(
        f"{folder} is no recording{half}: expected {CALIBRATION} and images/<camera>/<frame>.png, or the files of "
        f"another layout ({others}; see docs/recordings.md)"
    )
