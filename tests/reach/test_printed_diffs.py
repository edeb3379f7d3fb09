"""What a page prints goes into the file of the commit that it names: three lines and an import, each at its place."""

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
    def added(self) -> list[str]:
        return [line[1:].strip() for line in self.lines if line.startswith("+")]


def pages() -> list[str]:
    """Those that print a diff of a named file."""
    return sorted(page.stem for page in PAGES.glob("*.md") if "```diff\n--- a/" in page.read_text())


def printed(page: str) -> tuple[str, list[Hunk]]:
    """The file that the first diff on a page is of, and its places."""
    file, body = re.search(r"```diff\n--- a/(\S+)\n(.*?)```", (PAGES / f"{page}.md").read_text(), re.DOTALL).groups()
    assert "--- a/" not in body, "one file for each page"
    found: list[Hunk] = []
    for line in body.splitlines():
        if head := _HUNK.match(line):
            found.append(Hunk(*(int(number) for number in head.groups()), []))
        elif found:
            found[-1].lines.append(line or " ")  # an empty line of context may have lost its space
    return file, found


def checksum(line: str) -> str:
    """Of a line's words: indentation and blanks at the end are left to `git apply --ignore-whitespace`."""
    return f"{zlib.crc32(' '.join(line.split()).encode()):08x}"


IMPORT = "from d2_plugin import D2Hooks"


def test_every_page_with_a_diff_names_a_commit_that_is_known() -> None:
    assert set(pages()) <= set(COMMITS), "add the file's checksums to tests/data/commits.json"
    assert len(pages()) >= 9


@pytest.mark.parametrize("page", pages())
class TestEveryPage:
    def test_it_names_the_commit_that_its_lines_are_from(self, page: str) -> None:
        assert COMMITS[page]["commit"] in (PAGES / f"{page}.md").read_text()

    def test_its_context_stands_in_that_file_at_the_printed_lines(self, page: str) -> None:
        file, hunks = printed(page)
        checksums = COMMITS[page]["files"][file].split()
        moved = 0
        for hunk in hunks:
            context = [line[1:] for line in hunk.lines if not line.startswith("+")]
            for number, line in enumerate(context, hunk.old):
                assert checksums[number - 1] == checksum(line), f"line {number} of {file} is not '{line.strip()}'"
            after = [line for line in hunk.lines if not line.startswith("-")]
            assert (hunk.olds, hunk.new, hunk.news) == (len(context), hunk.old + moved, len(after)), "for git"
            moved += hunk.news - hunk.olds

    def test_it_adds_an_import_and_three_lines(self, page: str) -> None:
        added = [line for hunk in printed(page)[1] for line in hunk.added]
        assert added.count(IMPORT) == 1
        lines = [line for line in added if line != IMPORT]
        assert len(lines) == 3
        for word in (r"D2Hooks\.attach\(", r"loss = loss \+ \S*d2\.loss\(", r"d2\.step\("):
            assert sum(bool(re.search(word, line)) for line in lines) == 1


@pytest.mark.parametrize("page", sorted(path.stem for path in PAGES.glob("*.md")))
def test_the_python_of_a_page_says_where_its_names_come_from(page: str) -> None:
    for block in re.findall(r"```python\n(.*?)```", (PAGES / f"{page}.md").read_text(), re.DOTALL):
        imports = re.findall(r"^from .*", block, re.MULTILINE)
        exec("\n".join(imports), known := {})
        used = set(re.findall(r"\b(?:PriorKey|KeysByPose|Path)\b", block))
        assert used <= set(known), "the page does not import it"
