"""What a page prints goes into the file of the commit that it names: three lines and an import, each at its place."""

from __future__ import annotations

import json
import re
import zlib
from pathlib import Path
from typing import NamedTuple

import pytest

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


IMPORT = "from d2_plugin import D2Hooks"


def test_every_page_with_a_diff_names_a_commit_that_is_known() -> None:
    assert set(pages()) <= set(COMMITS), "add the file's checksums to tests/data/commits.json"
    assert len(pages()) >= 9


@pytest.mark.parametrize("page", pages())
class TestEveryPage:
    def test_it_names_the_commit_that_its_lines_are_from(self, page: str) -> None:
        assert COMMITS[page]["commit"] in (PAGES / f"{page}.md").read_text()

    def test_its_context_stands_in_that_file_at_the_printed_lines(self, page: str) -> None:
        patch = printed(page)
        lines = checksums(page, file_of(patch))
        moved = 0
        for hunk in hunks(patch):
            for number, line in hunk.context.items():
                assert lines[number - 1] == checksum(line), f"line {number} of {file_of(patch)} is not '{line.strip()}'"
            after = [line for line in hunk.lines if not line.startswith("-")]
            assert (hunk.olds, hunk.new, hunk.news) == (len(hunk.context), hunk.old + moved, len(after)), "for git"
            moved += hunk.news - hunk.olds

    def test_it_adds_an_import_and_three_lines(self, page: str) -> None:
        added = [line.strip() for hunk in hunks(printed(page)) for line in hunk.added]
        assert added.count(IMPORT) == 1
        lines = [line for line in added if line != IMPORT]
        assert len(lines) == 3
        for word in (r"D2Hooks\.attach\(", r"loss = loss \+ \S*d2\.loss\(", r"d2\.step\("):
            assert sum(bool(re.search(word, line)) for line in lines) == 1
