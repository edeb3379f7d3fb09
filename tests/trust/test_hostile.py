"""A hostile user on the command line: each case is one sentence and exit code 2, never silence or a traceback."""

import re
import shutil
from pathlib import Path

import pytest

from d2_plugin.commands.cli import main

pytest.importorskip("av")
pytest.importorskip("cv2")
pytestmark = pytest.mark.slow

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
view /nope | view /dev/null | view run --port 0 | view run --host 999.1.1.1 | view run --height 1 | doctor /nope
doctor /dev/null | doctor videos | doctor --attach nope | doctor --attach fudan | doctor --attach fudan /nope
export run --format nope | export run --frames 0:1 | export run --megabytes 0 | export run --output /dev/null/x
export /nope | export videos | eval /nope | eval /dev/null | compare | compare /nope | report /nope | report /dev/zero
render | render /nope | render /dev/null | render videos | bench | bench nope | bench training | bench training x
bench training /nope@a+b | bench training room@train0+train1 --seconds nan | bench training room@train0@@x
bench training room@train0+train1 --jobs 9999999 | bench training room@train0+train1 --config /nope --steps 1
bench gpu --steps nope | bench gpu --output /dev/null/x
stability --sweeps nope | demo --iterations 0 | demo --output /dev/null/x
export-recording room --format nope --output x | ablate room --train-cameras train0,train1 --rows nope --output x
 export-recording room --format n3dv --output room
"""


CASES = [
    (FLAGS, "train room --train-cameras train0,train1 --iterations 3 --output new"),
    (IMPORTS, "import videos --calibration room/cameras.json --offsets none --output new"),
    (VIDEOS, "render run --output new.mp4"),
    (ELSEWHERE, ""),
]
"""What is added to which command line."""


@pytest.fixture(scope="module")
def place(recording: Path, videos: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of `videos`, a filmed `room` and a trained `run`."""
    folder = tmp_path_factory.mktemp("hostile")
    shutil.copytree(videos, folder / "videos")
    shutil.copytree(recording, folder / "room")
    words = ["--train-cameras", "train0,train1", "--iterations", "3", "--hooks", "none"]
    assert main(["train", str(folder / "room"), *words, "--output", str(folder / "run")]) == 0
    return folder


@pytest.mark.parametrize(("cases", "fixed"), CASES, ids=["flags", "imports", "videos", "elsewhere"])
def test_what_cannot_be_is_refused(place: Path, refused, monkeypatch, cases: str, fixed: str) -> None:
    monkeypatch.chdir(place)
    for words in re.split(r"[|\n]", cases.strip()):
        refused(*fixed.split(), *words.split())
        shutil.rmtree("new", ignore_errors=True)  # a run or an import that was begun
        assert sorted(path.name for path in place.iterdir()) == ["room", "run", "videos"], words
