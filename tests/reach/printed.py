"""The diffs that pages in docs/attach print, and the lines of the files that they are for.

Of those files only a checksum of each line is kept (tests/data/commits.json): enough to hold every line of context to
its place in the named commit, and none of their text.
"""

from __future__ import annotations

import json
import re
import zlib
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
PAGES = ROOT / "docs" / "attach"
COMMITS: dict[str, dict] = json.loads((ROOT / "tests" / "data" / "commits.json").read_text())
"""By page: repository, commit, and for each file the checksums of its lines, spaces aside."""

_HUNK = re.compile(r"@@ -(?P<old>\d+),(?P<olds>\d+) \+(?P<new>\d+),(?P<news>\d+) @@")


class Hunk(NamedTuple):
    """One place of a diff: numbers of its first line before and after, how many there are, and the lines."""

    old: int
    olds: int
    new: int
    news: int
    lines: list[str]

    @property
    def context(self) -> dict[int, str]:
        """Lines that must stand in the file, by their number in it."""
        kept = [line[1:] for line in self.lines if not line.startswith("+")]
        return {self.old + i: line for i, line in enumerate(kept)}

    @property
    def added(self) -> list[str]:
        return [line[1:] for line in self.lines if line.startswith("+")]


def pages() -> list[str]:
    """Those that print a diff of a named file."""
    return sorted(page.stem for page in PAGES.glob("*.md") if re.search(r"```diff\n--- a/", page.read_text()))


def printed(page: str) -> str:
    """The first diff of a file on a page as a patch; an empty line of context may have lost its space."""
    text = re.search(r"```diff\n(--- a/.*?)```", (PAGES / f"{page}.md").read_text(), re.DOTALL)
    assert text, f"{page}.md prints no diff"
    return "".join(f"{line or ' '}\n" for line in text[1].splitlines())


def file_of(patch: str) -> str:
    found = re.findall(r"^--- a/(.*)$", patch, re.MULTILINE)
    assert len(found) == 1, f"one file for each page, got {found}"
    return found[0]


def hunks(patch: str) -> list[Hunk]:
    found: list[Hunk] = []
    for line in patch.splitlines():
        if head := _HUNK.match(line):
            found.append(Hunk(*(int(number) for number in head.groups()), []))
        elif found:
            found[-1].lines.append(line)
    return found


def checksum(line: str) -> str:
    """Of a line's words: indentation and blanks at the end are left to `git apply --ignore-whitespace`."""
    return f"{zlib.crc32(' '.join(line.split()).encode()):08x}"


def checksums(page: str, file: str) -> list[str]:
    return COMMITS[page]["files"][file].split()
