"""Doors that a hostile or unlucky user found: one sentence each, in bounded time, and nothing of theirs is touched."""

import contextlib
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from refusals import refuses

from d2_plugin.cache import Untrusted, cache_folder, check_private
from d2_plugin.commands import cli
from d2_plugin.commands.cli import main
from d2_plugin.config import D2Config
from d2_plugin.errors import D2Error
from d2_plugin.priors.declared_error import held_against_truth
from d2_plugin.priors.sheet import contact_sheet
from d2_plugin.recordings import Recording, open_recording, select_cameras, select_frames
from d2_plugin.recordings.cameras.calibrating import Board, refine, scaled_by_board, solve_rig
from d2_plugin.recordings.cameras.calibration import open_calibration
from d2_plugin.recordings.cameras.camera import scaled
from d2_plugin.recordings.cameras.formats.document import Document
from d2_plugin.recordings.cameras.undistort import Undistortion
from d2_plugin.recordings.export.export import export_recording
from d2_plugin.recordings.export.folder import save_recording
from d2_plugin.recordings.importing.importing import import_videos
from d2_plugin.recordings.importing.settings import by_camera, finite
from d2_plugin.recordings.importing.video import videos_below
from d2_plugin.recordings.synthetic.room import synthetic_recording
from d2_plugin.runs.run import Run
from d2_plugin.store.store import PriorStore
from d2_plugin.values import checked_arguments
from d2_plugin.viewing.checkpoints import open_viewed, read_ply
from d2_plugin.viewing.videos.video import write_video

pytest.importorskip("cv2", reason="opencv is in the `image` extra")


Refused = Callable[..., str]


def test_a_mistyped_prior_is_not_built_nor_nothing_compared(small: Path, tmp_path: Path, refused: Refused) -> None:
    words = ["train", small, "--train-cameras", "cam00,cam01", "--output", tmp_path / "run"]
    assert "no depth priors at" in refused(*words, "--priors", tmp_path / "typo")
    assert "no run is given" in refused("compare", "")
    assert not list(tmp_path.iterdir())


def test_nothing_is_written_inside_the_images_of_a_recording(small: Path, tmp_path: Path, refused: Refused) -> None:
    (tmp_path / "room").symlink_to(small)
    images = small / "images"
    before = {path: path.stat().st_mtime_ns for path in images.rglob("*")}
    for place in (images, images / "cam00", images / "zz", tmp_path / "room" / "images" / "zz" / "deeper"):
        of_two, run = ["--train-cameras", "cam00,cam01"], tmp_path / "run"
        for words in (
            ["train", small, *of_two], ["priors", small, *of_two], ["ablate", small, *of_two], ["demo"],
            ["report", run], ["export", run], ["export", run, "--format", "ply"], ["render", run],
            ["export-recording", small, "--format", "n3dv"], ["import", run, "--calibration", "x"],
            ["bench", "training", f"{small}@cam00+cam01"],
        ):  # fmt: skip
            assert "where every folder is a camera" in refused(*words, "--output", place)
        assert "where every folder is a camera" in refused("compare", run, "--page", place / "deep.html")
        refuses("where every folder is a camera", PriorStore.create, place, ["a"], [0], {})
    assert {path: path.stat().st_mtime_ns for path in images.rglob("*")} == before


@pytest.mark.parametrize(
    "text",
    [
        "a: " + "[" * 10_000,
        "a: [" + "1," * 3_000_000 + "1]",
        "\n" * 1_000_000 + "a: 1",
        "a." * 100_000 + "a = 1",
        "[" + "a." * 100_000 + "a]",
        "x = {" + "a." * 100_000 + "a = 1}",
        '{"a": 1,' + ",".join(f'"k{i}": 1' for i in range(100_000)) + ',"k99999": 1}',
    ],
    ids=["lists in lists", "a long list", "empty lines", "a key", "a table", "an inline table", "a name twice"],
)
def test_no_text_takes_long(tmp_path: Path, text: str) -> None:
    (tmp_path / "rig.yml").write_text(text)
    start = time.process_time()
    with contextlib.suppress(D2Error):
        assert Document(tmp_path / "rig.yml").content == {"a": "1"}
    assert time.process_time() - start < 20


@pytest.mark.parametrize("text", ["a: 1\n---\nb: 2\n", "a: 1\n? [x, y]\n: c\n", "a: &x 1\nb: *x\n"])
def test_yaml_that_no_calibration_needs_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "rig.yml").write_text(text)
    with pytest.raises(D2Error):
        _ = Document(tmp_path / "rig.yml").content


def test_a_sentence_that_repeats_a_damaged_file_is_short(tmp_path: Path) -> None:
    camera = (
        f"camera_model: pinhole\n  distortion_model: {'x' * 9000}\n  intrinsics: [9, 9, 9, 9]\n  resolution: [9, 9]"
    )
    (tmp_path / "camchain.yaml").write_text(f"cam0:\n  {camera}\n")
    with pytest.raises(D2Error) as refusal:
        open_calibration(tmp_path / "camchain.yaml")
    assert len(str(refusal.value)) < 1300
    assert str(refusal.value).endswith("calibrate it with Kalibr's pinhole-equi or pinhole-radtan")


def test_a_cache_that_cannot_be_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("D2_CACHE", "~no-user-of-this-name/x")
    refuses("there is no home folder of ~no-user", cache_folder)
    with pytest.raises(Untrusted, match="/dev/null is no folder: set D2_CACHE") as refusal:
        check_private(Path("/dev/null"))
    assert "delete" not in str(refusal.value)


def test_links_in_a_circle_pipes_and_devices_are_one_sentence(small: Path, tmp_path, refused: Refused) -> None:
    pytest.importorskip("av")
    (tmp_path / "videos").mkdir()
    loop, video = tmp_path / "loop", tmp_path / "videos" / "cam00.mp4"
    loop.symlink_to(loop)
    calibration = ["--calibration", small / "cameras.json"]
    for place in (lambda: video.symlink_to(loop), lambda: os.mkfifo(video), lambda: video.symlink_to("/dev/zero")):
        place()
        refused("import", tmp_path / "videos", *calibration, "--output", tmp_path / "out")
        video.unlink()
    refused("import", tmp_path / "loop", *calibration, "--output", tmp_path / "out")
    refused("train", small, "--train-cameras", "cam00", "--output", tmp_path / "loop")
    refused("export-recording", small, "--format", "n3dv", "--output", tmp_path / "loop")


def test_what_a_folder_of_videos_leaves_out_is_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for name in ("a.mp4", "b.ts", "c.gif", "d.sdp", "e.txt"):
        (tmp_path / name).write_text("")
    assert [path.name for path in videos_below(tmp_path)] == ["a.mp4", "b.ts"]
    assert "c.gif, d.sdp left out" in caplog.text


def test_a_camera_that_is_named_twice_is_refused() -> None:
    with pytest.raises(D2Error, match="--offsets names camera 'a' twice"):
        by_camera("--offsets", ["a=0", "a=1"], ["a", "b"], finite, "NAME=FRAMES")
    assert by_camera("--offsets", ["0", "a=1"], ["a", "b"], finite, "NAME=FRAMES") == {"a": 1.0, "b": 0.0}


def command(*words: object, before: str = "") -> subprocess.CompletedProcess[str]:
    """`d2` in a process of its own, after some code."""
    code = f"import sys\n{before}\nfrom d2_plugin.__main__ import main\nsys.exit(main())"
    line = [sys.executable, "-c", code, *map(str, words)]
    return subprocess.run(line, capture_output=True, text=True, timeout=300, check=False)


@pytest.mark.skipif(os.name == "nt", reason="file descriptors as POSIX has them")
def test_closed_streams_are_no_fault_and_no_file_takes_their_place(tmp_path: Path) -> None:
    seen = tmp_path / "seen"
    look = f"import atexit, os\natexit.register(lambda: open({str(seen)!r}, 'w').write(os.readlink('/proc/self/fd/1')))"
    close = "import os\nos.close(1)\nsys.stdout = sys.__stdout__ = None\n"
    ended = command("no-such-command", before=close + look)
    assert ended.returncode == 2
    assert ended.stderr.startswith("d2: ")
    assert len(ended.stderr.splitlines()) == 1
    if Path("/proc/self/fd").is_dir():
        assert seen.read_text() == "/dev/null"


STOPPED = "d2: stopped: continue with the same command\n"

INTERRUPTED = """
import importlib.abc, signal
signal.signal(signal.SIGINT, signal.default_int_handler)
class Stops(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name == "d2_plugin.commands.arguments.form":
            signal.raise_signal(signal.SIGINT)
sys.meta_path.insert(0, Stops())
"""


def test_ctrl_c_while_the_first_modules_are_imported_is_one_sentence() -> None:
    ended = command("--help", before=INTERRUPTED)
    assert (ended.returncode, ended.stderr) == (130, STOPPED)


@pytest.fixture
def in_a_terminal() -> Iterator[None]:
    """Ctrl-C as a terminal has it: a shell's background job, and what nohup starts, begin with it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("in_a_terminal")
def test_an_error_that_a_library_makes_of_ctrl_c_is_ctrl_c(monkeypatch, capsys: pytest.CaptureFixture[str]) -> None:
    def answer(words: list[str]) -> str:
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            raise AttributeError("module 'numpy' has no attribute 'logical_or'") from None
        return ""

    monkeypatch.setattr(cli, "_answer", answer)
    assert main(["plan"]) == 130
    assert capsys.readouterr().err == STOPPED
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_database_of_colmap_that_cannot_be_written_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pycolmap")
    from d2_plugin.priors.colmap import points

    def full(*_: object) -> None:
        raise RuntimeError("No registered database factory succeeded.")

    monkeypatch.setattr(points, "_triangulated", full)
    room = synthetic_recording(cameras=2, held_out=0, frames=1, width=96, height=54, arc_degrees=15)
    images = [room.image(name, 0) for name in room.cameras]
    refuses("COLMAP cannot triangulate in .* TMPDIR", points.triangulate, images, list(room.cameras.values()))


WRONG: tuple[Any, ...] = (None, 5, 1.5, math.nan, True, b"x", "", "\0", "/nope", ["a", 5], {"a": 1}, object(), 10**30)

IMAGE = np.zeros((48, 64, 3), np.uint8)

Call = Callable[[Any], object]

TAKE_A_PATH = (open_recording, open_calibration, PriorStore.open, D2Config.from_toml, Run.load, open_viewed, read_ply)


def of_a_recording(path: Path, recording: Recording) -> dict[str, Call]:
    """What stands for a recording, its cameras, frames and sizes."""
    calibration = path / "cameras.json"
    (first, *_) = open_calibration(calibration).cameras
    folder = path.parent / "never"
    store = PriorStore(folder, ["cam00"], [0], {})
    return {
        "cameras": lambda wrong: open_recording(path, cameras=wrong if wrong is not None else "cam00"),
        "frames": lambda wrong: open_recording(path, frames=wrong if wrong is not None else "01"),
        "downscale": lambda wrong: open_recording(path, downscale=0 if wrong == 5 else wrong),
        "layout": lambda wrong: open_recording(path, layout=wrong or "x"),
        "select_cameras": lambda wrong: select_cameras(recording, wrong),
        "select_frames": lambda wrong: select_frames(recording, wrong),
        "a camera's image": lambda wrong: recording.image(wrong, 0),
        "a frame's image": lambda wrong: recording.image("cam00", "0" if wrong is True or wrong == 5 else wrong),
        "sizes": lambda wrong: open_calibration(calibration, wrong if wrong is not None else {}),
        "scaled": lambda wrong: scaled([first], -1 if wrong in (5, 1.5) else wrong),
        "Undistortion": Undistortion,
        "an undistorted image": Undistortion(first).image,
        "columns of a board": lambda wrong: Board(2 if wrong == 5 else wrong, 5, 0.04),
        "a board's image": Board(7, 5, 0.04).corners,
        "scaled_by_board": lambda wrong: scaled_by_board(wrong, {}, Board(7, 5, 0.04)),
        "refine": refine,
        "solve_rig": lambda wrong: solve_rig(wrong, {}),
        "intrinsics": lambda wrong: solve_rig({"cam00": [IMAGE]}, wrong),
        "import_videos": import_videos,
        "save_recording": lambda wrong: save_recording(wrong, folder),
        "export_recording": lambda wrong: export_recording(wrong, "transforms", folder),
        "a store's sheet": lambda wrong: contact_sheet(wrong, recording, folder),
        "a recording's sheet": lambda wrong: contact_sheet(store, wrong, folder),
        "a store's errors": lambda wrong: held_against_truth(wrong, recording),
        "a recording's errors": lambda wrong: held_against_truth(store, wrong),
        "held out": lambda wrong: export_recording(recording, "n3dv", folder, test_cameras=wrong),
    }


def answer(call: Call, wrong: Any) -> str:
    """What is wrong with the way in which a call was refused; nothing where one sentence said why."""
    try:
        call(wrong)
    except D2Error as error:
        return "" if "\n" not in str(error) and len(str(error)) < 1000 else str(error)
    except Exception as error:  # whatever else is raised is what is looked for
        return repr(error)
    return "accepted"


def test_what_is_no_path_recording_camera_frame_or_image(small: Path) -> None:
    calls = {call.__qualname__: call for call in TAKE_A_PATH} | of_a_recording(small, open_recording(small))
    found = {(name, str(w)): answer(call, w) for name, call in calls.items() for w in WRONG}
    assert {case: why for case, why in found.items() if why} == {}


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"columns": 10**9, "rows": 10**9, "square": 0.04, "marker": 0.03}, "Board.columns must be at least 3 and at"),
        ({"columns": 7, "rows": 5, "square": math.nan}, "Board.square must be above 0"),
        ({"columns": 7, "rows": 5, "square": 0.04, "marker": 0.05}, "expected smaller markers"),
        ({"columns": 40, "rows": 50, "square": 0.04, "marker": 0.03}, "has 1000 markers and DICT_4X4_50 has 50"),
    ],
)
def test_a_board_that_cannot_be(values: dict[str, Any], says: str) -> None:
    refuses(says, lambda: Board(**values).corners(IMAGE))


@pytest.mark.parametrize("image", [IMAGE.astype(float), IMAGE[..., 0], IMAGE[:0], np.zeros((4, 4, 4), np.uint8)])
def test_what_is_no_image(image: np.ndarray, tmp_path: Path) -> None:
    pytest.importorskip("av")
    refuses(r"expected RGB uint8 \[H, W, 3\]", Board(7, 5, 0.04).corners, image)
    with (
        pytest.raises(D2Error, match=r"expected RGB uint8 \[H, W, 3\]"),
        write_video(tmp_path / "a.mp4", "mp4", 24) as add,
    ):
        add(image)
    assert not list(tmp_path.iterdir())


def test_a_path_in_the_place_of_what_lies_there_is_called_by_its_kind(small: Path) -> None:
    recording = open_recording(small)
    refuses("store of contact_sheet must be a PriorStore, got 'priors'", contact_sheet, "priors", recording, "a.png")
    refuses("recording of select_frames must be a Recording, got 'room'", select_frames, "room", [0])


def test_arguments_become_what_is_declared() -> None:
    @checked_arguments
    def call(names: list[str], count: int = 1, share: float = 0.5, place: Path = Path()) -> tuple:
        return names, count, share, place

    assert call(["a"], np.int64(3), 1, "x") == (["a"], 3, 1.0, Path("x"))
    refuses(r"names of .*call must be .*, got 'abc'", call, "abc")
    refuses(r"count of .*call must be a whole number, got 1.5", call, ["a"], 1.5)
