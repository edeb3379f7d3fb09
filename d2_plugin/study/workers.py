"""Processes of this machine that work for this one and end with it, however it ends."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor


def worker_pool(count: int, prepare: Callable[[], None] | None = None) -> ProcessPoolExecutor:
    """An executor of `count` new processes, each of which first calls `prepare`, which must pickle.

    The workers of an executor whose process was killed would otherwise wait for work for ever, with all their memory.
    """
    return ProcessPoolExecutor(count, multiprocessing.get_context("spawn"), _begin, (prepare,))


def _begin(prepare: Callable[[], None] | None) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    if prepare is not None:
        prepare()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
