"""A live viewer at work."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from d2_plugin.viewing.live import Viewer
from d2_plugin.viewing.viewed import ViewedRun


@contextmanager
def showing(viewed: ViewedRun, height: int) -> Iterator[Viewer]:
    """A viewer whose images are drawn by a thread of its own, as `d2 view` draws them in its only one."""
    viewer, stop = Viewer(viewed=viewed, port=18080, height=height), threading.Event()
    thread = threading.Thread(target=viewer.stay, args=(stop.is_set,))
    thread.start()
    try:
        yield viewer
        assert thread.is_alive(), "what draws has stopped"
    finally:
        stop.set()
        thread.join()
        viewer.close()
