"""The calibration of a rig from its videos: moments that all cameras share, stills, a board, a distance.

What stands still needs no common clock. What moves is a witness as well where timecode, sound or a person says when the
cameras started, and where they exposed together.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.progress import progress_bar
from d2_plugin.recordings.cameras.calibrating.boards import Board, scaled_by_board
from d2_plugin.recordings.cameras.calibrating.lenses import Lenses, lenses_of
from d2_plugin.recordings.cameras.calibrating.rig import ARBITRARY, SolvedRig
from d2_plugin.recordings.cameras.calibrating.solve import solve_rig
from d2_plugin.recordings.cameras.formats import CalibratedCamera
from d2_plugin.recordings.cameras.formats.cameras_json import to_json
from d2_plugin.recordings.cameras.lens import UndistortedSource, resampled, resampling
from d2_plugin.recordings.images import opencv, read_image
from d2_plugin.recordings.importing.clocks import METHODS, Clock, common_clock, given_clock
from d2_plugin.recordings.importing.files import VideoFile
from d2_plugin.recordings.importing.grid import grid_of
from d2_plugin.recordings.importing.source import Upright
from d2_plugin.recordings.recording import Camera

MOMENTS = 8
"""Images of each camera that are looked at, spread over the recording."""

BOARD_MOMENTS = 24
"""The same where a board was filmed, which is held in many places."""

TOGETHER = 0.1
"""Frames by which cameras may expose apart for what moves to be a witness."""

IMAGES = (".png", ".jpg", ".jpeg")


class _NeedsMotion(Exception):
    """The clocks could be found by motion alone, which takes the calibration that is looked for."""


@dataclass(frozen=True)
class Evidence:
    """What a rig is solved from beside its videos, as `d2 import` takes it."""

    intrinsics: Path | None
    focal: tuple[str, ...]
    stills: Path | None
    board: str | None
    distance: tuple[str, ...] | None


def rig_of_videos(
    videos: Mapping[str, VideoFile], evidence: Evidence, offsets: tuple[str, ...]
) -> tuple[tuple[CalibratedCamera, ...], SolvedRig]:
    """(the cameras with their poses, what is known about them).

    Raises:
        D2Error: one camera, words that say nothing, or videos that do not settle the rig: what to add is said.
    """
    if len(videos) < 2:
        raise D2Error("one video says nothing about where its camera stands: give two at least, or --calibration FILE")
    board = None if evidence.board is None else Board.parsed(evidence.board)
    distance = None if evidence.distance is None else _distance(evidence.distance, list(videos))
    sizes = {name: video.turn.size(*video.size) for name, video in videos.items()}
    lenses = lenses_of(evidence.intrinsics, evidence.focal, sizes)
    stills = {} if evidence.stills is None else _stills(evidence.stills, lenses)
    images = _images(videos, lenses, offsets, MOMENTS if board is None else BOARD_MOMENTS)
    known = {name: camera.pinhole() for name, camera in lenses.cameras.items()}
    known |= {name: replace(known[taker], name=name) for name, (taker, _) in stills.items()}
    seen = {name: image for name, (_, image) in stills.items()}
    rig = solve_rig(images, known, seen, board, lenses.focal)
    if board is not None:
        rig = scaled_by_board(rig, images, board)
    if distance is not None:
        rig = rig.scaled(*distance)
    return tuple(_posed(lenses.cameras[name], rig.cameras[name]) for name in videos), rig


def calibration_table(cameras: tuple[CalibratedCamera, ...], rig: SolvedRig) -> dict[str, Any]:
    """The calibration as `--calibration` reads it, with what is known about each camera."""
    entries = to_json(cameras)
    verdicts = rig.verdicts()
    for entry in entries:
        name = entry["name"]
        degrees, share = rig.doubt[name]
        entry |= {"reprojection_error": rig.pixels[name], "points": rig.seen[name], "verdict": verdicts[name]}
        entry |= {"doubt_degrees": degrees, "doubt_share_of_rig": share}
    return {"cameras": entries, "scale": rig.scale}


def said_of(rig: SolvedRig) -> list[str]:
    """What a person should know, a line each."""
    scale = [f"scale: {rig.scale} (--distance, --board)" if rig.scale == ARBITRARY else f"scale: {rig.scale}"]
    return [*(f"camera {name}: {verdict}" for name, verdict in rig.verdicts().items()), *scale]


def _posed(camera: CalibratedCamera, found: Camera) -> CalibratedCamera:
    T = found.T_camera_world
    return replace(camera, matrix=found.K, rotation=T[:3, :3], translation=T[:3, 3])


def _distance(words: tuple[str, ...], names: list[str]) -> tuple[str, str, float]:
    try:
        one, other, metres = words
        length = float(metres)
    except ValueError:
        one, other, length = "", "", 0.0
    if one not in names or other not in names or one == other or not 0 < length < np.inf:
        raise D2Error(
            f"--distance says '{','.join(words)}', expected CAMERA,CAMERA,METRES with two of {', '.join(names)}: "
            "correct it"
        )
    return one, other, length


def _stills(folder: Path, lenses: Lenses) -> dict[str, tuple[str, np.ndarray]]:
    """Name of a still -> (camera whose lens took it, its undistorted image in that camera's size)."""
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in IMAGES) if folder.is_dir() else []
    if not paths:
        raise D2Error(f"--stills {folder} is no folder with images ({', '.join(IMAGES)}): give one")
    found = {}
    for path in paths:
        taker = _taker(path, lenses)
        found[f"still {path.stem}"] = taker, _as_taken(path, lenses.cameras[taker])
    return found


def _taker(path: Path, lenses: Lenses) -> str:
    """The camera that a still is called after; any of them where all have one lens."""
    called = [name for name in lenses.cameras if path.stem == name or path.stem.startswith((f"{name}_", f"{name}-"))]
    if called:
        return max(called, key=len)
    lenses_are_one = len({(c.width, c.height, c.matrix.tobytes(), c.distortion) for c in lenses.cameras.values()}) == 1
    if lenses_are_one and lenses.focal != "each":
        return next(iter(lenses.cameras))
    raise D2Error(
        f"still {path.name} does not say which camera took it, and their lenses differ: call it CAMERA_NUMBER, such as "
        f"{next(iter(lenses.cameras))}_1{path.suffix}"
    )


def _as_taken(path: Path, camera: CalibratedCamera) -> np.ndarray:
    """The still as a video of the same camera would show it."""
    cv2 = opencv("reading stills", "calibration")
    image, size = read_image(path), (camera.width, camera.height)
    if abs(image.shape[1] * size[1] - image.shape[0] * size[0]) > 0.01 * image.shape[0] * size[0]:
        raise D2Error(
            f"still {path.name} has {image.shape[1]}x{image.shape[0]} pixels and the video of its camera "
            f"{size[0]}x{size[1]}, another aspect: take stills in the video's mode, upright, not cropped"
        )
    same = image.shape[1::-1] == size
    image = image if same else cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return resampled(image, resampling(camera.lens, size)) if camera.lens.bends else image


def _images(
    videos: Mapping[str, VideoFile], lenses: Lenses, offsets: tuple[str, ...], moments: int
) -> dict[str, list[np.ndarray]]:
    """Undistorted images by camera: of moments that all share, or one of what stands still where none are known."""
    clocks = _clocks(videos, offsets)
    indices = _together(videos, clocks, moments) if clocks is not None else None
    chosen = indices or {name: _spread(len(video.stamps), moments) for name, video in videos.items()}
    upright = Upright(videos, {name: dict(enumerate(places)) for name, places in chosen.items()})
    bent = {name: camera.lens for name, camera in lenses.cameras.items() if camera.lens.bends}
    sizes = {name: (lenses.cameras[name].width, lenses.cameras[name].height) for name in bent}
    source = UndistortedSource(upright, bent, sizes)
    found: dict[str, list[np.ndarray]] = {}
    with progress_bar("look at the videos", sum(map(len, chosen.values()))) as bar:
        done = 0
        for name, places in chosen.items():
            found[name] = []
            for moment in range(len(places)):
                found[name].append(source.image(name, moment))
                bar.update(done := done + 1, name)
    if indices is None:
        return {name: [np.median(np.stack(taken), axis=0).astype(np.uint8)] for name, taken in found.items()}
    return found


def _clocks(videos: Mapping[str, VideoFile], offsets: tuple[str, ...]) -> Mapping[str, Clock] | None:
    """When the cameras started; None where only motion could say it, which takes a calibration."""

    def refuse() -> Any:
        raise _NeedsMotion

    watching: Callable[[], Any] = refuse
    if len(offsets) != 1 or offsets[0] not in METHODS:
        return given_clock(videos, offsets)
    try:
        return common_clock(videos, offsets[0], watching)
    except _NeedsMotion:
        return None


def _together(
    videos: Mapping[str, VideoFile], clocks: Mapping[str, Clock], moments: int
) -> dict[str, list[int]] | None:
    """Frames by camera of moments at which all exposed together; None where there are fewer than three."""
    grid = grid_of(videos, clocks)
    frames = list(next(iter(grid.indices.values())))
    apart = {
        frame: np.ptp([grid.late[name][frame] for name in videos]) * grid.rate if grid.late else 0.0 for frame in frames
    }
    together = [frame for frame in frames if apart[frame] <= TOGETHER]
    if len(together) < min(3, len(frames)):
        return None
    chosen = [together[place] for place in _spread(len(together), moments)]
    return {name: [grid.indices[name][frame] for frame in chosen] for name in videos}


def _spread(count: int, moments: int) -> list[int]:
    places: list[int] = np.unique(np.linspace(0, count - 1, moments).round().astype(int)).tolist()
    return places
