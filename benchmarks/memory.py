"""Peak memory of a piece of work: resident memory on Linux, measured in a process of its own."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import torch

from d2_plugin.runs.workers import worker_pool

_STATUS, _RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


class Measured(NamedTuple):
    """What the work returned, and the memory it took beyond what was there before, MB; NaN outside Linux."""

    result: Any
    peak_mb: float


def in_fresh_process(work: Callable[..., Any], *arguments: Any) -> Measured:
    """Run `work(*arguments)`, both of which must pickle, in a new process with as many threads as this one.

    What other work left in memory, and what an earlier one made the peak, does not count.
    """
    # An executor lets its process end by itself: multiprocessing.Pool terminates it, and pycolmap then prints a crash.
    with worker_pool(1) as pool:
        return pool.submit(_measured, work, arguments, torch.get_num_threads()).result()


def peak_resident(work: Callable[[], Any]) -> Measured:
    """Run `work` here; the peak is counted from now on, beyond what is resident now."""
    if not _RESET.exists():
        return Measured(work(), float("nan"))
    _RESET.write_text("5")  # the peak starts again from here
    before = _status_mb("VmRSS")
    result = work()
    return Measured(result, _status_mb("VmHWM") - before)


def _measured(work: Callable[..., Any], arguments: tuple, threads: int) -> Measured:
    torch.set_num_threads(threads)
    return peak_resident(lambda: work(*arguments))


def _status_mb(key: str) -> float:
    found = re.search(rf"{key}:\s+(\d+) kB", _STATUS.read_text())
    return float("nan") if found is None else int(found.group(1)) * 1024 / 1e6
