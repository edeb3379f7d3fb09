"""Signs of life: a line when D2 is attached, one now and then, one at the end; to the log, a callback, TensorBoard."""

from __future__ import annotations

import atexit
import logging
import sys
import time
import weakref
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from torch import Tensor

from d2_plugin.hooks.hook import Hook
from d2_plugin.protocol import Backbone

log = logging.getLogger(__name__)

PAUSE = 30.0
"""Least number of seconds between two lines of progress."""

MEANS_OVER = 10
"""Steps over which a loss is averaged for TensorBoard: reading it stops the GPU."""


@dataclass(frozen=True)
class Trace:
    """One thing a hook did: `action` is "loss", "insert", "remove" or "retire"; `count` is the number of Gaussians."""

    step: int
    hook: str
    action: str
    count: int


class Report(NamedTuple):
    """What one call of `D2Hooks.step` changed."""

    inserted: int = 0
    removed: int = 0
    gaussians: int = 0
    step: int = 0


Listener = Callable[[Report], None]


class Telling:
    """Counts what D2 does and says it; silent until `start`. Nothing that trains depends on it."""

    def __init__(self, hooks: Mapping[str, Hook]) -> None:
        self.hooks = hooks
        self.inserted = self.removed = self.gaussians = self.last_step = 0
        self._aloud, self._ended = False, False
        self._on_report: Listener | None = None
        self._writer: Any = None
        self._iterations: int | None = None
        self._said_at = float("-inf")
        self._terms: dict[str, _Mean] = {}
        self._lately = [0, 0]

    def start(
        self, backbone: Backbone, store: Any, iterations: int | None, on_report: Listener | None, writer: Any
    ) -> None:
        """From now on say what happens, first what was attached, which cameras have priors, and the schedules.

        Args:
            backbone: what D2 is attached to.
            store: the prior's; None where there is no hook.
            iterations: steps that the trainer announces; schedules that end before a tenth of them are named.
            on_report: called with the `Report` of every step.
            writer: what has `add_scalar(tag, value, step)`, a TensorBoard SummaryWriter for instance.
        """
        self._aloud, self._iterations, self._on_report, self._writer = True, iterations, on_report, writer
        be_heard()
        if not self.hooks:
            log.info("attached without a hook: the trainer runs as without D2")
            return
        cameras = ", ".join(map(str, getattr(store, "cameras", ())))
        schedules = ", ".join(_schedule(name, hook) for name, hook in self.hooks.items())
        log.info(
            "attached by %s to %d Gaussians; priors of cameras %s; %s",
            type(backbone).__name__, len(backbone), cameras or "unknown", schedules,
        )  # fmt: skip
        if iterations is not None:
            self._name_short_schedules(iterations)
        _at_exit(self)

    def lost(self, name: str, term: Tensor) -> None:
        """A hook's term of the loss in the present step."""
        if self._aloud:
            self._terms.setdefault(name, _Mean()).add(term.detach())

    def stepped(self, report: Report) -> None:
        """The end of a step."""
        self.inserted, self.removed = self.inserted + report.inserted, self.removed + report.removed
        self.gaussians, self.last_step = report.gaussians, report.step
        if not self._aloud:
            return
        self._lately = [self._lately[0] + report.inserted, self._lately[1] + report.removed]
        if self._on_report is not None:
            self._on_report(report)
        if self._writer is not None:
            self._write(report)
        if (report.inserted or report.removed) and time.monotonic() - self._said_at >= PAUSE:
            self._say_progress(report)
        if self._iterations is None:
            self._notice_late(report.step)

    def summary(self) -> str:
        """What D2 did, in one line."""
        hooks = ", ".join(self.hooks) or "no hook"
        line = f"{hooks}: {self.inserted} inserted, {self.removed} removed, {self.gaussians} Gaussians"
        told = [f"{name} {mean.first:.3g} at first, {mean.now():.3g} at last" for name, mean in self._terms.items()]
        return "; ".join([f"{line} after step {self.last_step}", *told])

    def end(self) -> None:
        """Say the summary, once; by itself when the process ends."""
        if self._aloud and self.last_step and not self._ended:
            self._ended = True
            log.info("%s", self.summary())

    def _say_progress(self, report: Report) -> None:
        losses = "".join(f", {name} {mean.now():.3g}" for name, mean in self._terms.items())
        inserted, removed = self._lately
        log.info(
            "step %d: %d inserted, %d removed, %d Gaussians%s",
            report.step, inserted, removed, report.gaussians, losses,
        )  # fmt: skip
        self._said_at, self._lately = time.monotonic(), [0, 0]

    def _write(self, report: Report) -> None:
        if report.inserted or report.removed:
            for name, value in zip(Report._fields[:3], report):
                self._writer.add_scalar(f"d2/{name}", value, report.step)
        if report.step % MEANS_OVER == 0:
            for name, mean in self._terms.items():
                self._writer.add_scalar(f"d2/{name}", mean.now(), report.step)

    def _name_short_schedules(self, iterations: int) -> None:
        short = [name for name, stop in self._stops() if stop < iterations / 10]
        if short:
            log.warning(
                "%s: over at step %d of %d, before a tenth of the run: write iterations = %d into the configuration "
                "and leave start, stop, every and budget_per_view out of its tables",
                " and ".join(short), max(stop for name, stop in self._stops() if name in short), iterations, iterations,
            )  # fmt: skip

    def _notice_late(self, step: int) -> None:
        stops = [stop for _, stop in self._stops()]
        if stops and step == 10 * max(stops):
            log.warning(
                "step %d, and the last edit was due before step %d: if the run is that long, say so by `iterations` in "
                "the configuration or in D2Hooks.attach",
                step, max(stops),
            )  # fmt: skip

    def _stops(self) -> Iterable[tuple[str, int]]:
        return [(name, hook.window.stop) for name, hook in self.hooks.items() if hook.window.stop is not None]


class _Mean:
    """The mean of a term since it was last read; tensors are added where they are, so that nothing waits for a GPU."""

    def __init__(self) -> None:
        self._sum: Tensor | None = None
        self._count = 0
        self._first: Tensor | None = None
        self._last = float("nan")

    def add(self, term: Tensor) -> None:
        self._first = term if self._first is None else self._first
        self._sum, self._count = term if self._sum is None else self._sum + term, self._count + 1

    @property
    def first(self) -> float:
        return float("nan") if self._first is None else float(self._first)

    def now(self) -> float:
        """The mean; what it was at the last reading if nothing came since."""
        if self._sum is not None:
            self._last, self._sum, self._count = float(self._sum) / self._count, None, 0
        return self._last


def be_heard() -> None:
    """Let lines of this package reach a person where the program has set up no logging of its own."""
    logger = logging.getLogger("d2_plugin")
    if logger.level == logging.NOTSET:
        logger.setLevel(logging.INFO)
    if not logger.handlers and not logging.getLogger().handlers:
        handler = _Beside()
        handler.setFormatter(logging.Formatter("d2: %(message)s"))
        logger.addHandler(handler)


class _Beside(logging.Handler):
    """Writes to stderr, above a progress bar where there is one."""

    def emit(self, record: logging.LogRecord) -> None:
        line = self.format(record)
        if "tqdm" in sys.modules:
            sys.modules["tqdm"].tqdm.write(line, file=sys.stderr)
        else:
            sys.stderr.write(f"{line}\n")


def _schedule(name: str, hook: Hook) -> str:
    window = hook.window
    until = "the end" if window.stop is None else f"{window.stop}"
    return f"{name} {window.start} to {until}" + (f" every {window.every}" if window.every > 1 else "")


def _at_exit(telling: Telling) -> None:
    """Say the summary when the process ends, unless the run is gone by then."""
    held = weakref.ref(telling)

    def end() -> None:
        told = held()
        if told is not None:
            told.end()

    atexit.register(end)
