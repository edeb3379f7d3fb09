"""A recording small enough for hundreds of runs, and what was made of it without any mishap."""

import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from recorded import write_video
from trust_commands import Commands, Fault, contents

from d2_plugin.recordings.synthetic.room import synthetic_recording
from d2_plugin.runs.report.report import BUILDERS
from d2_plugin.runs.rows import append_rows, read_rows

ROWS = Path(__file__).parents[1] / "data" / "runs.jsonl"
TRAINED = ["--train-cameras", "train0,train1"]


@dataclass(frozen=True)
class Work:
    """A command whose output can be made again: what it needs first, its words, and where it writes."""

    words: list[str]
    output: Path
    begin: Callable[[], None]

    def anew(self) -> None:
        shutil.rmtree(self.folder)
        self.folder.mkdir()
        self.begin()

    @property
    def folder(self) -> Path:
        """The folder that the output appears in, and where nothing else is."""
        return self.output.parent


@dataclass(frozen=True)
class Workplace:
    """The work by its name, and what each leaves when nothing goes wrong."""

    folder: Path
    recording: Path
    commands: Commands
    work: dict[str, Work]
    whole: dict[str, dict[str, Any]]
    operations: dict[str, int]
    renames: dict[str, int]
    cpu: dict[str, float]
    """Seconds of CPU time that each takes."""


@pytest.fixture(scope="session")
def commands(tmp_path_factory: pytest.TempPathFactory) -> Commands:
    for module in ("cv2", "pycolmap", "av"):
        pytest.importorskip(module)
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None or not sys.platform.startswith("linux"):
        pytest.skip("no C compiler, or no Linux: faults are preloaded")
    source, folder = Path(__file__).with_name("faults.c"), tmp_path_factory.mktemp("faults")
    library = folder / "faults.so"
    subprocess.run([compiler, "-shared", "-fPIC", "-O1", source, "-o", library, "-ldl", "-lrt"], check=True)
    return Commands(library, folder)


@pytest.fixture(scope="session")
def recording(saved_room: Callable[..., Path]) -> Path:
    return saved_room(cameras=2, held_out=1, frames=2, width=96, height=54, arc_degrees=15)


@pytest.fixture(scope="session")
def videos(recording: Path) -> Path:
    """Videos of the first two cameras of the recording, six frames each."""
    filmed = synthetic_recording(cameras=2, held_out=0, frames=6, width=96, height=54, arc_degrees=15)
    folder = recording.parent / "videos"
    folder.mkdir()
    for name in filmed.cameras:
        images = [filmed.image(name, frame) for frame in filmed.frames]
        write_video(folder / f"{name}.mp4", images, [frame / filmed.fps for frame in filmed.frames])
    return folder


@pytest.fixture(scope="session")
def workplace(commands: Commands, recording: Path, videos: Path) -> Workplace:
    folder = recording.parent
    priors, run, out = folder / "priors", folder / "run", folder / "written" / "out"
    rows = folder / "rows.jsonl"
    append_rows(rows, [row for row in read_rows([ROWS]) if row["kind"] in BUILDERS])
    out.parent.mkdir()
    train = ["train", str(recording), *TRAINED, "--iterations", "5", "--priors", str(priors)]

    def trained() -> None:
        shutil.copytree(run, out)
        (out / "metrics.json").unlink()

    export = ["export-recording", str(recording), "--format", "transforms", "--points", "50", "--output"]
    films = ["import", str(videos), "--calibration", str(recording / "cameras.json"), "--offsets", "none"]
    work = {
        "import": Work([*films, "--output", str(out)], out, lambda: None),
        "priors": Work(["priors", str(recording), *TRAINED, "--output", str(out)], out, lambda: None),
        "train": Work([*train, "--output", str(out)], out, lambda: None),
        "eval": Work(["eval", str(out)], out, trained),
        "export": Work([*export, str(out)], out, lambda: None),
        "page": Work(["export", str(run), "--output", str(out)], out, lambda: None),
        "report": Work(["report", str(rows), "--output", str(out)], out, lambda: None),
    }
    whole, operations, renames, cpu = {}, {}, {}, {}
    for name, one in work.items():
        one.anew()
        ended = commands.run(one.words, Fault(one.folder))
        assert ended.code == 0, ended.said
        assert [path.name for path in one.folder.iterdir()] == ["out"]
        whole[name], operations[name], renames[name] = contents(out), ended.operations, ended.renames
        cpu[name] = ended.cpu
        if name in ("priors", "train"):  # what the others begin with
            shutil.copytree(out, {"priors": priors, "train": run}[name])
    return Workplace(folder, recording, commands, work, whole, operations, renames, cpu)
