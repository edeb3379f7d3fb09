"""The part of the report about the code itself: the same run by several commits, whatever command measured it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

from d2_plugin.runs.markup import Table
from d2_plugin.runs.report.scores import Group, known, one_per_seed, scored, scores_table
from d2_plugin.runs.report.sections import Section, sources_of
from d2_plugin.runs.rows import Row
from d2_plugin.runs.tables import STUDY_COLUMNS
from d2_plugin.runs.verdict import LEAST_SEEDS, margin

KINDS = ("training", "ablation")
"""Rows that hold whole runs at a given number of steps."""


class Same(NamedTuple):
    """What makes runs of different commits the same: all but the seed."""

    case: str
    method: str
    steps: int


def versions(rows: Sequence[Row]) -> Section | None:
    """Scores of each run that two commits or more have measured; None where there is no such run."""
    found: dict[Same, dict[str, list[Row]]] = {}
    for row in scored([row for row in rows if row["kind"] in KINDS]):
        found.setdefault(_same(row), {}).setdefault(_commit(row), []).append(row)
    enough = {
        same: {commit: mine for commit, rs in commits.items() if len(mine := one_per_seed(rs)) >= LEAST_SEEDS}
        for same, commits in found.items()
    }
    several = {same: commits for same, commits in enough.items() if len(commits) > 1}
    if not several:
        return None
    groups = [
        Group(f"{same.case}, {same.method}, {same.steps} steps", commit, mine)
        for same, commits in several.items()
        for commit, mine in commits.items()
    ]
    used = [row for group in groups for row in group.rows]
    return Section(
        "versions",
        "Versions: the same run by several commits",
        "The recordings, cameras, method and steps of a block are the same, the code is not. Ablations and single runs "
        "count alike. Commits with fewer than three seeds are left out, since they claim nothing. Margins are those of "
        "the commit that stands first; a verdict needs more than two standard errors.",
        tables=(
            ("Mean ± standard error over seeds", scores_table("commit", groups)),
            ("Is the first commit better?", _margins(groups)),
        ),
        sources=sources_of(used),
    )


def _margins(groups: Sequence[Group]) -> Table:
    """The first commit of each block against the others, metric by metric."""
    columns = [column for column in STUDY_COLUMNS if any(known(group, column) for group in groups)]
    header = ("run", "first", "other", *(column.title for column in columns))
    lines = []
    for case in dict.fromkeys(group.case for group in groups):
        first, *others = (group for group in groups if group.case == case)
        for other in others:
            cells = []
            for column in columns:
                ours, theirs = known(first, column), known(other, column)
                made = margin(ours, theirs, column.larger_is_better) if ours and theirs else None
                digits = 2 if column.unit else 4
                cells.append("-" if made is None else f"{made.verdict} ({made.text(digits, column.unit)})")
            lines.append((case, first.name, other.name, *cells))
    return Table(header, tuple(lines))


def _same(row: Row) -> Same:
    """Rows of `d2 ablate` say cameras for views and full for D²; a size that only the command tells is added."""
    case = re.sub(r"(\d+) cameras", r"\1 views", row["case"])
    smaller = re.search(r"--downscale (\d+)", row["command"] or "")
    if smaller and smaller[1] != "1" and "size" not in case:
        case += f", 1/{smaller[1]} size"
    method = re.sub(r"^(\S+) full$", r"\1 + D2", re.sub(r"^(\S+) backbone$", r"\1", row["method"]))
    return Same(case, method, row["iterations"])


def _commit(row: Row) -> str:
    return str(row["commit"] or row["version"])
