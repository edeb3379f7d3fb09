"""`python -m benchmarks gpu`: everything that a GPU has to show, one step after another, in less than 25 minutes.

Each step has a time limit of its own and leaves its output and a row as soon as it ends, so that a machine lent for
half an hour loses nothing. A step that cannot run here says why in one sentence.
"""

import logging
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, NamedTuple

import torch

from benchmarks.rows import told
from d2_plugin.durable import make_folder
from d2_plugin.errors import refuse_unknown
from d2_plugin.runs.rows import Row, append_rows, command_line, make_row
from d2_plugin.runs.tables import Table
from d2_plugin.settings import Range, Settings

logger = logging.getLogger(__name__)

CHECKOUT = Path(__file__).resolve().parents[2]
"""The folder whose tests are run."""


@dataclass(frozen=True)
class GpuBench(Settings):
    """Settings of `python -m benchmarks gpu`."""

    steps: tuple[str, ...] = ()
    """Names of the steps to run; all if not given."""
    recording: Path | None = None
    """Recording that is trained on the GPU and on the CPU."""
    train_cameras: str = "preset:4"
    """Cameras to train with, as `d2 train` takes them."""
    iterations: Annotated[int, Range(1, unit="steps")] = 600
    """Steps of each of the two trainings."""
    output: Path = Path("bench-gpu")
    """Folder of rows, outputs and profiles."""


Need = Callable[[GpuBench], str | None]
"""Why a step cannot run here, in one sentence; None where it can."""


def _device(settings: GpuBench) -> str | None:
    return None if torch.cuda.is_available() else "torch sees no CUDA device: run it on a machine that has one"


def _recording(settings: GpuBench) -> str | None:
    return None if settings.recording else "no recording was given: add --recording"


def _program(name: str) -> Need:
    return lambda settings: None if shutil.which(name) else f"{name} is not on the path: install the CUDA toolkit"


def _trained(settings: GpuBench) -> str | None:
    missing = [name for name in ("train-cuda", "train-cpu") if not (settings.output / name).is_dir()]
    return f"{' and '.join(missing)} did not run: their reasons stand above" if missing else None


class Step(NamedTuple):
    """A part of the proof: its time limit, what it needs and its command."""

    limit: int  # seconds
    needs: tuple[Need, ...]
    command: str
    """Names in braces are settings of `GpuBench`, and programs."""

    def words(self, settings: GpuBench) -> list[str]:
        """The command of this machine."""
        python = shlex.quote(sys.executable)
        modules = {"bench": "benchmarks", "d2": "d2_plugin", "pytest": "pytest -q -n 0"}  # one process for one device
        programs = {name: f"{python} -m {module}" for name, module in modules.items()}
        given = {name: shlex.quote(str(value)) for name, value in vars(settings).items()}
        return shlex.split(self.command.format(**programs, **given))


def _sanitizer(tool: str) -> Step:
    # Small scenes: a sanitizer slows a kernel down a hundred times.
    chosen = "{pytest} -m cuda tests/rasterizer/test_rasterizer_kernels.py -k 'one or 7x5 or survey'"
    needs = (_device, _program("compute-sanitizer"))
    return Step(120, needs, f"compute-sanitizer --tool {tool} --error-exitcode 9 {chosen}")


TESTED = "tests/rasterizer tests/stability tests/priors/test_patchmatch_gpu.py"
RASTER = "{bench} raster --device cuda --output {output}/"
STEREO = "{bench} stereo --device cuda --defaults-only --rigs synthetic4 --width 640 --output {output}/"
TRAIN = "{d2} train {recording} --train-cameras {train_cameras} --iterations {iterations} --output {output}/train-"
PROFILE = "ncu --set basic -k 'regex:d2_(render|backward|survey)$' -c 6 -f -o {output}/profile"

STEPS = {
    "tests": Step(180, (_device,), f"{{pytest}} -m cuda {TESTED}"),
    **{tool: _sanitizer(tool) for tool in ("memcheck", "racecheck", "initcheck")},
    "raster": Step(
        *(240, (_device,)),
        f"{RASTER}raster.jsonl --seconds 1 --sizes 640x360,1920x1080 --scenes synth:10000,synth:200000,synth:1000000 "
        "--error-limit 10000",
    ),
    "stereo-cuda": Step(60, (_device,), f"{STEREO}stereo-cuda.jsonl"),
    "train-cuda": Step(150, (_device, _recording), f"{TRAIN}cuda --device cuda"),
    "train-cpu": Step(150, (_device, _recording), f"{TRAIN}cpu --device cpu"),
    "compare": Step(20, (_device, _recording, _trained), "{d2} compare {output}/train-cuda {output}/train-cpu"),
    "profile": Step(
        *(100, (_device, _program("ncu"))),
        f"{PROFILE} {RASTER}profiled.jsonl --scenes synth:200000 --sizes 1920x1080 --seconds 0.1 --no-memory "
        "--error-limit 1",
    ),
}
"""In the order in which they are worth the time."""


def run(settings: GpuBench) -> str:
    """Run the steps; a table of what each came to, and where rows and outputs lie."""
    refuse_unknown("step", settings.steps, STEPS)
    make_folder(settings.output)
    command = command_line("python -m benchmarks gpu", settings)
    recording = settings.recording.resolve() if settings.recording else None
    settings = replace(settings, output=settings.output.resolve(), recording=recording)  # steps run in the checkout
    rows = list[Row]()
    for name in settings.steps or STEPS:
        rows.append(_run_step(name, settings, command))
        append_rows(settings.output / "gpu.jsonl", rows[-1:])
        logger.info("%s: %s", name, rows[-1]["failed"] or "done")
    return told(tables(rows), settings.output / "gpu.jsonl") + "; the output of each step lies beside them"


def _run_step(name: str, settings: GpuBench, command: str) -> Row:
    step = STEPS[name]
    start = time.perf_counter()
    refused = next((reason for need in step.needs if (reason := need(settings))), None)
    refused = refused or _call(step, name, settings)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    took = time.perf_counter() - start
    return make_row("gpu", name, "step", error=None, seconds=took, failed=refused, command=command, device=device)


def _call(step: Step, name: str, settings: GpuBench) -> str | None:
    """Run a step's command with its output in a file; why it failed, or None."""
    log = settings.output / f"{name}.log"
    words = step.words(settings)
    with log.open("w") as output:
        # A session of its own: what the command started ends with it.
        process = subprocess.Popen(words, cwd=CHECKOUT, stdout=output, stderr=subprocess.STDOUT, start_new_session=True)
        try:
            code = process.wait(step.limit)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            return f"it took longer than {step.limit} s: {log.name} has what it said until then"
    return None if code == 0 else f"it ended with {code}: {log.name} says why"


def tables(rows: Sequence[Row]) -> list[tuple[str, Table]]:
    """What became of each step."""
    steps = [row for row in rows if row["method"] == "step"]
    lines = tuple((row["case"], row["device"], f"{row['seconds']:.1f}", row["failed"] or "done") for row in steps)
    return [("Steps", Table(("step", "device", "s", "result"), lines))]
