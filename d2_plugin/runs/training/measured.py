"""Runs of a comparison, measured side by side on this machine or on a dask cluster, and the rows that come of them."""

from __future__ import annotations

import itertools
import logging
import queue
import shutil
from collections.abc import Callable, Container, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from operator import itemgetter
from pathlib import Path
from typing import Any

from d2_plugin.durable import CannotWrite
from d2_plugin.errors import D2Error
from d2_plugin.locks import Busy
from d2_plugin.progress import progress_bar
from d2_plugin.runs.rows import TRY, Row, append_rows, make_row, read_rows, rms_error
from d2_plugin.runs.run import Run
from d2_plugin.runs.saved import follow_moved, read_metrics
from d2_plugin.runs.scene import Guidance
from d2_plugin.runs.settings import PATHS, RunSettings, check
from d2_plugin.runs.workers import worker_pool
from d2_plugin.store.files import hash_of

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Work:
    """A run of a comparison, and what its row says beside the scores; travels to a worker."""

    settings: RunSettings
    folder: Path
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
    guidance: Guidance | None = None
    """What guides the run in place of D2's hooks."""
    kept: bool = False
    """Whether the checkpoint stays once the run is scored, and the first seed gets images."""

    @property
    def key(self) -> tuple[str, ...]:
        """What makes two of them the same measurement, on whatever machine its files lie."""
        return self.kind, self.method, self.target, fingerprint(self)

    def run(self) -> Run:
        """The run in its folder, its files where they lie now; refuses other settings, with one sentence."""
        follow_moved(self.folder, check(self.settings))
        return Run(self.settings, self.folder, self.guidance)


def fingerprint(work: Work) -> str:
    """Hash of everything that decides a run, without folders."""
    table = work.settings.as_table()
    table |= {name: Path(table[name]).name for name in PATHS if table.get(name)}
    return hash_of(table, None if work.guidance is None else dict(work.guidance.identity()))


def measure(work: Work) -> Row:
    """Train and score on one thread; a run that cannot be is a row that says why."""
    import torch

    from d2_plugin.progress import be_silent

    torch.set_num_threads(1)
    be_silent()
    run = work.run()  # a folder of another run ends all: as a row it would count as measured when that is mended
    try:
        return _row(work, _metrics(work, run))
    except (Busy, CannotWrite):  # the next call finds it mended: a row would count as measured
        raise
    except D2Error as error:
        return _row(work, None, str(error))


def _metrics(work: Work, run: Run) -> dict[str, Any]:
    """The metrics of the run, which is continued where it was cut off."""
    checkpoint = work.folder / "checkpoint.pt"
    if (work.folder / "metrics.json").is_file() and (work.kept or not checkpoint.is_file()):
        return read_metrics(work.folder)
    if not (work.folder / "points.npz").is_file():
        shutil.copyfile(work.points, work.folder / "points.npz")
    run.train()
    metrics = run.evaluate(images=work.kept and work.settings.seed == 0)
    if not work.kept:
        checkpoint.unlink()
    return metrics


def _row(work: Work, metrics: Mapping[str, Any] | None, failed: str | None = None) -> Row:
    """A run as a row; trials that decided what of the prior is used count as time of the prior."""
    settings, error, measured = work.settings, None, dict[str, Any]()
    about: dict[str, Any] = {"target": work.target, "iterations": settings.iterations, "seed": settings.seed}
    about |= {"cameras": list(settings.train_cameras), "test_cameras": settings.test_cameras, "frames": settings.frames}
    about |= {**work.about, "fingerprint": fingerprint(work)}
    if metrics is not None:
        scores = metrics["test"] or {}
        error = rms_error(scores)
        failed = None if error is not None else "no camera was held out"
        measured = {name: metrics[name] for name in ("gaussians", "background", "mono_emulated")}
        measured |= {"scores": scores, "wall_seconds": metrics["seconds"]["train"], "images": metrics.get("images", [])}
        if metrics.get("trials") and about.get("prior_seconds") is not None:
            about["prior_seconds"] += metrics["trials"]["cpu_seconds"]
    return make_row(
        work.kind,
        work.case,
        work.method,
        about.pop("setting", f"{settings.iterations} steps, seed {settings.seed}"),
        error=error,
        seconds=None if metrics is None else metrics["cpu_seconds"]["train"],
        failed=failed,
        command=work.command,
        **measured,
        **about,
    )


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

    def resume(line: Line, rows: Sequence[Row] | None) -> None:
        try:
            batch: Sequence[Work] = next(line) if rows is None else line.send(rows)
            while not batch:
                batch = line.send([])
        except StopIteration:
            return
        open_work[line] = [None] * len(batch)
        for place, work in enumerate(batch):
            future = submit(work)
            owner[future] = (line, place)
            future.add_done_callback(finished.put)

    for line in lines:
        resume(line, None)
    while owner:
        future = finished.get()
        line, place = owner.pop(future)
        row: Row = future.result()
        on_row(row)
        open_work[line][place] = row
        rows = [known for known in open_work[line] if known is not None]
        if len(rows) == len(open_work[line]):
            resume(line, rows)


def measure_missing(name: str, works: Sequence[Work], path: Path, jobs: int) -> list[Row]:
    """Measure what has no row in the file yet, `jobs` at a time on this machine; all rows of the file."""
    missing = unmeasured(works, by_key(rows_in(path)))

    def line() -> Line:
        yield missing

    with workers(jobs, None) as submit, written(path, name, len(missing)) as write:
        follow([line()], submit, write)
    return rows_in(path)


def unmeasured(works: Iterable[Work], known: Container[tuple[str, ...]]) -> list[Work]:
    """The works whose key is not known, each once."""
    return list({work.key: work for work in works if work.key not in known}.values())


def rows_in(path: Path) -> list[Row]:
    """The rows of a file that need not be there."""
    return read_rows([path]) if path.is_file() else []


def by_key(rows: Iterable[Row]) -> dict[tuple[str, ...], Row]:
    """Rows of runs by `Work.key`."""
    key = itemgetter("kind", "method", "target", "fingerprint")
    return {key(row): row for row in rows if "fingerprint" in row}


@contextmanager
def written(path: Path, name: str, total: int, **about: Any) -> Iterator[Callable[[Row], None]]:
    """Gives what adds a row to the file, with further fields, and shows it as one of so many."""
    with progress_bar(name, total) as bar:
        done = itertools.count(1)

        def write(row: Row) -> None:
            append_rows(path, [row | about])
            if row.get("failed"):
                _log.warning("no score of %s, %s, %s: %s", *map(row.get, ("case", "method", "setting", "failed")))
            if row["target"] != TRY:  # a run that finds a length is beside the count
                bar.update(next(done), f"{row['case']}: {row['method']}, {row['setting']}")

        yield write


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
