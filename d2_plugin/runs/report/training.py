"""The part of the report about whole runs: held-out scores against time, the prior's included."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import mean

from d2_plugin.runs.ablation.paper_tables import SOURCE, paper_rows
from d2_plugin.runs.report.ablation import PAPER_TEXT
from d2_plugin.runs.report.plots import Axis, Plot, Point, Series
from d2_plugin.runs.report.scores import Group, average, one_per_seed, psnr, scored, scores_table
from d2_plugin.runs.report.sections import Section, cases_of, sources_of
from d2_plugin.runs.report.svg import bars, figure
from d2_plugin.runs.report.work_precision import colors_of, pareto_front
from d2_plugin.runs.rows import Row
from d2_plugin.runs.verdict import LEAST_SEEDS


def training(rows: Sequence[Row]) -> Section:
    """Held-out PSNR against minutes of prior and training, their parts as stacked bars, and all scores."""
    emulated = any(row.get("mono_emulated") for row in rows)
    colors = colors_of(rows)
    compared = cases_of(scored(rows))
    several = {case: mine for case, mine in compared.items() if len(mine) > 1} or compared  # one mark is no comparison
    plots = [_quality(case, mine, colors) for case, mine in several.items()]
    groups = [
        Group(case, name, group) for case, mine in cases_of(rows).items() for name, group in _variants(mine).items()
    ]
    stacked = [
        (f"{case}: {name}", (average(group, "prior_seconds") / 60, average(group, "seconds") / 60))
        for case, name, group in groups
    ]
    return Section(
        "training",
        "Training: held-out quality against time",
        "PSNR of cameras that trained nothing, against the minutes that the prior and the training took together; "
        "upper left is better. A prior that several runs share counts where it was built."
        + (" Monocular depth of some recordings is emulated, not predicted." if emulated else "")
        + (f" {PAPER_TEXT}" if any(series.hollow for plot in plots for series in plot.series) else ""),
        {
            "training": figure(plots, "Held-out PSNR against minutes", columns=3, size=(340, 320)),
            "training-time": bars(stacked, ("prior", "training"), "min", "Minutes of prior and training per method"),
        },
        (("Mean ± standard error over seeds", scores_table("method", groups)),),
        sources=sources_of(rows),
        headlines=tuple(line for case, mine in cases_of(scored(rows)).items() if (line := _headline(case, mine))),
    )


def _headline(case: str, runs: Sequence[Row]) -> str:
    """PSNR and minutes of each method's longest runs on one recording, and whether there are seeds enough to compare.

    Empty where there is one method only.
    """
    told, seeds = [], []
    for name in dict.fromkeys(row["method"] for row in runs):
        longest = max(row["iterations"] for row in runs if row["method"] == name)
        mine = [row for row in runs if row["method"] == name and row["iterations"] == longest]
        minutes = (average(mine, "seconds") + average(mine, "prior_seconds")) / 60
        told.append(f"{name} PSNR {mean(map(psnr, mine)):.2f} dB in {minutes:.2g} min")
        seeds.append(len(mine))
    if len(told) < 2:
        return ""
    few = "" if min(seeds) >= LEAST_SEEDS else f" ({min(seeds)} seed{'s' if min(seeds) > 1 else ''}: no verdict)"
    return f"{case}: {', '.join(told)}{few}"


def _quality(case: str, runs: Sequence[Row], colors: Mapping[str, int]) -> Plot:
    minutes = [(row["seconds"] + row["prior_seconds"]) / 60 for row in runs]
    front = set(pareto_front([(time, row["error"]) for time, row in zip(minutes, runs)]))
    series = []
    for name, color in colors.items():
        mine = [i for i, row in enumerate(runs) if row["method"] == name]
        points = [_quality_point(runs[i], minutes[i], i in front) for i in mine]
        steps = [mine[i] for i in pareto_front([(minutes[i], runs[i]["error"]) for i in mine])]
        line = tuple((minutes[i], psnr(runs[i])) for i in steps)
        series.append(Series(name, tuple(points), line, color))
    x = Axis.around("minutes, prior included", minutes, log=max(minutes) > 4 * min(minutes))
    series += _published_levels(case, x, len(colors))
    return Plot(case, x, Axis.around("held-out PSNR, dB", [p.y for s in series for p in s.points]), tuple(series))


def _quality_point(row: Row, minutes: float, on_front: bool) -> Point:
    decibels = psnr(row)
    note = f"{row['method']}, {row['setting']}: {decibels:.2f} dB after {minutes:.2f} min, {row['gaussians']} Gaussians"
    return Point(minutes, decibels, note, faded=not on_front)


def _published_levels(case: str, x: Axis, color: int) -> list[Series]:
    """The paper's PSNR on this recording, where its ablation is on it, as levels: its times are not published."""
    return [
        Series(row.label, (Point(x.high, row.psnr, f"{row.psnr:.2f} dB, {SOURCE}"),), ends, color + index, hollow=True)
        for index, row in enumerate(paper_rows("ablation", presets=("backbone", "full")))
        if row.scene and row.scene in case and f"{row.views} views" in case
        for ends in [((x.low, row.psnr), (x.high, row.psnr))]
    ]


def _variants(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Rows of the same method, steps and commit, which differ by seed; the commit is told where they differ.

    Where one seed has two scores the runs differ by something that their rows do not say, and each stands alone.
    """
    groups: dict[tuple[str, str | None], list[Row]] = {}
    for row in rows:
        groups.setdefault((f"{row['method']}, {row['iterations']} steps", row["commit"]), []).append(row)
    names = [name for name, _ in groups]
    told = {key: f"{key[0]} ({key[1]})" if names.count(key[0]) > 1 else key[0] for key in groups}
    found: dict[str, list[Row]] = {}
    for key, mine in groups.items():
        alike = len({(row["setting"], row["error"]) for row in mine}) == len(one_per_seed(mine))
        found |= {told[key]: one_per_seed(mine)} if alike else {f"{told[key]}, {row.get('run')}": [row] for row in mine}
    return found
