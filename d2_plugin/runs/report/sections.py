"""What a part of the report is: text, plots, tables, and where its figures come from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from d2_plugin.runs.markup import Table
from d2_plugin.runs.provenance import provenance
from d2_plugin.runs.rows import Row


@dataclass(frozen=True)
class Section:
    """One part of the report; `figures` are SVG by name, `tables` come with a title."""

    name: str
    title: str
    text: str
    figures: dict[str, str] = field(default_factory=dict)
    tables: tuple[tuple[str, Table], ...] = ()
    details: tuple[tuple[str, Table], ...] = ()
    """Longer tables, which the page folds and the Markdown leaves out."""
    sources: tuple[str, ...] = ()
    headlines: tuple[str, ...] = ()
    """The section in a few of its figures, for the top of the page."""


def sources_of(rows: Sequence[Row]) -> tuple[str, ...]:
    """One sentence per machine, commit and command that the rows come from."""
    return tuple(dict.fromkeys(_source(row) for row in rows))


def _source(row: Row) -> str:
    if row["device"] is None:
        return f"`{row['command']}`, which recorded neither machine nor commit."
    return provenance(row)


def cases_of(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """The rows by case, in order of appearance."""
    return {case: [row for row in rows if row["case"] == case] for case in dict.fromkeys(row["case"] for row in rows)}


def distinct(rows: Sequence[Row], name: str) -> list[float]:
    """The values of a field, ascending, each once."""
    return sorted({row[name] for row in rows})
