"""Held-out scores of several runs as a table: mean ± standard error over the seeds, the best of each metric."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import mean
from typing import NamedTuple

from d2_plugin.runs.markup import Table
from d2_plugin.runs.rows import Row
from d2_plugin.runs.tables import STUDY_COLUMNS, Column
from d2_plugin.runs.verdict import Estimate, seeds_in_words

COSTS = (("Gaussians", "gaussians", ".0f"), ("prior s", "prior_seconds", ".1f"), ("train s", "seconds", ".1f"))


class Group(NamedTuple):
    """Runs of one variant on one recording, which differ by seed."""

    case: str
    name: str
    rows: Sequence[Row]


def score(row: Row, key: str) -> float | None:
    """A held-out score of one run, None where it was not measured."""
    return (row.get("scores") or {}).get(key)


def psnr(row: Row) -> float:
    """The held-out PSNR of one of the rows that `scored` gives, dB."""
    return row["scores"]["psnr"]


def scored(rows: Sequence[Row]) -> list[Row]:
    """The rows of runs that held a camera out."""
    return [row for row in rows if score(row, "psnr") is not None]


def one_per_seed(rows: Sequence[Row]) -> list[Row]:
    """Runs that differ by seed alone, each seed once: a run that was repeated with its seed is no further one."""
    return list({row["seed"] if row.get("seed") is not None else row["setting"]: row for row in rows}.values())


def average(rows: Sequence[Row], name: str) -> float:
    """The mean of a field that every row has."""
    return mean(row[name] for row in rows)


def scores_table(what: str, groups: Sequence[Group]) -> Table:
    """One row per group: scores that any run has, Gaussians and times; the best of a recording stand out."""
    columns = [column for column in STUDY_COLUMNS if any(known(group, column) for group in groups)]
    header = ("recording", what, "seeds", *(column.title for column in columns), *(title for title, _, _ in COSTS))
    cells = []
    for group in groups:
        found = [_estimate([score(row, column.key) for row in group.rows], column.form) for column in columns]
        spent = [_estimate([row.get(key) for row in group.rows], form) for _, key, form in COSTS]
        cells.append((group.case, group.name, seeds_in_words(len(group.rows)), *found, *spent))
    best = {(row, place) for place, column in enumerate(columns, start=3) for row in best_of_cases(groups, column)}
    return Table(header, tuple(cells), frozenset(best))


def best_of_cases(groups: Sequence[Group], column: Column) -> list[int]:
    """Index of the group with the best mean of one metric, for each recording that has two groups or more.

    However many seeds it has, since the second best is not the best either: how many stands beside it.
    """
    found = []
    for case in dict.fromkeys(group.case for group in groups):
        values = {
            i: mean(some) for i, group in enumerate(groups) if group.case == case and (some := known(group, column))
        }
        if len(values) > 1:
            choose = max if column.larger_is_better else min
            found.append(choose(values, key=values.__getitem__))
    return found


def known(group: Group, column: Column) -> list[float]:
    """The scores of a group's runs in one metric."""
    return [value for row in group.rows if (value := score(row, column.key)) is not None]


def _estimate(values: Sequence[float | None], form: str) -> str:
    found = Estimate.of(values)
    return "-" if found is None else found.text(form)
