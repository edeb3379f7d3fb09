"""Rows of a benchmark, whose file is looked at before anything is measured."""

from contextlib import suppress
from pathlib import Path

from d2_plugin.runs.rows import append_rows


def begin_rows(path: Path) -> None:
    """Make sure, before anything is measured, that rows can be added to a file.

    Raises:
        D2Error: it cannot be written, or holds something else.
    """
    absent = not path.exists()
    append_rows(path, [])
    if absent:
        with suppress(OSError):
            path.unlink()
