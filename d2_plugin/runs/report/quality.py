"""Sections of the report about runs: held-out scores against minutes, at each length, and of each variant."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import mean
from typing import NamedTuple

from d2_plugin.runs.report.page import Section, sources_of
from d2_plugin.runs.report.svg import Axis, Plot, Point, Series, figure
from d2_plugin.runs.rows import TRY, Row
from d2_plugin.runs.tables import STUDY_COLUMNS, Column, Table
from d2_plugin.runs.verdict import EXPLANATION, Estimate, seeds_in_words, verdicts_table

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
        """Of prior and training."""
        return mean(row["seconds"] + (row.get("prior_seconds") or 0) for row in self.rows) / 60

    def scores(self, column: Column) -> list[float]:
        """The scores of the runs that have one in this metric."""
        return [value for row in self.rows if (value := row["scores"].get(column.key)) is not None]


def quality(rows: Sequence[Row]) -> Section:
    """Of `d2 bench training`: scores against CPU minutes of prior and training."""
    text = (
        "PSNR of cameras that trained nothing, against the CPU minutes that prior and training took on one thread; "
        "upper left is better. All methods have the same starting points, images and backbone settings; a mark is the "
        "mean over the seeds."
    )
    return _section("quality", "Quality against minutes", text, rows, "CPU minutes, prior included")


def training(rows: Sequence[Row]) -> Section:
    """Of run folders of `d2 train`: scores against wall minutes of prior and training."""
    text = (
        "PSNR of cameras that trained nothing, against the minutes that prior and training took; upper left is "
        "better. A mark is the mean over the seeds. A prior that several runs share counts where it was built."
    )
    return _section("training", "Runs of `d2 train`", text, rows, "minutes, prior included")


def ablation(rows: Sequence[Row]) -> Section:
    """Of `d2 ablate`: what each variant scores, and whether the full method is better."""
    text = "Held-out scores of the paper's variants on the same recording, points and number of steps."
    return _section("ablation", "Ablation: what each part is worth", text, rows)


def _section(name: str, title: str, text: str, rows: Sequence[Row], time: str | None = None) -> Section:
    """A section with its picture where `time` labels the axis of one."""
    groups = groups_of(rows)
    order = _order(groups)
    emulated = any(row.get("mono_emulated") for row in rows)
    failed = [row for row in rows if row["failed"]]
    by_unit = {unit: [group for group in groups if _length(group)[0] == unit] for unit in ("steps", "s")}
    titles = {"steps": "At equal steps, mean ± standard error over seeds", "s": "At equal time of training, the same"}
    tables = [(titles[unit], scores_table(mine)) for unit, mine in by_unit.items() if mine]
    tables += [(f"Is {D2} better?", order)] if order.rows else []
    tables += [("Runs without a score", _failures(failed))] if failed else []
    return Section(
        name,
        title,
        text
        + (" Monocular depth of some recordings is emulated, not predicted." if emulated else "")
        + (f" {EXPLANATION}" if order.rows else ""),
        {} if time is None else {name: _figure(groups, time)},
        tuple(tables),
        sources=sources_of(rows),
    )


def groups_of(rows: Sequence[Row]) -> list[Group]:
    """The runs that have a score by recording, length and method: recordings with real depth first, D² first of each.

    Tries are left out, and a run that was repeated with its seed counts once.
    """
    scored = [row for row in rows if (row.get("scores") or {}).get("psnr") is not None and row.get("target") != TRY]
    backbones = [_backbone(row) for row in scored]
    usual = max(backbones, key=backbones.count, default="")
    runs: dict[tuple[str, str, str], list[Row]] = {}
    for row in scored:
        length = row.get("target") or f"{row['iterations']} steps"
        runs.setdefault((row["case"], length, _method(row["method"], usual)), []).append(row)
    groups = [Group(case, method, length, _one_per_seed(mine)) for (case, length, method), mine in runs.items()]
    cases = list(dict.fromkeys(group.case for group in groups))
    return sorted(groups, key=lambda g: (_emulated(g), cases.index(g.case), _length(g), _rank(g.method)))


def _emulated(group: Group) -> bool:
    return bool(group.rows[0].get("mono_emulated"))


def _length(group: Group) -> tuple[str, float]:
    """Lengths in steps apart from those in seconds, shortest first."""
    size, _, unit = group.length.partition(" ")
    return unit, float(size)


def _rank(method: str) -> tuple[int, str]:
    """D², stereo alone and the backbone first."""
    known = (D2, STEREO, BACKBONE)
    return next((place for place, name in enumerate(known) if method.startswith(name)), len(known)), method


def _backbone(row: Row) -> str:
    return row["method"].partition(" ")[0]


def _method(text: str, usual: str) -> str:
    """`yang4d full, label` as `D², label`, with the backbone's name behind it where that is not the usual one."""
    backbone, _, rest = text.partition(" ")
    preset, comma, label = rest.partition(", ")
    other = "" if backbone == usual else f" ({backbone})"
    return NAMES.get(preset, preset.removeprefix("+ ")) + other + comma + label


def _one_per_seed(rows: Sequence[Row]) -> list[Row]:
    return list({row.get("seed"): row for row in rows}.values())


def _figure(groups: Sequence[Group], time: str) -> str:
    """PSNR over minutes, a plot for each recording; a method has one colour in all of them, and a line from length to
    length. Lengths in seconds alone where there are any, since times of two campaigns do not compare, and the usual
    backbone alone."""
    groups = [group for group in groups if not group.method.endswith(")")]
    methods = sorted({group.method for group in groups}, key=_rank)
    plots = []
    for case, mine in _by_case(groups).items():
        drawn = [group for group in mine if group.length.endswith(" s")] or mine
        series = []
        for color, method in enumerate(methods):
            points = sorted(_point(group) for group in drawn if group.method == method)
            series.append(Series(method, tuple(points), tuple((p.x, p.y) for p in points), color))
        x = Axis.around(time, [group.minutes for group in drawn], log=True)
        y = Axis.around("held-out PSNR, dB", [point.y for each in series for point in each.points])
        plots.append(Plot(case, x, y, tuple(series)))
    return figure(plots, "Held-out PSNR against minutes", columns=3, size=(360, 320))


def _by_case(groups: Sequence[Group]) -> dict[str, list[Group]]:
    return {case: [group for group in groups if group.case == case] for case in dict.fromkeys(g.case for g in groups)}


def _point(group: Group) -> Point:
    psnr = Estimate.of(group.scores(STUDY_COLUMNS[0]))
    assert psnr is not None  # `groups_of` leaves out what has none
    note = f"{group.method}, {group.length}: {psnr.text('.2f')} dB in {group.minutes:.2f} minutes"
    return Point(group.minutes, psnr.mean, f"{note} ({seeds_in_words(psnr.seeds)} seeds)" if psnr.seeds > 2 else note)


def scores_table(groups: Sequence[Group]) -> Table:
    """One row per group: scores that any run has, Gaussians and times; the best of a recording and length stand out."""
    columns = [column for column in STUDY_COLUMNS if any(group.scores(column) for group in groups)]
    titles = (*(column.title for column in columns), *(title for title, _, _ in COSTS))
    cells = []
    for group in groups:
        shown = [_text(group.scores(column), column.form) for column in columns]
        shown += [_text([row.get(key) for row in group.rows], form) for _, key, form in COSTS]
        cells.append((group.case, group.length, group.method, seeds_in_words(len(group.rows)), *shown))
    best = {(row, place) for place, column in enumerate(columns, start=4) for row in _best(groups, column)}
    return Table(("recording", "at", "method", "seeds", *titles), tuple(cells), frozenset(best))


def _text(values: Sequence[float | None], form: str) -> str:
    estimate = Estimate.of(values)
    return "-" if estimate is None else estimate.text(form)


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
        scores = {g.method: [row["scores"] for row in g.rows] for g in groups if (g.case, g.length) == key}
        for ours in (name for name in scores if name.startswith(D2)):
            others = [name for name in scores if name != ours and name.endswith(")") == ours.endswith(")")]
            made = verdicts_table(scores, ours, others, titles[1])
            lines += [{titles[0]: ", ".join(key), **dict(zip(made.header, cells))} for cells in made.rows]
    header = [title for title in titles if any(line.get(title, "-") != "-" for line in lines)]
    return Table(tuple(header), tuple(tuple(line.get(title, "-") for title in header) for line in lines))


def _failures(rows: Sequence[Row]) -> Table:
    cells = tuple((row["case"], row["method"], row["setting"], row["failed"]) for row in rows)
    return Table(("recording", "method", "run", "why"), cells)
