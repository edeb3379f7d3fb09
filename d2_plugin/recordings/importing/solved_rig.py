"""The calibration of a rig from its videos: moments that all cameras share, stills, a board, a distance.

What stands still needs no common clock. What moves is a witness as well where timecode, sound or a person says when the
cameras started, and where they exposed together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.progress import progress_bar
from d2_plugin.recordings.cameras.calibrating.boards import Board, scaled_by_board
from d2_plugin.recordings.cameras.calibrating.rig import ARBITRARY, SolvedRig
from d2_plugin.recordings.cameras.calibrating.solve import solve_rig
from d2_plugin.recordings.cameras.calibration import open_calibration
from d2_plugin.recordings.cameras.camera import CalibratedCamera, pinhole
from d2_plugin.recordings.cameras.formats.cameras_json import camera_table
from d2_plugin.recordings.cameras.lens import Lens
from d2_plugin.recordings.cameras.undistort import UndistortedSource, Undistortion
from d2_plugin.recordings.files import is_called
from d2_plugin.recordings.images import IMAGE_SUFFIXES, opencv, read_image
from d2_plugin.recordings.importing.clocks import METHODS, Clock, common_clock, given_clock, of_one_recorder
from d2_plugin.recordings.importing.grid import grid_of
from d2_plugin.recordings.importing.settings import ImportChoices, by_camera, finite
from d2_plugin.recordings.importing.video import VideoFile, VideoFrames
from d2_plugin.recordings.selection import spread

MOMENTS = 8  # images of each camera that are read, spread over the recording
BOARD_MOMENTS = 24  # the same where a board was filmed, which is held in many places
TOGETHER = 0.1  # frames by which cameras may expose apart for what moves to be a witness
BOARD_TOGETHER = 0.5  # the same for a board, which is held still
SQUARE = 0.01  # by how much a pixel may be wider than high, or less, and count as square
SHARED, EACH = "shared", "each"  # focal lengths that are not known: one for all cameras, or one for each of them


@dataclass(frozen=True)
class Lenses:
    """Cameras without poses, and whether their focal lengths are known, `SHARED` or `EACH` of its own."""

    cameras: dict[str, CalibratedCamera]
    focal: str | None  # None where it is known


def rig_of_videos(
    videos: Mapping[str, VideoFile], choices: ImportChoices
) -> tuple[tuple[CalibratedCamera, ...], SolvedRig]:
    """(the cameras with their poses, what is known about them).

    Raises:
        D2Error: one camera, words that say nothing, or videos that do not settle the rig, with what to add.
    """
    if len(videos) < 2:
        raise D2Error("one video says nothing about where its camera stands: give two at least, or --calibration FILE")
    for name, video in videos.items():
        if choices.intrinsics is None and abs(video.stretched - 1) > SQUARE:
            raise D2Error(
                f"the pixels of video {name} are {video.stretched:.3g} times as wide as high, and lenses are found for "
                "square ones: give --intrinsics of the stored images, or convert it (`ffmpeg -i OLD -vf "
                "scale=iw*sar:ih,setsar=1 NEW`)"
            )
    board = None if choices.board is None else Board.parsed(choices.board)
    distance = None if choices.distance is None else _distance(choices.distance, list(videos))
    lenses = _lenses(choices.intrinsics, choices.focal, {name: video.size for name, video in videos.items()})
    stills = {} if choices.stills is None else _stills(choices.stills, lenses)
    images = _images(videos, lenses, choices.offsets, board is not None)
    known = {name: camera.pinhole() for name, camera in lenses.cameras.items()}
    known |= {name: replace(known[taker], name=name) for name, (taker, _) in stills.items()}
    rig = solve_rig(images, known, {name: image for name, (_, image) in stills.items()}, board, lenses.focal)
    if board is not None:
        rig = scaled_by_board(rig, images, board)
    if distance is not None:
        rig = rig.scaled(*distance)
    solved = (replace(lenses.cameras[name], T_camera_world=rig.cameras[name].T_camera_world) for name in videos)
    return tuple(replace(one, lens=replace(one.lens, K=rig.cameras[one.name].K)) for one in solved), rig


def calibration_table(cameras: tuple[CalibratedCamera, ...], rig: SolvedRig) -> dict[str, Any]:
    """The calibration as `--calibration` reads it, with what is known about each camera."""
    verdicts, entries = rig.verdicts(), []
    for camera in cameras:
        degrees, share = rig.doubt[camera.name]
        known: dict[str, Any] = {"reprojection_error": rig.pixels[camera.name], "points": rig.seen[camera.name]}
        known |= {"verdict": verdicts[camera.name], "doubt_degrees": degrees, "doubt_share_of_rig": share}
        entries.append({**camera_table(camera), **known})
    return {"cameras": entries, "scale": rig.scale}


def summary(rig: SolvedRig) -> list[str]:
    """What a person should know, a line each."""
    scale = [f"scale: {rig.scale} (--distance, --board)" if rig.scale == ARBITRARY else f"scale: {rig.scale}"]
    return [*(f"camera {name}: {verdict}" for name, verdict in rig.verdicts().items()), *scale]


def _lenses(intrinsics: Path | None, focal: Sequence[str], sizes: Mapping[str, tuple[int, int]]) -> Lenses:
    """The lenses of cameras whose upright images have `sizes` (width, height).

    Raises:
        D2Error: two sources, a number that no lens has, cameras that are not there or of two shapes that share one.
    """
    if intrinsics is not None:
        if tuple(focal) != (SHARED,):
            raise D2Error("--intrinsics and --focal both say how the lenses are: give one of them")
        read = open_calibration(intrinsics, sizes)
        return Lenses({one.name: replace(one, T_camera_world=np.eye(4)) for one in read.cameras}, None)
    if tuple(focal) in ((SHARED,), (EACH,)):
        if focal[0] == SHARED and len(set(sizes.values())) > 1:
            raise D2Error(
                "the videos have different sizes, so their cameras share no focal length: give --focal each, pixels "
                "as --focal NAME=PIXELS,..., or --intrinsics FILE"
            )
        return Lenses({name: _ideal(name, size, float(max(size))) for name, size in sizes.items()}, focal[0])
    expected = "shared, each, a number of pixels above 0, or NAME=PIXELS"
    lengths = by_camera("--focal", focal, sizes, _positive, expected)
    missing = [name for name in sizes if name not in lengths]
    if missing:
        raise D2Error(
            f"--focal says nothing of camera {', '.join(missing)}: add NAME=PIXELS, or give one number for all"
        )
    return Lenses({name: _ideal(name, size, lengths[name]) for name, size in sizes.items()}, None)


def _ideal(name: str, size: tuple[int, int], length: float) -> CalibratedCamera:
    """A camera without distortion whose principal point is the middle of the image."""
    return CalibratedCamera(name, *size, Lens(pinhole(length, length, size[0] / 2, size[1] / 2)), np.eye(4))


def _distance(words: tuple[str, ...], names: list[str]) -> tuple[str, str, float]:
    length = _positive(words[-1])
    if len(words) != 3 or not set(words[:2]) <= set(names) or words[0] == words[1] or length is None:
        raise D2Error(
            f"--distance says '{','.join(words)}', expected CAMERA,CAMERA,METRES with two of {', '.join(names)}: "
            "correct it"
        )
    return words[0], words[1], length


def _positive(text: str) -> float | None:
    number = finite(text)
    return number if number is not None and number > 0 else None


def _stills(folder: Path, lenses: Lenses) -> dict[str, tuple[str, np.ndarray]]:
    """Name of a still -> (camera whose lens took it, its undistorted image in that camera's size)."""
    inside = sorted(folder.iterdir()) if folder.is_dir() else []
    paths = [path for path in inside if is_called(path)]
    if not paths:
        raise D2Error(f"--stills {folder} is no folder with images ({', '.join(IMAGE_SUFFIXES)}): give one")
    stills = {}
    for path in paths:
        taker = _taker(path, lenses)
        stills[f"still {path.stem}"] = taker, _as_taken(path, lenses.cameras[taker])
    return stills


def _taker(path: Path, lenses: Lenses) -> str:
    """The camera that a still is called after; any of them where all have one lens."""
    called = [name for name in lenses.cameras if path.stem == name or path.stem.startswith((f"{name}_", f"{name}-"))]
    if called:
        return max(called, key=len)
    lenses_are_one = len({(c.size, c.lens.K.tobytes(), c.lens.distortion) for c in lenses.cameras.values()}) == 1
    if lenses_are_one and lenses.focal != "each":
        return next(iter(lenses.cameras))
    raise D2Error(
        f"still {path.name} does not say which camera took it, and their lenses differ: call it CAMERA_NUMBER, such as "
        f"{next(iter(lenses.cameras))}_1{path.suffix}"
    )


def _as_taken(path: Path, camera: CalibratedCamera) -> np.ndarray:
    cv2 = opencv("reading stills", "calibration")
    image, size = read_image(path), camera.size
    if abs(image.shape[1] * size[1] - image.shape[0] * size[0]) > 0.01 * image.shape[0] * size[0]:
        raise D2Error(
            f"still {path.name} has {image.shape[1]}x{image.shape[0]} pixels and the video of its camera "
            f"{size[0]}x{size[1]}, another aspect: take stills in the video's mode, upright, not cropped"
        )
    if image.shape[1::-1] != size:
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return Undistortion(camera).image(image)


def _images(
    videos: Mapping[str, VideoFile], lenses: Lenses, offsets: tuple[str, ...], board: bool
) -> dict[str, list[np.ndarray]]:
    """Undistorted images by camera: of moments that all share, or one of what stands still where none are known.

    Raises:
        D2Error: a `board`, and nothing says which images show it at the same moment.
    """
    moments = BOARD_MOMENTS if board else MOMENTS
    known = len(offsets) == 1 and offsets[0] in METHODS
    clocks = common_clock(videos, offsets[0], None) if known else given_clock(videos, offsets)
    if board and not clocks and of_one_recorder(videos.values()):
        clocks = given_clock(videos, ())
    indices = _together(videos, clocks, moments, BOARD_TOGETHER if board else TOGETHER) if clocks else None
    if board and indices is None:
        raise D2Error(
            "--board is matched at moments that all cameras share, and neither timecode nor sound says which these "
            "are: give --offsets NAME=FRAMES,..., or none where the cameras started together"
        )
    chosen = indices or {name: spread(range(len(video.stamps)), moments) for name, video in videos.items()}
    frames = VideoFrames(videos, {name: dict(enumerate(places)) for name, places in chosen.items()})
    source = UndistortedSource(frames, {name: one for name, one in lenses.cameras.items() if one.lens.bends})
    images: dict[str, list[np.ndarray]] = {}
    with progress_bar("decode the videos", sum(map(len, chosen.values()))) as bar:
        done = 0
        for name, places in chosen.items():
            images[name] = []
            for moment in range(len(places)):
                images[name].append(source.image(name, moment))
                bar.update(done := done + 1, name)
    if indices is None:
        return {name: [np.median(np.stack(taken), axis=0).astype(np.uint8)] for name, taken in images.items()}
    return images


def _together(
    videos: Mapping[str, VideoFile], clocks: Mapping[str, Clock], moments: int, reach: float
) -> dict[str, list[int]] | None:
    """Frames by camera of moments at which all exposed within `reach` of a frame; None where fewer than three are."""
    grid = grid_of(videos, clocks)
    frames = list(next(iter(grid.indices.values())))
    apart = {
        frame: np.ptp([grid.late[name][frame] for name in videos]) * grid.rate if grid.late else 0.0 for frame in frames
    }
    together = [frame for frame in frames if apart[frame] <= reach]
    if len(together) < min(3, len(frames)):
        return None
    chosen = spread(together, moments)
    return {name: [grid.indices[name][frame] for frame in chosen] for name in videos}
