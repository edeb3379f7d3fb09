"""The part of the report about ablations: what each variant gains over the backbone alone, and in which metric."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import mean

from d2_plugin.runs.ablation.claims import EXPLANATION, Scores, claims_table
from d2_plugin.runs.ablation.paper_tables import SOURCE, paper_rows
from d2_plugin.runs.markup import Table
from d2_plugin.runs.report.plots import Axis, Plot, Point, Series
from d2_plugin.runs.report.scores import Group, best_of_cases, psnr, scored, scores_table
from d2_plugin.runs.report.sections import Section, cases_of, sources_of
from d2_plugin.runs.report.svg import figure
from d2_plugin.runs.rows import Row
from d2_plugin.runs.tables import STUDY_COLUMNS

PAPER_TEXT = "Hollow marks are the paper's own figures, made on other machines and splits; it publishes no times."
FULL, BACKBONE = "full", "backbone"
"""Presets that others are compared with; the method of a row is `BACKBONE_NAME PRESET`."""


def ablation(rows: Sequence[Row]) -> Section:
    """What each variant gains over the backbone alone, every seed a mark, and the scores as mean and standard error."""
    cases = cases_of(scored(rows))
    plots = [_gains(case, mine) for case, mine in cases.items()]
    groups = [
        Group(case, name, [row for row in mine if row["method"] == name])
        for case, mine in cases_of(rows).items()
        for name in dict.fromkeys(row["method"] for row in mine)
    ]
    order = _order(cases)
    return Section(
        "ablation",
        "Ablation: what each part is worth",
        f"Held-out PSNR beyond the mean of the backbone alone on the same recording. {PAPER_TEXT} Compare the order, "
        f"not the size.{_missing(cases)}" + (f" Is the full method better? {EXPLANATION}" if order.rows else ""),
        {"ablation": figure(plots, "Gain of each variant over the backbone")},
        (
            ("Mean ± standard error over seeds", scores_table("variant", groups)),
            *([("Is the full method better?", order)] if order.rows else []),
        ),
        sources=sources_of(rows),
        headlines=tuple(_headline(case, groups) for case in cases if sum(group.case == case for group in groups) > 2),
    )


def _headline(case: str, groups: Sequence[Group]) -> str:
    """Which variant has the best mean in which metric: the metrics need not agree."""
    mine = [group for group in groups if group.case == case]
    leads: dict[str, list[str]] = {}
    for column in STUDY_COLUMNS:
        for place in best_of_cases(mine, column):
            leads.setdefault(mine[place].name, []).append(column.title)
    return f"{case}: best mean " + "; ".join(f"{', '.join(titles)}: {name}" for name, titles in leads.items())


def _order(cases: Mapping[str, Sequence[Row]]) -> Table:
    """The full method against every other variant of the same backbone and recording, metric by metric."""
    titles = ["recording", "full method against", *(column.title for column in STUDY_COLUMNS)]
    lines: list[dict[str, str]] = []
    for case, rows in cases.items():
        for backbone in _backbones_of(rows):
            scores = _scores(rows, backbone)
            others = [name for name in scores if name != f"{backbone} {FULL}"]
            found = claims_table(scores, f"{backbone} {FULL}", others, titles[1])
            lines += [{titles[0]: case, **dict(zip(found.header, cells))} for cells in found.rows]
    header = [title for title in titles if any(line.get(title, "-") != "-" for line in lines)]
    return Table(tuple(header), tuple(tuple(line.get(title, "-") for title in header) for line in lines))


def _scores(rows: Sequence[Row], backbone: str) -> Scores:
    """Scores of the runs of one backbone by variant."""
    found: dict[str, list[Mapping[str, float | None]]] = {}
    for row in rows:
        if _backbone_of(row) == backbone:
            found.setdefault(row["method"], []).append(row["scores"])
    return found


def _gains(case: str, rows: Sequence[Row]) -> Plot:
    """Gains in PSNR of the variants whose backbone alone was run on the same recording; others have none to show."""
    base = _alone(rows)
    drawn = [row for row in rows if _backbone_of(row) in base]
    names = list(dict.fromkeys(row["method"] for row in drawn))
    points = []
    for row in drawn:
        gain = psnr(row) - base[_backbone_of(row)]
        note = f"{row['method']}, {row['setting']}: {gain:+.2f} dB"
        points.append(Point(gain, names.index(row["method"]), note))
    series = [Series("here, one mark per seed", tuple(points))]
    published = _published_gains(names)
    if published:
        series.append(Series("the paper (sear_steak, 4 views)", published, color=1, hollow=True))
    x = Axis.around("dB of held-out PSNR over the backbone alone", [p.x for s in series for p in s.points])
    return Plot(case, x, Axis.listing("", names), tuple(series))


def _alone(rows: Sequence[Row]) -> dict[str, float]:
    """Mean PSNR of each backbone that was run alone."""
    alone: dict[str, list[float]] = {}
    for row in rows:
        if row["method"] == f"{_backbone_of(row)} {BACKBONE}":
            alone.setdefault(_backbone_of(row), []).append(psnr(row))
    return {name: mean(values) for name, values in alone.items()}


def _missing(cases: Mapping[str, Sequence[Row]]) -> str:
    """Which gains are not drawn, because the backbone alone was not run."""
    lost = [
        f"{name} on {case}" for case, rows in cases.items() for name in _backbones_of(rows) if name not in _alone(rows)
    ]
    return f" No gain is drawn for {', '.join(lost)}: the backbone alone was not run there." if lost else ""


def _backbones_of(rows: Sequence[Row]) -> list[str]:
    return list(dict.fromkeys(map(_backbone_of, rows)))


def _backbone_of(row: Row) -> str:
    return row["method"].partition(" ")[0]


def _published_gains(names: Sequence[str]) -> tuple[Point, ...]:
    """The paper's gains over its backbone, beside our variants of the same preset."""
    published = {row.preset: row for row in paper_rows("ablation")}
    return tuple(
        Point(row.psnr - published[BACKBONE].psnr, place, f"{row.label}: {row.psnr:.2f} dB, {SOURCE}")
        for place, name in enumerate(names)
        if (row := published.get(name.partition(" ")[2])) is not None
    )
