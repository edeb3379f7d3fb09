"""A hostile user on the command line: each case is one sentence and exit code 2, never silence or a traceback."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from d2_plugin.commands.cli import main

pytest.importorskip("av")
pytest.importorskip("cv2")
pytestmark = pytest.mark.slow

Change = Callable[[Path], object]
Words = list[str]
Refused = Callable[..., str]

FLAGS = """
--densify.scale -1 | --densify.opacity 2 | --densify.budget-per-view -5 | --densify.budget -5
--depth-loss.tau-v nan | --depth-loss.weight 1e308 | --prune.patience 0 | --d2.views-per-evaluation -3
--d2.finite-every -1 | --d2.finite-every 1.5 | --plan.temporal maybe | --seed -1 | --seed 99999999999999999999999
--frames 0:3000000000 | --frames x | --frames 3:1 | --iterations 0 | --iterations 1e400 | --iterations nan
--downscale 0 | --downscale 1e9 | --hooks all,none | --hooks densfy | --device tpu | --backbone ../x
--priors.stereo.depth-range 1,2,3 | --backbone.densify.every -1 | --config /dev/null | --config /nope
--train-cameras a,b | --train-cameras train0,train0 | --test-cameras train0 | --mono-onnx /nope | --mono-kind purple
--output /proc/x/y | --output /dev/null/x
"""
IMPORTS = """
--times 5,1 | --times 0,1e300 | --times nan,1 | --times 1 | --times 100,200 | --frames 0:3000000000 | --frames 0:11:0
--rate nan | --rate 0 | --rate 1e-300 | --scale 0 | --scale 1e-9 | --scale nan | --crop 0x0+0+0 | --crop 9x9 --crop zz
--crop 999999x999999+0+0 | --crop zz=10x10+0+0 | --crop 10x10+95+0 | --images gif | --unit mile
--offsets zz=1 | --offsets train0=1e300 | --offsets train0=nan | --offsets train0 | --offsets train0=x
--offsets timecode | --offsets sound | --exposure maybe | --output /dev/null/x | --calibration /dev/zero
--calibration /nope | --calibration /
"""
VIDEOS = """
--path nope | --path /nope.json | --path /dev/zero | --degrees 0 --path orbit | --show nope | --show truth --path orbit
--cameras nope | --at 1e300 | --at nan | --at -1 | --speed 0 | --speed 1e-300 | --speed nan | --seconds 1e300
--seconds 0 | --fps 1e300 | --fps 1e-300 | --fps nan | --width 0 | --width 99999 | --downscale 0 | --quality 99
--output /dev/null/x.mp4 | --output /proc/x.mp4 | --format mkv
"""
ELSEWHERE = """
view /nope | view /dev/null | view RUN --port 0 | view RUN --host 999.1.1.1 | view RUN --height 1 | doctor /nope
doctor /dev/null | doctor VIDEOS | doctor --attach nope | doctor --attach fudan | doctor --attach fudan /nope
export RUN --format nope | export RUN --frames 0:1 | export RUN --megabytes 0 | export RUN --output /dev/null/x
export /nope | export VIDEOS | eval /nope | eval /dev/null | compare | compare /nope | report /nope | report /dev/zero
render | render /nope | render /dev/null | render VIDEOS | bench | bench nope | bench training | bench training x
bench training /nope@a+b | bench training ROOM@train0+train1 --seconds nan | bench training ROOM@train0@@x
bench training ROOM@train0+train1 --jobs 9999999 | bench training ROOM@train0+train1 --config /nope --steps 1
bench gpu --steps nope | bench gpu --output /dev/null/x
stability --sweeps nope | demo --iterations 0 | demo --output /dev/null/x
export-recording ROOM --format nope --output x | ablate ROOM --train-cameras train0,train1 --rows nope --output x
 export-recording ROOM --format n3dv --output ROOM
"""


def lines(text: str) -> list[Words]:
    return [case.split() for line in text.strip().splitlines() for case in line.split(" | ")]


@pytest.fixture(scope="module")
def place(recording: Path, videos: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder `videos`, a filmed `room` and a trained `run`."""
    folder = tmp_path_factory.mktemp("hostile")
    shutil.copytree(videos, folder / "videos")
    shutil.copytree(recording, folder / "room")
    assert main([*train(folder / "room"), "--hooks", "none", "--output", str(folder / "run")]) == 0
    return folder


def train(recording: Path) -> Words:
    return ["train", str(recording), "--train-cameras", "train0,train1", "--iterations", "3"]


def imported(place: Path, videos: Path, output: Path) -> Words:
    calibration = ["--calibration", str(place / "room" / "cameras.json"), "--offsets", "none"]
    return ["import", str(videos), *calibration, "--output", str(output)]


def test_flags(recording: Path, tmp_path: Path, refused: Refused) -> None:
    for words in lines(FLAGS):
        refused(*train(recording), "--output", tmp_path / "run", *words)


def test_imports(place: Path, tmp_path: Path, refused: Refused) -> None:
    for words in lines(IMPORTS):
        refused(*imported(place, place / "videos", tmp_path / "out"), *words)


def test_videos(place: Path, tmp_path: Path, refused: Refused) -> None:
    for words in lines(VIDEOS):
        refused("render", place / "run", "--output", tmp_path / "a.mp4", *words)
    assert not list(tmp_path.iterdir())


def test_other_commands(place: Path, refused: Refused, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(place)
    named = {"RUN": "run", "VIDEOS": "videos", "ROOM": "room"}
    for words in lines(ELSEWHERE):
        refused(*(named.get(word, word).replace("ROOM@", "room@") for word in words))


def in_its_place(make: Callable[[Path], object]) -> Change:
    """Something else in the place of a file."""

    def change(path: Path) -> None:
        path.unlink()
        make(path)

    return change


DAMAGES: tuple[Change, ...] = (
    lambda path: path.write_bytes(b""),
    lambda path: path.write_bytes(bytes(range(256)) * 9),
    lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    in_its_place(os.mkfifo),
    in_its_place(Path.mkdir),
    in_its_place(lambda path: path.symlink_to("/nope")),
    in_its_place(lambda path: path.symlink_to("/dev/zero")),
)


def test_damaged_videos(place: Path, tmp_path: Path, refused: Refused) -> None:
    for number, damage in enumerate(DAMAGES):
        videos = shutil.copytree(place / "videos", tmp_path / str(number))
        damage(videos / "train0.mp4")
        refused(*imported(place, videos, tmp_path / f"out{number}"))


@pytest.mark.parametrize("name", ["run.json", "checkpoint.pt"])
def test_damaged_runs(place: Path, name: str, tmp_path: Path, refused: Refused) -> None:
    for number, damage in enumerate(DAMAGES):
        run = shutil.copytree(place / "run", tmp_path / str(number))
        damage(run / name)
        for words in (["eval", run], ["export", run], ["render", run, "--output", tmp_path / "a.mp4"]):
            refused(*words)
