"""One run of one official trainer in a process of its own, and the row that it leaves."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import torch

from benchmarks.trainers.prepare import Prepared
from benchmarks.trainers.trials import Job, Trial
from d2_plugin.reading import parse_json, read_text
from d2_plugin.runs.rows import Row

METHODS = ("bare", "no hooks", "attached", "with motion", "with parallax")
BARE, NO_HOOKS, ATTACHED, WITH_MOTION, WITH_PARALLAX = METHODS

CONFIGURATIONS = {
    NO_HOOKS: 'prior = "{prior}"\n',
    ATTACHED: 'prior = "{prior}"\n[densify]\n[prune]\n[depth_loss]\n',
    WITH_MOTION: 'prior = "{prior}"\n[densify]\n[prune]\n[depth_loss]\n[motion]\n',
    WITH_PARALLAX: 'prior = "{prior}"\n[densify]\n[prune]\n[depth_loss]\n[parallax]\n',
}
"""d2.toml of each method: the defaults, with schedules that follow from the length that the trainer announces."""

LONGEST = 3600
"""What one run may take, seconds of wall time."""


def trial_row(
    name: str,
    trial: Trial,
    checkout: Path,
    prepared: Prepared,
    folder: Path,
    method: str,
    iterations: int,
    seed: int,
    *,
    own_schedules: bool = False,
) -> Row:
    """Run it and say how well it did, by its own report, or why it did not."""
    source = prepared.source
    row: Row = {"repository": name, "source": trial.source, "checkout": commit_of(checkout)}
    row |= {"recording": source.recording.name, "frames": source.frames, "downscale": source.downscale}
    row |= {"hold_out_instants": source.step} if source.step > 1 else {}
    row |= {"own_schedules": True} if own_schedules else {}
    row |= {"method": method, "iterations": iterations, "seed": seed}
    row |= {"scored_on": trial.scored_on, "psnr": {}, "failed": None}
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    job = Job(prepared.data, folder.resolve(), iterations, source.frames, source.seconds, own_schedules)
    code, printed = _run(_words(name, trial, job, prepared, method, seed), checkout, job.output / "log.txt")
    outcome = job.output / "outcome.json"
    if code != 0 or not outcome.is_file():
        last = [line for line in printed.splitlines() if line.strip()][-1:]
        return row | {"failed": f"ended with code {code}: {' '.join(last)[-300:]}"}
    row["psnr"] = trial.scores(job, printed)
    return row | parse_json(read_text(outcome, "run it again"), str(outcome), "run it again")


def _words(name: str, trial: Trial, job: Job, prepared: Prepared, method: str, seed: int) -> list[str]:
    words = ["-m", "benchmarks.trainers.inside", str(job.output / "outcome.json"), str(seed), str(prepared.truth)]
    words += [str(prepared.held_out)] if prepared.held_out is not None else []
    words += ["--", name, *(() if torch.cuda.is_available() else ("--cpu",))]
    if method in CONFIGURATIONS:
        words += ["--d2", job.write("d2.toml", CONFIGURATIONS[method].format(prior=prepared.prior))]
    return [*words, "--", trial.script, *trial.words(job)]


def _run(words: list[str], checkout: Path, log: Path) -> tuple[int, str]:
    """Exit code and all that was printed, which is in `log` as well."""
    with log.open("w", encoding="utf-8") as output:
        try:
            done = subprocess.run(
                [sys.executable, *words],
                cwd=checkout,
                env={"OMP_NUM_THREADS": "1", **os.environ, "PYTHONPATH": os.pathsep.join(_places())},
                stdout=output,
                stderr=subprocess.STDOUT,
                timeout=LONGEST,
                check=False,
            )
            code = done.returncode
        except subprocess.TimeoutExpired:
            code = 124
    return code, log.read_text(encoding="utf-8", errors="replace").replace("\r", "\n")


def _places() -> list[str]:
    """Where the process finds `benchmarks`, whatever folder it runs in: beside this package; then as before."""
    return [str(Path(__file__).resolve().parents[2]), *filter(None, [os.environ.get("PYTHONPATH")])]


def commit_of(checkout: Path) -> str | None:
    """The commit of a checkout, with + where files differ from it; None where git knows nothing of the folder."""
    words = ["git", "-C", str(checkout), "describe", "--always", "--dirty=+", "--exclude=*"]
    found = subprocess.run(words, capture_output=True, text=True, check=False)
    return found.stdout.strip() or None
