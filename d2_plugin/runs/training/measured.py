"""One run of the comparison, measured: what a worker does, and the row that comes of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.rivals.table import rival
from d2_plugin.errors import D2Error
from d2_plugin.runs.ablation.job import Job
from d2_plugin.runs.rows import Row, make_row
from d2_plugin.runs.saved.kinds import read_metrics
from d2_plugin.runs.shared import Shared
from d2_plugin.store.files import hash_of

TRY = "try"
"""Target of a run that looks for the number of steps of a budget: drawn, and in no table."""


@dataclass(frozen=True, eq=False)
class Work:
    """A run, and what its row says beside the scores; travels to a worker."""

    job: Job
    shared: Shared
    case: str
    method: str
    command: str
    target: str
    """What the run is meant for: `30 s`, `2000 steps`, or `TRY`."""
    about: Mapping[str, Any] = field(default_factory=dict)
    """Further fields of the row."""
    kind: str = "quality"
    """Of the row."""

    @property
    def key(self) -> tuple[str, str]:
        """What makes two of them the same measurement, on whatever machine its files lie."""
        return fingerprint(self.job), self.target


def fingerprint(job: Job) -> str:
    """Hash of everything that decides a run, without folders."""
    table = job.settings.as_table()
    table |= {name: Path(table[name]).name for name in ("recording", "priors", "mono_onnx") if table.get(name)}
    guidance = rival(job.rival, job.settings.iterations)
    return hash_of(table, None if guidance is None else dict(guidance.identity()))


def measure(work: Work) -> Row:
    """Train and score on one thread; a run that cannot be is a row that says why."""
    import torch

    from d2_plugin.progress import be_silent

    torch.set_num_threads(1)
    be_silent()
    try:
        return row_of(work, _metrics(work))
    except D2Error as error:
        return _row(work, error=None, seconds=None, failed=str(error))


def _metrics(work: Work) -> dict[str, Any]:
    """The metrics of the run, which is continued where it was cut off; its checkpoint goes once it is scored."""
    job, done = work.job, work.job.folder / "metrics.json"
    run = job.run()
    if done.is_file() and not (job.folder / "checkpoint.pt").is_file():
        return read_metrics(job.folder)
    work.shared.give_points(job.folder)
    run.train()
    metrics = run.evaluate(images=False)
    (job.folder / "checkpoint.pt").unlink()
    return metrics


def row_of(work: Work, metrics: Mapping[str, Any]) -> Row:
    """A finished run as a row."""
    scores = metrics["test"] or {}
    psnr = scores.get("psnr")
    return _row(
        work,
        error=None if psnr is None else 10 ** (-psnr / 20),
        seconds=metrics["cpu_seconds"]["train"],
        failed=None if psnr is not None else "no camera was held out",
        wall_seconds=metrics["seconds"]["train"],
        scores=scores,
        gaussians=metrics["gaussians"],
        background=metrics["background"],
        mono_emulated=metrics["mono_emulated"],
    )


def _row(work: Work, **found: Any) -> Row:
    settings = work.job.settings
    about: dict[str, Any] = {"target": work.target, "iterations": settings.iterations, "seed": settings.seed}
    about |= {"cameras": list(settings.train_cameras), **work.about}
    setting = f"{settings.iterations} steps, seed {settings.seed}"
    about["fingerprint"] = fingerprint(work.job)
    return make_row(work.kind, work.case, work.method, setting, command=work.command, **found, **about)
