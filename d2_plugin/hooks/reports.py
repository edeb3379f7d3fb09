"""What D2 did: a line when it is attached, one now and then, one at the end; to the log, a callback, TensorBoard."""

from __future__ import annotations

import atexit
import logging
import sys
import time
import weakref
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

from torch import Tensor

from d2_plugin.hooks import HOOKS
from d2_plugin.hooks.hook import Hook, HookConfig
from d2_plugin.hooks.prior import PriorLoader
from d2_plugin.protocol import Backbone, schedule_step
from d2_plugin.values import counted

log = logging.getLogger(__name__)

PAUSE = 30.0
"""Least number of seconds between two lines of progress."""

MEANS_OVER = 10
"""Steps over which a loss is averaged for TensorBoard: reading it stops the GPU."""

LAST = 100
"""Terms that a mean looks back over, with weights that fall: where nothing is inserted none is read before the end."""


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


OnReport = Callable[[Report], None]


class ScalarWriter(Protocol):
    """A TensorBoard SummaryWriter, or anything with its `add_scalar`."""

    def add_scalar(self, tag: str, value: float, step: int) -> Any: ...


class RunLog:
    """Counts what D2 does and logs it; silent until `start`. Nothing that trains depends on it."""

    def __init__(self, hooks: Mapping[str, Hook]) -> None:
        self.hooks = hooks
        self.inserted = self.removed = self.capped = self.gaussians = self.last_step = self._at_first = 0
        self._started, self._ended = False, False
        self._on_report: OnReport | None = None
        self._writer: ScalarWriter | None = None
        self._logged_at = float("-inf")
        self._terms: dict[str, _Mean] = {}
        self._since = [0, 0]
        """Insertions and removals since the last line of progress."""

    def start(
        self,
        backbone: Backbone,
        prior: PriorLoader | None,
        iterations: int | None,
        on_report: OnReport | None,
        writer: ScalarWriter | None,
    ) -> None:
        """Log from now on; first what was attached, which cameras have priors, and schedules that do not fit the run.

        Args:
            backbone: what D2 is attached to.
            prior: where the hooks look up depth; None where there is no hook.
            iterations: length of the run, if it is known.
            on_report: called with the `Report` of every step.
            writer: gets the counts of every change and the mean of every loss.
        """
        self._started, self._on_report, self._writer, self._at_first = True, on_report, writer, len(backbone)
        add_default_handler()
        if not self.hooks:
            log.info("attached without a hook: the trainer runs as without D2")
            return
        cameras = ", ".join(map(str, getattr(None if prior is None else prior.store, "cameras", ())))
        schedules = ", ".join(_schedule(name, hook.config) for name, hook in self.hooks.items())
        log.info(
            "attached by %s to %d Gaussians; priors of cameras %s; %s",
            type(backbone).__name__, len(backbone), cameras or "unknown", schedules,
        )  # fmt: skip
        if prior is not None and prior.verdict:
            log.info("%s", prior.verdict)
        if iterations is None:
            self._warn_of_default_schedules()
        else:
            paced = schedule_step(backbone, iterations)
            if paced != iterations:
                log.info("schedules count as the optimizer does: %d steps are worth %d of Adam's", iterations, paced)
            self._warn_of_short_schedules(paced)
        end = weakref.WeakMethod(self.end)  # the run may be gone when the process ends
        atexit.register(lambda: alive() if (alive := end()) else None)

    def record_loss(self, name: str, term: Tensor) -> None:
        """A hook's term of the loss in the present step."""
        if self._started:
            self._terms.setdefault(name, _Mean()).add(term.detach())

    def record_step(self, report: Report) -> None:
        """What a step changed."""
        self.inserted, self.removed = self.inserted + report.inserted, self.removed + report.removed
        self.gaussians, self.last_step = report.gaussians, report.step
        if not self._started:
            return
        self._since = [self._since[0] + report.inserted, self._since[1] + report.removed]
        if self._on_report is not None:
            self._on_report(report)
        if self._writer is not None:
            self._write(report, self._writer)
        if (report.inserted or report.removed) and time.monotonic() - self._logged_at >= PAUSE:
            self._log_progress(report)

    @property
    def others(self) -> int:
        """How many Gaussians the trainer's own densification has added, less those that it removed."""
        return self.gaussians - self._at_first - self.inserted + self.removed

    def summary(self) -> str:
        """What D2 did, in one line."""
        above = f" ({self.capped} above max_gaussians)" if self.capped else ""
        changes = f"{self.inserted} inserted, {self.removed} removed{above}, {self.others:+d} by the trainer itself"
        losses = [f"{name} {mean.first:.3g} at first, {mean.now():.3g} at last" for name, mean in self._terms.items()]
        after = f"{counted(self.gaussians, 'Gaussian')} after step {self.last_step}"
        return "; ".join([f"{', '.join(self.hooks) or 'no hook'}: {changes}, {after}", *losses])

    def end(self) -> None:
        """Log the summary, once; called when the process ends."""
        if self._started and self.last_step and not self._ended:
            self._ended = True
            log.info("%s", self.summary())

    def _log_progress(self, report: Report) -> None:
        losses = "".join(f", {name} {mean.now():.3g}" for name, mean in self._terms.items())
        inserted, removed = self._since
        log.info(
            "step %d: %d inserted, %d removed, %d Gaussians%s",
            report.step, inserted, removed, report.gaussians, losses,
        )  # fmt: skip
        self._logged_at, self._since = time.monotonic(), [0, 0]

    def _write(self, report: Report, writer: ScalarWriter) -> None:
        if report.inserted or report.removed:
            for name, value in zip(Report._fields[:3], report):
                writer.add_scalar(f"d2/{name}", value, report.step)
        if report.step % MEANS_OVER == 0:
            for name, mean in self._terms.items():
                writer.add_scalar(f"d2/{name}", mean.now(), report.step)

    def _warn_of_short_schedules(self, iterations: int) -> None:
        short = [name for name, stop in self._stops() if stop < iterations / 10]
        if short:
            log.warning(
                "%s: over at step %d of %d, before a tenth of the run: write iterations = %d into the configuration "
                "and leave start, stop, every and budget_per_view out of its tables",
                " and ".join(short), max(stop for name, stop in self._stops() if name in short), iterations, iterations,
            )  # fmt: skip

    def _warn_of_default_schedules(self) -> None:
        known = [name for name, _ in self._stops() if name in HOOKS]
        default = [n for n in known if _schedule(n, self.hooks[n].config) == _schedule(n, HOOKS[n].config())]
        if default:
            log.warning(
                "%s: the length of the run is not known, and the default schedule ends at step %d: give iterations to "
                "D2Hooks, or write it into the configuration",
                " and ".join(default), max(stop for name, stop in self._stops() if name in default),
            )  # fmt: skip

    def _stops(self) -> Iterable[tuple[str, int]]:
        return [(name, hook.config.stop) for name, hook in self.hooks.items() if hook.config.stop is not None]


class _Mean:
    """Mean of a term since it was last read, or of its last hundred; summed where it is: nothing waits for a GPU."""

    def __init__(self) -> None:
        self._mean: Tensor | None = None
        self._count = 0
        self._first: Tensor | None = None
        self._last = float("nan")

    def add(self, term: Tensor) -> None:
        self._first = term if self._first is None else self._first
        self._count += 1
        self._mean = term if self._mean is None else self._mean + (term - self._mean) / min(self._count, LAST)

    @property
    def first(self) -> float:
        return float("nan") if self._first is None else float(self._first)

    def now(self) -> float:
        """The mean; what it was at the last reading if nothing came since."""
        if self._mean is not None:
            self._last, self._mean, self._count = float(self._mean), None, 0
        return self._last


def add_default_handler() -> None:
    """Show lines of this package on stderr where the program has set up no logging of its own."""
    logger = logging.getLogger("d2_plugin")
    if logger.level == logging.NOTSET:
        logger.setLevel(logging.INFO)
    if not logger.handlers and not logging.getLogger().handlers:
        handler = _StderrHandler()
        handler.setFormatter(logging.Formatter("d2: %(message)s"))
        logger.addHandler(handler)


class _StderrHandler(logging.Handler):
    """Writes to stderr, above a progress bar where there is one."""

    def emit(self, record: logging.LogRecord) -> None:
        line = self.format(record)
        if "tqdm" in sys.modules:
            sys.modules["tqdm"].tqdm.write(line, file=sys.stderr)
        else:
            sys.stderr.write(f"{line}\n")


def _schedule(name: str, config: HookConfig) -> str:
    until = "the end" if config.stop is None else f"{config.stop}"
    return f"{name} {config.start} to {until}" + (f" every {config.every}" if config.every > 1 else "")
