"""Runs side by side, on this machine or on a dask cluster; results come back as they finish."""

from __future__ import annotations

import queue
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from d2_plugin.errors import D2Error
from d2_plugin.runs.rows import Row
from d2_plugin.runs.training.measured import Work, measure
from d2_plugin.runs.workers import worker_pool

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
        if all(found is not None for found in open_work[line]):
            resume(line, [found for found in open_work[line] if found is not None])


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
