"""Runs of a comparison, measured side by side on this machine or on a dask cluster, and the rows that come of them."""

from __future__ import annotations

import queue
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from d2_plugin.errors import D2Error
from d2_plugin.runs.rows import Row, make_row, rms_error
from d2_plugin.runs.saved import read_metrics
from d2_plugin.runs.shared import Job, give_points
from d2_plugin.runs.workers import worker_pool
from d2_plugin.store.files import hash_of


@dataclass(frozen=True, eq=False)
class Work:
    """A run, and what its row says beside the scores; travels to a worker."""

    job: Job
    points: Path
    """The starting points that the runs of the case share."""
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
    return hash_of(table, None if job.guidance is None else dict(job.guidance.identity()))


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
    give_points(work.points, job.folder)
    run.train()
    metrics = run.evaluate(images=False)
    (job.folder / "checkpoint.pt").unlink()
    return metrics


def row_of(work: Work, metrics: Mapping[str, Any]) -> Row:
    """A finished run as a row; trials that decided what of the prior is used count as time of the prior."""
    scores = metrics["test"] or {}
    error = rms_error(scores)
    row = _row(
        work,
        error=error,
        seconds=metrics["cpu_seconds"]["train"],
        failed=None if error is not None else "no camera was held out",
        wall_seconds=metrics["seconds"]["train"],
        scores=scores,
        gaussians=metrics["gaussians"],
        background=metrics["background"],
        mono_emulated=metrics["mono_emulated"],
    )
    if metrics.get("trials") and row["prior_seconds"] is not None:
        row["prior_seconds"] += metrics["trials"]["cpu_seconds"]
    return row


def _row(work: Work, **measured: Any) -> Row:
    settings = work.job.settings
    about: dict[str, Any] = {"target": work.target, "iterations": settings.iterations, "seed": settings.seed}
    about |= {"cameras": list(settings.train_cameras), **work.about}
    setting = f"{settings.iterations} steps, seed {settings.seed}"
    about["fingerprint"] = fingerprint(work.job)
    return make_row(work.kind, work.case, work.method, setting, command=work.command, **measured, **about)


Submit = Callable[[Work], Any]
"""Starts a measurement and returns a future."""

Line = Generator[Sequence[Work], Sequence[Row], None]
"""What is measured one after the other: yields work that may run side by side, and is sent the rows of all of it."""


def follow(lines: Sequence[Line], submit: Submit, on_row: Callable[[Row], None]) -> None:
    """Run every line to its end; `on_row` gets each row as soon as it is there.

    The first error that is not a refusal of a run ends everything.
    """
    finished: queue.SimpleQueue[Any] = queue.SimpleQueue()
    owner: dict[Any, tuple[Line, int]] = {}
    open_work: dict[Line, list[Row | None]] = {}

    def start(line: Line, batch: Sequence[Work]) -> None:
        open_work[line] = [None] * len(batch)
        for place, work in enumerate(batch):
            future = submit(work)
            owner[future] = (line, place)
            future.add_done_callback(finished.put)

    def resume(line: Line, rows: Sequence[Row] | None) -> None:
        try:
            batch: Sequence[Work] = next(line) if rows is None else line.send(rows)
            while not batch:
                batch = line.send([])
        except StopIteration:
            return
        start(line, batch)

    for line in lines:
        resume(line, None)
    while owner:
        future = finished.get()
        line, place = owner.pop(future)
        row: Row = future.result()
        on_row(row)
        open_work[line][place] = row
        if all(row_of_work is not None for row_of_work in open_work[line]):
            resume(line, [row_of_work for row_of_work in open_work[line] if row_of_work is not None])


@contextmanager
def workers(count: int, scheduler: str | None) -> Iterator[Submit]:
    """What starts measurements: `count` processes of this machine, or the workers of the scheduler at that address.

    Raises:
        D2Error: no scheduler or worker there, or a worker with more than one thread, whose CPU time would be that of
            several runs together.
    """
    if scheduler is None:
        with worker_pool(count) as pool:
            try:
                yield lambda work: pool.submit(measure, work)
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)  # else all other runs would still be trained
                raise
        return
    from d2_plugin.priors.dask_build import cluster_client

    with cluster_client(scheduler, 1, "measuring on a cluster") as client:
        if any(threads != 1 for threads in client.nthreads().values()):
            raise D2Error(
                f"a worker of {scheduler} has several threads, and the CPU time of a run is that of its process: start "
                f"workers with `dask worker {scheduler} --nthreads 1`"
            )
        yield lambda work: client.submit(measure, work, pure=False)
