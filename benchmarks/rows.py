"""What all benchmarks do with their rows: their file is looked at before anything is measured, and named at the end."""

from collections.abc import Iterable, Sequence
from pathlib import Path

from d2_plugin.runs.rows import Row, append_rows
from d2_plugin.runs.tables import Table, markdown


def begin_rows(path: Path) -> None:
    """Make sure, before anything is measured, that rows can be added to a file.

    Raises:
        D2Error: it cannot be written, or holds something else.
    """
    absent = not path.exists()
    append_rows(path, [])
    if absent:
        path.unlink(missing_ok=True)


def told(tables: Iterable[tuple[str, Table]], path: Path, *before: str) -> str:
    """What a benchmark prints: what stands before its tables, these with their titles, and where the rows lie."""
    shown = [part for title, table in tables for part in (title, markdown(table))]
    return "\n\n".join([*before, *shown, f"rows are in {path}; `python -m benchmarks report` draws them"])


def grouped(rows: Sequence[Row], *names: str) -> dict[tuple, list[Row]]:
    """The rows that agree in these fields, by their values, in order of appearance."""
    groups: dict[tuple, list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row.get(name) for name in names), []).append(row)
    return groups
