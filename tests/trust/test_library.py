"""The library in the hands of somebody who gives the wrong thing: one sentence with what was expected and got."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from d2_plugin.config import D2Config
from d2_plugin.errors import D2Error
from d2_plugin.recordings import Recording, open_recording, select_cameras, select_frames
from d2_plugin.recordings.cameras.calibrating import Board, refine, scaled_by_board, solve_rig
from d2_plugin.recordings.cameras.calibration import read_calibration
from d2_plugin.recordings.cameras.camera import scaled
from d2_plugin.recordings.cameras.undistort import Undistortion
from d2_plugin.recordings.export.export import export_recording
from d2_plugin.recordings.export.folder import described, save_recording
from d2_plugin.recordings.importing.importing import import_videos
from d2_plugin.recordings.synthetic.room import synthetic_recording
from d2_plugin.runs.run import Run
from d2_plugin.store.store import PriorStore
from d2_plugin.values import checked_arguments
from d2_plugin.viewing.checkpoints import open_viewed, read_ply
from d2_plugin.viewing.videos.video import write_video

pytest.importorskip("cv2", reason="opencv is in the `image` extra")

WRONG: tuple[Any, ...] = (None, 5, 1.5, math.nan, True, b"x", "", "\0", "/nope", ["a", 5], {"a": 1}, object(), 10**30)
IMAGE = np.zeros((48, 64, 3), np.uint8)

Call = Callable[[Any], object]


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    recording = synthetic_recording(cameras=2, held_out=0, frames=2, width=64, height=48)
    path = save_recording(recording, tmp_path_factory.mktemp("library") / "room")
    (path / "calibration.json").write_text(json.dumps(described(recording)))
    return path


def as_a_path(path: Path) -> dict[str, Call]:
    """What takes the place of a file or folder."""
    return {
        "open_recording": open_recording,
        "read_calibration": read_calibration,
        "PriorStore.open": PriorStore.open,
        "D2Config.from_toml": D2Config.from_toml,
        "Run.load": Run.load,
        "open_viewed": open_viewed,
        "read_ply": read_ply,
    }


def of_a_recording(path: Path, recording: Recording) -> dict[str, Call]:
    """What stands for a recording, its cameras, frames and sizes."""
    (first, *_) = read_calibration(path / "calibration.json")
    folder = path.parent / "never"
    return {
        "cameras": lambda wrong: open_recording(path, cameras=wrong if wrong is not None else "train0"),
        "frames": lambda wrong: open_recording(path, frames=wrong if wrong is not None else "01"),
        "downscale": lambda wrong: open_recording(path, downscale=0 if wrong == 5 else wrong),
        "layout": lambda wrong: open_recording(path, layout=wrong or "x"),
        "select_cameras": lambda wrong: select_cameras(recording, wrong),
        "select_frames": lambda wrong: select_frames(recording, wrong),
        "a camera's image": lambda wrong: recording.image(wrong, 0),
        "a frame's image": lambda wrong: recording.image("train0", "0" if wrong is True or wrong == 5 else wrong),
        "sizes": lambda wrong: read_calibration(path / "calibration.json", wrong if wrong is not None else {}),
        "scaled": lambda wrong: scaled([first], -1 if wrong in (5, 1.5) else wrong),
        "Undistortion": Undistortion,
        "an undistorted image": Undistortion(first).image,
        "columns of a board": lambda wrong: Board(2 if wrong == 5 else wrong, 5, 0.04),
        "a board's image": Board(7, 5, 0.04).corners,
        "scaled_by_board": lambda wrong: scaled_by_board(wrong, {}, Board(7, 5, 0.04)),
        "refine": refine,
        "solve_rig": lambda wrong: solve_rig(wrong, {}),
        "intrinsics": lambda wrong: solve_rig({"train0": [IMAGE]}, wrong),
        "import_videos": import_videos,
        "save_recording": lambda wrong: save_recording(wrong, folder),
        "export_recording": lambda wrong: export_recording(wrong, "transforms", folder),
        "held out": lambda wrong: export_recording(recording, "n3dv", folder, test_cameras=wrong),
    }


def refused(call: Call, wrong: Any) -> str:
    """What is wrong with the way in which a call was refused; nothing where one sentence said why."""
    try:
        call(wrong)
    except D2Error as error:
        return "" if "\n" not in str(error) and len(str(error)) < 1000 else str(error)
    except Exception as error:  # whatever else is raised is what is looked for
        return repr(error)
    return "accepted"


def test_what_is_no_path(room: Path) -> None:
    found = {(name, str(w)): refused(call, w) for name, call in as_a_path(room).items() for w in WRONG}
    assert {case: why for case, why in found.items() if why} == {}


def test_what_is_no_recording_camera_frame_or_image(room: Path) -> None:
    calls = of_a_recording(room, open_recording(room))
    found = {(name, str(w)): refused(call, w) for name, call in calls.items() for w in WRONG}
    assert {case: why for case, why in found.items() if why} == {}


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"columns": 10**9, "rows": 10**9, "square": 0.04, "marker": 0.03}, "Board.columns must be at least 3 and at"),
        ({"columns": 7, "rows": 5, "square": math.nan}, "Board.square must be above 0"),
        ({"columns": 7, "rows": 5, "square": 0.04, "marker": 0.05}, "expected smaller markers"),
        ({"columns": 7, "rows": 5, "square": 0.04, "marker": 0.03, "dictionary": "4X4"}, "unknown marker dictionary"),
        ({"columns": 7, "rows": 5, "square": 0.04, "marker": 0.03, "dictionary": "DICT_"}, "unknown marker dictionary"),
        ({"columns": 40, "rows": 50, "square": 0.04, "marker": 0.03}, "has 1000 markers and DICT_4X4_50 has 50"),
    ],
)
def test_a_board_that_cannot_be(values: dict[str, Any], says: str) -> None:
    with pytest.raises(D2Error, match=says):
        Board(**values).corners(IMAGE)


@pytest.mark.parametrize("image", [IMAGE.astype(float), IMAGE[..., 0], IMAGE[:0], np.zeros((4, 4, 4), np.uint8)])
def test_what_is_no_image(image: np.ndarray, tmp_path: Path) -> None:
    pytest.importorskip("av")
    with pytest.raises(D2Error, match=r"expected RGB uint8 \[H, W, 3\]"):
        Board(7, 5, 0.04).corners(image)
    with (
        pytest.raises(D2Error, match=r"expected RGB uint8 \[H, W, 3\]"),
        write_video(tmp_path / "a.mp4", "mp4", 24) as add,
    ):
        add(image)
    assert not list(tmp_path.iterdir())


def test_arguments_become_what_is_declared() -> None:
    @checked_arguments
    def call(names: list[str], count: int = 1, share: float = 0.5, place: Path = Path()) -> tuple:
        return names, count, share, place

    assert call(["a"], np.int64(3), 1, "x") == (["a"], 3, 1.0, Path("x"))
    with pytest.raises(D2Error, match=r"names of .*call must be .*, got 'abc'"):
        call("abc")
    with pytest.raises(D2Error, match=r"count of .*call must be a whole number, got 1.5"):
        call(["a"], 1.5)
