"""The part of the report about quality per minute: D², the backbone and rivals at the same CPU time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from d2_plugin.runs.ablation.claims import EXPLANATION, claims_table
from d2_plugin.runs.markup import Table
from d2_plugin.runs.report.plots import Axis, Plot, Point, Series
from d2_plugin.runs.report.scores import Group, average, best_of_cases, one_per_seed, psnr, score, scored, scores_table
from d2_plugin.runs.report.sections import Section, cases_of, sources_of
from d2_plugin.runs.report.svg import bars, figure
from d2_plugin.runs.report.work_precision import colors_of, pareto_front
from d2_plugin.runs.rows import Row
from d2_plugin.runs.tables import STUDY_COLUMNS, Column
from d2_plugin.runs.training.measured import TRY
from d2_plugin.runs.verdict import Estimate, seeds_in_words

DRAWN = tuple(column for column in STUDY_COLUMNS if column.key in ("psnr", "ssim1", "depth_absrel"))
FRONT_COLOR = 7
"""Of the dashed line through what no method beats in both score and time."""

FULL = "full"
"""Preset of D² with its defaults; the method of a row is `BACKBONE PRESET`, and a label behind a comma."""


@dataclass(frozen=True)
class Length:
    """Runs of one method on one recording that differ by seed alone."""

    method: str
    target: str
    """What they were meant for: `30 s`, `2000 steps`, or a try that looked for such a length."""
    rows: Sequence[Row]

    def minutes(self, prior: bool = False) -> float:
        """CPU minutes of training on one thread, with those of the prior if asked for."""
        return (average(self.rows, "seconds") + (_prior(self.rows) if prior else 0)) / 60


def quality(rows: Sequence[Row]) -> Section:
    """Scores over minutes with and without the prior, the scores at each time, and whether D² is above the others."""
    cases = {case: _lengths(mine) for case, mine in cases_of(scored(_distinct(rows))).items()}
    colors = colors_of(rows)
    groups = _groups(cases)
    order = _order(cases)
    emulated = any(row.get("mono_emulated") for row in rows)
    tables = [("Mean ± standard error over seeds, at each time", scores_table("method", groups))]
    failed = [row for row in rows if row["failed"]]
    tables += [("Is D² above the others?", order)] if order.rows else []
    tables += [("Runs that failed", _failures(failed))] if failed else []
    return Section(
        "quality",
        "Quality per minute: D², the backbone and rivals",
        "Cameras that trained nothing, against CPU minutes of training on one thread. All methods have the same "
        "starting points, depth inputs and backbone settings. Marks are means over the seeds; a line joins what no "
        "other length of that method beats, the dashed one is the Pareto front of all, and what lies behind it is "
        "faded. The prior is counted in the "
        "second figure and in the bars; rivals that read monocular maps alone are charged for those alone."
        + (" Monocular depth of some recordings is emulated, not predicted." if emulated else "")
        + (f" {EXPLANATION}" if order.rows else ""),
        {
            "quality": figure(
                [_plot(case, found, column, colors) for case, found in cases.items() for column in _measured(found)],
                "Held-out scores against CPU minutes of training",
                columns=len(DRAWN),
                size=(380, 320),
            ),
            "quality-with-prior": figure(
                [_plot(case, found, DRAWN[0], colors, prior=True) for case, found in cases.items()],
                "Held-out PSNR against CPU minutes of prior and training",
                columns=len(DRAWN),
                size=(380, 320),
            ),
            "quality-time": bars(_bars(cases), ("prior", "training"), "min", "CPU minutes of prior and training"),
        },
        tuple(tables),
        sources=sources_of(rows),
        headlines=tuple(_headlines(groups)),
    )


def _distinct(rows: Sequence[Row]) -> list[Row]:
    """Each run once: a try that became the run of a budget has two rows."""
    kept: dict[str, Row] = {}
    for row in rows:
        known = kept.get(row["fingerprint"])
        if known is None or known["target"] == TRY:
            kept[row["fingerprint"]] = row
    return list(kept.values())


def _lengths(rows: Sequence[Row]) -> list[Length]:
    """The runs of one recording by method and length, shortest first."""
    found: dict[tuple[str, str], list[Row]] = {}
    for row in sorted(rows, key=lambda row: row["seconds"]):
        found.setdefault((row["method"], _target(row)), []).append(row)
    return [Length(*key, one_per_seed(mine)) for key, mine in found.items()]


def _target(row: Row) -> str:
    return f"try of {row['iterations']} steps" if row["target"] == TRY else row["target"]


def _groups(cases: Mapping[str, Sequence[Length]]) -> list[Group]:
    """A group per recording and time at which at least two methods were measured, and the methods there."""
    return [
        Group(f"{case}, {target}", length.method, length.rows)
        for case, found in cases.items()
        for target in _shared_targets(found)
        for length in found
        if length.target == target
    ]


def _shared_targets(found: Sequence[Length]) -> list[str]:
    """What at least two methods were measured at; all there is where there is one method only."""
    targets = list(dict.fromkeys(length.target for length in found if not length.target.startswith(TRY)))
    shared = [t for t in targets if sum(length.target == t for length in found) > 1]
    return shared or targets


def _measured(found: Sequence[Length]) -> list[Column]:
    return [column for column in DRAWN if any(_mean(length, column) for length in found)]


def _mean(length: Length, column: Column) -> Estimate | None:
    return Estimate.of([score(row, column.key) for row in length.rows])


def _plot(case: str, found: Sequence[Length], column: Column, colors: Mapping[str, int], prior: bool = False) -> Plot:
    """One metric of one recording over minutes."""
    known = [(length, mean) for length in found if (mean := _mean(length, column)) is not None]
    sign = -1 if column.larger_is_better else 1
    places = [(length.minutes(prior), sign * mean.mean) for length, mean in known]
    front = pareto_front(places)
    best_of_all = tuple((places[i][0], known[i][1].mean) for i in front)
    series = [Series("Pareto front", (), best_of_all, FRONT_COLOR, hollow=True)] if len(colors) > 1 else []
    for name, color in colors.items():
        mine = [i for i, (length, _) in enumerate(known) if length.method == name]
        points = tuple(_point(*known[i], column, places[i][0], i not in front) for i in mine)
        best = [mine[i] for i in pareto_front([places[i] for i in mine])]
        series.append(Series(name, points, tuple((places[i][0], known[i][1].mean) for i in best), color))
    label = column.title + (f", {column.unit}" if column.unit else "")
    time = "CPU minutes, prior included" if prior else "CPU minutes of training"
    x = Axis.around(time, [minutes for minutes, _ in places], log=True)
    return Plot(case, x, Axis.around(label, [mean.mean for _, mean in known]), tuple(series))


def _point(length: Length, mean: Estimate, column: Column, minutes: float, faded: bool) -> Point:
    seeds = seeds_in_words(mean.seeds) + (" seeds" if mean.seeds > 2 else "")
    note = f"{length.method}, {length.target}: {column.title} {mean.text(column.form)} ({seeds}), {minutes:.2f} min"
    return Point(minutes, mean.mean, note, faded=faded)


def _prior(rows: Sequence[Row]) -> float:
    """Seconds of what the method needs beforehand; 0 where that was not measured."""
    known = [row["prior_seconds"] for row in rows if row.get("prior_seconds") is not None]
    return sum(known) / len(known) if known else 0.0


def _bars(cases: Mapping[str, Sequence[Length]]) -> list[tuple[str, tuple[float, float]]]:
    """Prior and training of each method's longest runs."""
    found = []
    for case, lengths in cases.items():
        for method in dict.fromkeys(length.method for length in lengths):
            longest = [length for length in lengths if length.method == method][-1]
            name = f"{case}: {method}, {longest.target}"
            found.append((name, (_prior(longest.rows) / 60, longest.minutes())))
    return found or [("nothing was measured", (0.0, 0.0))]


def _order(cases: Mapping[str, Sequence[Length]]) -> Table:
    """D² with its defaults against every other method, at each time and metric by metric."""
    titles = ["recording, time", "D² against", *(column.title for column in STUDY_COLUMNS)]
    lines: list[dict[str, str]] = []
    for case, found in cases.items():
        for target in _shared_targets(found):
            scores = {one.method: [row["scores"] for row in one.rows] for one in found if one.target == target}
            for ours in (name for name in scores if name.partition(" ")[2] == FULL):
                made = claims_table(scores, ours, [name for name in scores if name != ours], titles[1])
                lines += [{titles[0]: f"{case}, {target}", **dict(zip(made.header, cells))} for cells in made.rows]
    header = [title for title in titles if any(line.get(title, "-") != "-" for line in lines)]
    return Table(tuple(header), tuple(tuple(line.get(title, "-") for title in header) for line in lines))


def _failures(rows: Sequence[Row]) -> Table:
    cells = tuple((row["case"], row["method"], row["setting"], row["failed"]) for row in rows)
    return Table(("recording", "method", "run", "why"), cells)


def _headlines(groups: Sequence[Group]) -> list[str]:
    """Which method has the best mean PSNR at each time."""
    told = []
    for place in best_of_cases(groups, DRAWN[0]):
        best = groups[place]
        mean = Estimate.of(list(map(psnr, best.rows)))
        if mean is not None:
            told.append(f"{best.case}: best PSNR {best.name}, {mean.text('.2f')} dB ({seeds_in_words(mean.seeds)})")
    return told
