"""What the paper's tables say about the full method, tested on runs of one's own: metric by metric, over the seeds."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from d2_plugin.runs.markup import Table
from d2_plugin.runs.tables import STUDY_COLUMNS, Column
from d2_plugin.runs.verdict import Margin, margin

Scores = Mapping[str, Sequence[Mapping[str, float | None]]]
"""Name of a variant -> the scores of its runs, one per seed, by the keys of metrics.json."""

EXPLANATION = (
    "Margin of the means with its standard error, metric by metric; positive is better. A verdict needs at least three "
    "seeds and a margin beyond two standard errors."
)


@dataclass(frozen=True)
class Claim:
    """The claim that one variant is better than another in one metric, and the margin that was measured."""

    other: str
    column: Column
    margin: Margin

    def __str__(self) -> str:
        digits = 2 if self.column.unit else 4
        return f"{self.margin.verdict} ({self.margin.text(digits, self.column.unit)})"


def claims(scores: Scores, ours: str, others: Iterable[str], column: Column = STUDY_COLUMNS[0]) -> list[Claim]:
    """One claim per other variant that was run and scored in that metric; none where `ours` was not."""
    mine = _values(scores, ours, column)
    if not mine:
        return []
    return [
        Claim(other, column, margin(mine, theirs, column.larger_is_better))
        for other in others
        if (theirs := _values(scores, other, column))
    ]


def claims_table(scores: Scores, ours: str, others: Sequence[str], title: str) -> Table:
    """One row per other variant, one column per metric that was measured."""
    columns = [column for column in STUDY_COLUMNS if _values(scores, ours, column)]
    found = {(c.other, c.column.key): str(c) for column in columns for c in claims(scores, ours, others, column)}
    rows = tuple(
        (other, *(found.get((other, column.key), "-") for column in columns))
        for other in others
        if any((other, column.key) in found for column in columns)
    )
    return Table((title, *(column.title for column in columns)), rows)


def _values(scores: Scores, name: str, column: Column) -> list[float]:
    return [value for run in scores.get(name, ()) if (value := run.get(column.key)) is not None]
