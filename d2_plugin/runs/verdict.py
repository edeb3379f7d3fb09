"""What runs over several seeds say: means with their standard error, and when a difference means something.

It takes at least three seeds, and more than two standard errors.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import mean, variance

from d2_plugin.runs.tables import STUDY_COLUMNS, Column, Table

LEAST_SEEDS = 3
"""Two seeds agree by chance in far too many experiments, and one has no spread at all."""

_COUNTS = {0: "no seed", 1: "one seed", 2: "two seeds"}


def seeds_in_words(count: int) -> str:
    """What stands beside a mean: `one seed` and `two seeds`, which claim nothing, or the number."""
    return _COUNTS.get(count, str(count))


@dataclass(frozen=True)
class Estimate:
    """The mean over the seeds, and how far it may be off."""

    mean: float
    error: float | None
    """Standard error of the mean, s / sqrt(n) with the sample deviation s; None for a single seed."""
    seeds: int

    @classmethod
    def of(cls, values: Sequence[float | None]) -> Estimate | None:
        """Of what was measured; None where nothing was."""
        known = [value for value in values if value is not None]
        if not known:
            return None
        error = math.sqrt(variance(known) / len(known)) if len(known) > 1 else None
        return cls(mean(known), error, len(known))

    def text(self, form: str) -> str:
        """Such as `28.94 ± 0.17`, or the mean alone where there is no error."""
        error = "" if self.error is None else f" ± {format(self.error, form)}"
        return f"{format(self.mean, form)}{error}"


def estimated(values: Sequence[float | None], form: str) -> str:
    """The mean over the seeds with its error; `-` where nothing was measured."""
    estimate = Estimate.of(values)
    return "-" if estimate is None else estimate.text(form)


@dataclass(frozen=True)
class Margin:
    """By how much one variant is better than another, over the seeds."""

    value: float
    """Difference of the means; positive where the first one is better."""
    error: float | None
    """Standard error of the difference; None where one of them has a single seed."""
    seeds: int
    """Number of seeds; that of the variant with fewer."""

    @property
    def verdict(self) -> str:
        """`holds` or `fails` beyond two standard errors, `undecided` within; `no verdict` from too few seeds.

        `no difference` where every seed gave exactly the same.
        """
        if self.error is None or self.seeds < LEAST_SEEDS:
            return f"{_COUNTS[self.seeds]}: no verdict"
        if self.value == self.error == 0:
            return "no difference"
        if abs(self.value) <= 2 * self.error:
            return "undecided"
        return "holds" if self.value > 0 else "fails"

    def text(self, digits: int = 2, unit: str = "") -> str:
        """The margin with its standard error, such as `+0.93 ± 0.34 dB`."""
        error = "" if self.error is None else f" ± {self.error:.{digits}f}"
        return f"{self.value:+.{digits}f}{error}" + (f" {unit}" if unit else "")


def margin(ours: Sequence[float], theirs: Sequence[float], larger_is_better: bool) -> Margin:
    """By how much `ours` are better than `theirs`, which are runs of their own: their variances add up.

    The standard error is sqrt(s1^2 / n1 + s2^2 / n2) with the sample variances s^2.
    """
    sign = 1 if larger_is_better else -1
    seeds = min(len(ours), len(theirs))
    error = None
    if seeds > 1:
        error = math.sqrt(variance(ours) / len(ours) + variance(theirs) / len(theirs))
    return Margin(sign * (mean(ours) - mean(theirs)), error, seeds)


Scores = Mapping[str, Sequence[Mapping[str, float | None]]]
"""Name of a variant -> the scores of its runs, one per seed, by the keys of metrics.json."""

EXPLANATION = (
    "Margin of the means with its standard error, metric by metric; positive is better. A verdict needs at least three "
    "seeds and a margin beyond two standard errors."
)


def verdicts_table(scores: Scores, ours: str, others: Sequence[str], title: str) -> Table:
    """Whether one variant is better than others: a row for each that was run, a column for each metric measured."""
    columns = [column for column in STUDY_COLUMNS if _values(scores, ours, column)]
    rows = []
    for other in others:
        cells = []
        for column in columns:
            theirs = _values(scores, other, column)
            measured = margin(_values(scores, ours, column), theirs, column.larger_is_better) if theirs else None
            digits = 2 if column.unit else 4
            cells.append("-" if measured is None else f"{measured.verdict} ({measured.text(digits, column.unit)})")
        rows += [(other, *cells)] if {*cells} - {"-"} else []
    return Table((title, *(column.title for column in columns)), tuple(rows))


def _values(scores: Scores, name: str, column: Column) -> list[float]:
    return [value for run in scores.get(name, ()) if (value := run.get(column.key)) is not None]
