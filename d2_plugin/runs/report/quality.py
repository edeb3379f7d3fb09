"""Sections of the report about runs: held-out scores against minutes, at each length, and of each variant."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from statistics import mean
from typing import NamedTuple

from d2_plugin.runs.report.page import Section, sources_of
from d2_plugin.runs.report.svg import Axis, Plot, Point, Series, figure
from d2_plugin.runs.rows import TRY, Row
from d2_plugin.runs.tables import STUDY_COLUMNS, Column, Table
from d2_plugin.runs.verdict import EXPLANATION, Estimate, estimated, seeds_in_words, verdicts_table

D2, STEREO, BACKBONE = "D²", "stereo alone", "backbone alone"
NAMES = {"full": D2, "+ D2": D2, "mvs_only": STEREO, "backbone": BACKBONE, "": BACKBONE}
"""How the rows of `d2 ablate` and the hooks of `d2 train` are called on the page; others keep their names."""

COSTS = (("Gaussians", "gaussians", ".0f"), ("prior s", "prior_seconds", ".1f"), ("train s", "seconds", ".1f"))


class Group(NamedTuple):
    """Runs of one method and length on one recording, which differ by seed."""

    case: str
    method: str
    length: str
    """`30 s` or `2000 steps`."""
    rows: Sequence[Row]

    @property
    def minutes(self) -> float:
        """Of prior and training; NaN where nobody timed the making of the prior."""
        known = [row for row in self.rows if row.get("prior_seconds", 0.0) is not None]
        return mean(row["seconds"] + row.get("prior_seconds", 0.0) for row in known) / 60 if known else math.nan

    def scores(self, column: Column) -> list[float]:
        """The scores of the runs that have one in this metric."""
        return [value for row in self.rows if (value := row["scores"].get(column.key)) is not None]


QUALITY = {
    "quality": (
        "Quality against minutes",
        "PSNR of cameras that trained nothing, against the CPU minutes that prior and training took on one thread; "
        "upper left is better. All methods have the same starting points, images and backbone settings; a mark is the "
        "mean over the seeds.",
        "CPU minutes, prior included",
    ),
    "training": (
        "Runs of `d2 train`",
        "PSNR of cameras that trained nothing, against the minutes that prior and training took; upper left is "
        "better. A mark is the mean over the seeds. A prior that several runs share counts where it was built.",
        "minutes, prior included",
    ),
    "ablation": (
        "Ablation: what each part is worth",
        "Held-out scores of the paper's variants on the same recording, points and number of steps.",
        None,
    ),
}
"""By the kind of row, those of `d2 bench training`, of run folders and of `d2 ablate`: the title of the section, its
text, and the label of the axis of time where the section has a plot."""


def section(name: str, rows: Sequence[Row]) -> Section:
    """Held-out scores of one kind of row (see `QUALITY`): against time, at each length, and whether D² is better."""
    title, text, time = QUALITY[name]
    groups = groups_of(rows)
    order = _order(groups)
    failed = [row for row in rows if row["failed"]]
    tables = []
    for unit, where in (("steps", "steps, mean ± standard error over seeds"), ("s", "time of training, the same")):
        if mine := [group for group in groups if _length(group)[0] == unit]:
            tables.append((f"At equal {where}", scores_table(mine)))
    tables += [(f"Is {D2} better?", order)] if order.rows else []
    if failed:
        cells = tuple((row["case"], row["method"], row["setting"], row["failed"]) for row in failed)
        tables.append(("Runs without a score", Table(("recording", "method", "run", "why"), cells)))
    if any(row.get("mono_emulated") for row in rows):
        text += " Monocular depth of some recordings is emulated, not predicted."
    text += " What has no known time of its prior is not drawn." if any(math.isnan(g.minutes) for g in groups) else ""
    text += f" {EXPLANATION}" if order.rows else ""
    figures = {} if time is None else {name: _figure(groups, time)}
    return Section(name, title, text, figures, tuple(tables), sources_of(rows))


def groups_of(rows: Sequence[Row]) -> list[Group]:
    """The runs that have a score by recording, length and method: recordings with real depth first, D² first of each.

    Tries are left out, and a run that was repeated with its seed counts once.
    """
    scored = [row for row in rows if (row.get("scores") or {}).get("psnr") is not None and row.get("target") != TRY]
    backbones = list(map(_backbone, scored))
    usual = max(backbones, key=backbones.count, default="")
    runs: dict[tuple[str, str, str], list[Row]] = {}
    for row in scored:
        length = row.get("target") or f"{row['iterations']} steps"
        runs.setdefault((row["case"], length, _method(row["method"], usual)), []).append(row)
    groups = []
    for (case, length, method), mine in runs.items():
        groups.append(Group(case, method, length, list({row.get("seed"): row for row in mine}.values())))
    cases = list(dict.fromkeys(group.case for group in groups))

    def place(group: Group) -> tuple[bool, int, tuple[str, float], tuple[int, str]]:
        emulated = bool(group.rows[0].get("mono_emulated"))
        return emulated, cases.index(group.case), _length(group), _rank(group.method)

    return sorted(groups, key=place)


def _length(group: Group) -> tuple[str, float]:
    """Lengths in steps apart from those in seconds, shortest first."""
    size, _, unit = group.length.partition(" ")
    return unit, float(size)


def _rank(method: str) -> tuple[int, str]:
    """D², stereo alone and the backbone first."""
    known = (D2, STEREO, BACKBONE)
    return next((place for place, name in enumerate(known) if method.startswith(name)), len(known)), method


def _backbone(row: Row) -> str:
    return row["method"].partition(",")[0].partition(" ")[0]


def _method(text: str, usual: str) -> str:
    """`yang4d full, label` as `D², label`, with the backbone's name behind it where that is not the usual one."""
    named, comma, label = text.partition(", ")
    backbone, _, preset = named.partition(" ")
    other = "" if backbone == usual else f" ({backbone})"
    return NAMES.get(preset, preset.removeprefix("+ ")) + other + comma + label


def _figure(groups: Sequence[Group], time: str) -> str:
    """PSNR over minutes, a plot for each recording; a method has one colour in all of them, and a line from length to
    length. Lengths in seconds alone where there are any, since times of two campaigns do not compare, the usual
    backbone alone, and where there are such, recordings of which all instants train."""
    groups = [g for g in groups if f" ({_backbone(g.rows[0])})" not in g.method and not math.isnan(g.minutes)]
    groups = [group for group in groups if "of the instants" not in group.case] or groups
    methods = sorted({group.method for group in groups}, key=_rank)
    plots = []
    for case in dict.fromkeys(group.case for group in groups):
        mine = [group for group in groups if group.case == case]
        drawn = [group for group in mine if group.length.endswith(" s")] or mine
        series = []
        for color, method in enumerate(methods):
            points = sorted(_point(group) for group in drawn if group.method == method)
            series.append(Series(method, tuple(points), tuple((p.x, p.y) for p in points), color))
        x = Axis.around(time, [group.minutes for group in drawn], log=True)
        y = Axis.around("held-out PSNR, dB", [point.y for each in series for point in each.points])
        plots.append(Plot(case, x, y, tuple(series)))
    return figure(plots, "Held-out PSNR against minutes", columns=3, size=(360, 320))


def _point(group: Group) -> Point:
    psnr = Estimate.of(group.scores(STUDY_COLUMNS[0]))
    assert psnr is not None  # `groups_of` leaves out what has none
    note = f"{group.method}, {group.length}: {psnr.text('.2f')} dB in {group.minutes:.2f} minutes"
    return Point(group.minutes, psnr.mean, f"{note} ({seeds_in_words(psnr.seeds)} seeds)" if psnr.seeds > 2 else note)


def scores_table(groups: Sequence[Group], columns: Sequence[Column] = STUDY_COLUMNS) -> Table:
    """One row per group: scores that any run has, Gaussians and times; the best of a recording and length stand out."""
    columns = [column for column in columns if any(group.scores(column) for group in groups)]
    titles = (*(column.title for column in columns), *(title for title, _, _ in COSTS))
    cells = []
    for group in groups:
        shown = [estimated(group.scores(column), column.form) for column in columns]
        shown += [estimated([row.get(key) for row in group.rows], form) for _, key, form in COSTS]
        cells.append((group.case, group.length, group.method, seeds_in_words(len(group.rows)), *shown))
    best = {(row, place) for place, column in enumerate(columns, start=4) for row in _best(groups, column)}
    return Table(("recording", "at", "method", "seeds", *titles), tuple(cells), frozenset(best))


def _best(groups: Sequence[Group], column: Column) -> list[int]:
    """Index of the group with the best mean, for each recording and length that has two groups or more."""
    best = []
    for key in dict.fromkeys((group.case, group.length) for group in groups):
        means = {
            place: mean(values)
            for place, group in enumerate(groups)
            if (group.case, group.length) == key and (values := group.scores(column))
        }
        if len(means) > 1:
            best.append((max if column.larger_is_better else min)(means, key=means.__getitem__))
    return best


def _order(groups: Sequence[Group]) -> Table:
    """D² against every other method of the same backbone, recording and length, metric by metric."""
    titles = ["recording, at", f"{D2} against", *(column.title for column in STUDY_COLUMNS)]
    lines: list[Mapping[str, str]] = []
    for key in dict.fromkeys((group.case, group.length) for group in groups):
        mine = {g.method: g.rows for g in groups if (g.case, g.length) == key}
        scores = {name: [row["scores"] for row in rows] for name, rows in mine.items()}
        for ours in (name for name in scores if name.startswith(D2)):
            others = [n for n, rows in mine.items() if n != ours and _backbone(rows[0]) == _backbone(mine[ours][0])]
            made = verdicts_table(scores, ours, others, titles[1])
            lines += [{titles[0]: ", ".join(key), **dict(zip(made.header, cells))} for cells in made.rows]
    header = [title for title in titles if any(line.get(title, "-") != "-" for line in lines)]
    return Table(tuple(header), tuple(tuple(line.get(title, "-") for title in header) for line in lines))
