"""Applies the diff of a migration page in docs/attach to the source of a mimic."""

from __future__ import annotations

import inspect
import re
import sys
from pathlib import Path
from types import ModuleType

PAGES = Path(__file__).resolve().parents[2] / "docs" / "attach"


def added_lines(page: str) -> list[tuple[str, str, str]]:
    """(context before, added line, context after) of every line that the page's first diff adds; all stripped."""
    text = (PAGES / f"{page}.md").read_text()
    lines = ["", *re.search(r"```diff\n(.*?)```", text, re.S)[1].splitlines(), ""]
    assert not [line for line in lines if line.startswith("-") and not line.startswith("---")], "lines are only added"
    found = []
    for i, line in enumerate(lines):
        if line.startswith("+") and not line.startswith("+++"):
            before, after = (x[1:].strip() if x.startswith(" ") else "" for x in (lines[i - 1], lines[i + 1]))
            found.append((before, line[1:].strip(), after))
    return found


def attached(mimic: ModuleType, page: str) -> ModuleType:
    """The mimic with the page's lines in its `training`, which may be another mimic's."""
    mimic = sys.modules[mimic.training.__module__]
    lines = inspect.getsource(mimic).splitlines()
    for before, added, after in added_lines(page):
        if re.match(r"(from|import) ", added):
            lines.insert(next(i for i, x in enumerate(lines) if x.startswith("from __future__")) + 1, added)
            continue
        at = _place(lines, before, after)
        indent = re.match(r" *", lines[at])[0]
        at += lines[at].strip() == before
        lines.insert(at, indent + added)
    module = ModuleType(f"{mimic.__name__}_attached")
    module.__package__ = mimic.__package__
    sys.modules[module.__name__] = module
    exec(compile("\n".join(lines), f"{mimic.__file__} with {page}.md", "exec"), vars(module))
    return module


def _place(lines: list[str], before: str, after: str) -> int:
    """The line of context: the one after the added line where that is there, else the one before."""
    for context in (after, before):
        places = [i for i, line in enumerate(lines) if context and line.strip() == context]
        if len(places) == 1:
            return places[0]
    raise AssertionError(f"neither '{before}' nor '{after}' is once in the mimic: page and mimic have come apart")
