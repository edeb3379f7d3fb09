"""What long work says: a bar where `rich` is installed and a person watches, a line now and then otherwise."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from d2_plugin.extras import is_installed


def show(*lines: str) -> None:
    """Print at once, before long work starts."""
    sys.stdout.write("".join(f"{line}\n" for line in lines))
    sys.stdout.flush()


class Bar:
    """One piece of work of known length."""

    def __init__(self, shown: Callable[[int, str], Any]) -> None:
        """`shown` shows how many units are done, and a note behind."""
        self._shown = shown

    def update(self, done: int, note: str = "") -> None:
        """`done` units of work are finished; `note` is shown behind."""
        self._shown(done, note)


class _Lines:
    """A line on stderr at most every ten seconds, with the share done and the time that remains."""

    def __init__(self, title: str, total: int) -> None:
        self.title, self.total = title, max(total, 1)
        self.last = time.monotonic()
        self._first: tuple[float, int] | None = None

    def show(self, done: int, note: str) -> None:
        now = time.monotonic()
        since, before = self._first = self._first or (now, done)  # what starts workers is not repeated for each unit
        if now - self.last < 10 and done < self.total:
            return
        self.last = now
        left = f", {(now - since) / (done - before) * (self.total - done):.0f} s left" if done > before else ""
        sys.stderr.write(f"{self.title}: {done}/{self.total}{left} {note}\n")


_silent = False


def be_silent() -> None:
    """No bars in this process from now on: for workers whose parent shows one."""
    global _silent
    _silent = True


@contextmanager
def progress_bar(title: str, total: int) -> Iterator[Bar]:
    """A bar for `total` units of work, written to stderr so that results on stdout stay clean."""
    if _silent:
        yield Bar(lambda done, note: None)
        return
    if not sys.stderr.isatty() or not is_installed("rich"):
        yield Bar(_Lines(title, total).show)
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, TextColumn("{task.fields[note]}"), console=Console(stderr=True)) as progress:
        task = progress.add_task(title, total=total, note="")
        yield Bar(lambda done, note: progress.update(task, completed=done, note=note))
