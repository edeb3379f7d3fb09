"""Processes of this machine that work for this one and end with it, however it ends."""

from __future__ import annotations

import multiprocessing
import os
import threading
from concurrent.futures import ProcessPoolExecutor


def worker_pool(count: int) -> ProcessPoolExecutor:
    """An executor of `count` new processes.

    The workers of an executor whose process was killed would otherwise wait for work for ever, with all their memory.
    """
    return ProcessPoolExecutor(count, multiprocessing.get_context("spawn"), end_with_parent)


def end_with_parent() -> None:
    """Called in a worker: it ends when the process that started it does, however that one ends."""
    threading.Thread(target=_wait_for_parent, daemon=True).start()


def _wait_for_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
