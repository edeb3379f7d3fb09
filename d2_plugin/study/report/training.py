"""The parts of the report about whole runs: held-out score against time with the prior's included, and ablations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import mean, stdev

from d2_plugin.runs.markup import Table
from d2_plugin.study.ablation.paper_tables import SOURCE, paper_rows
from d2_plugin.study.rows import Row

from .sections import Section, cases_of, sources_of
from .svg import Axis, Plot, Point, Series, bars, figure
from .work_precision import colors_of, pareto_front

SCORES = (
    ("PSNR", "psnr", 2),
    ("SSIM1", "ssim1", 4),
    ("SSIM2", "ssim2", 4),
    ("LPIPS", "lpips", 4),
    ("depth AbsRel", "depth_absrel", 4),
)
PAPER_TEXT = "Hollow marks are the paper's own figures, made on other machines and splits; it publishes no times."


def training(rows: Sequence[Row]) -> Section:
    """Held-out PSNR against minutes of prior and training, their parts as stacked bars, and all scores."""
    emulated = any(row.get("mono_emulated") for row in rows)
    colors = colors_of(rows)
    plots = [_quality(case, mine, colors) for case, mine in cases_of(_scored(rows)).items()]
    means = [(case, name, group) for case, mine in cases_of(rows).items() for name, group in _variants(mine).items()]
    stacked = [
        (f"{case}: {name}", (_mean(group, "prior_seconds") / 60, _mean(group, "seconds") / 60))
        for case, name, group in means
    ]
    return Section(
        "training",
        "Training: held-out quality against time",
        "PSNR of cameras that trained nothing, against the minutes that the prior and the training took together; "
        "upper left is better. A prior that several runs share counts where it was built."
        + (" Monocular depth of some captures is emulated, not predicted." if emulated else "")
        + (f" {PAPER_TEXT}" if any(series.hollow for plot in plots for series in plot.series) else ""),
        {
            "training": figure(plots, "Held-out PSNR against minutes", columns=3, size=(340, 320)),
            "training-time": bars(stacked, ("prior", "training"), "min", "Minutes of prior and training per method"),
        },
        (("Mean ± deviation over seeds", _scores_table("method", means)),),
        sources=sources_of(rows),
        headlines=tuple(line for case, mine in cases_of(_scored(rows)).items() if (line := _headline(case, mine))),
    )


def _headline(case: str, scored: Sequence[Row]) -> str:
    """PSNR and minutes, means of the longest runs, of the backbone alone and with D2 on one capture; empty where one of
    them is missing."""
    told = []
    for name in dict.fromkeys(row["method"] for row in scored):
        longest = max(row["iterations"] for row in scored if row["method"] == name)
        mine = [row for row in scored if row["method"] == name and row["iterations"] == longest]
        minutes = (_mean(mine, "seconds") + _mean(mine, "prior_seconds")) / 60
        told.append(f"{name} {mean(_score(row, 'psnr') for row in mine):.2f} dB in {minutes:.2g} min")
    return f"{case}: {', '.join(told)}" if len(told) > 1 else ""


def _quality(case: str, scored: Sequence[Row], colors: Mapping[str, int]) -> Plot:
    minutes = [(row["seconds"] + row["prior_seconds"]) / 60 for row in scored]
    front = set(pareto_front([(time, row["error"]) for time, row in zip(minutes, scored)]))
    series = []
    for name, color in colors.items():
        mine = [i for i, row in enumerate(scored) if row["method"] == name]
        points = [_quality_point(scored[i], minutes[i], i in front) for i in mine]
        steps = [mine[i] for i in pareto_front([(minutes[i], scored[i]["error"]) for i in mine])]
        line = tuple((minutes[i], _score(scored[i], "psnr")) for i in steps)
        series.append(Series(name, tuple(points), line, color))
    x = Axis.around("minutes, prior included", minutes, log=max(minutes) > 4 * min(minutes))
    series += _published_levels(case, x, len(colors))
    return Plot(case, x, Axis.around("held-out PSNR, dB", [p.y for s in series for p in s.points]), tuple(series))


def _quality_point(row: Row, minutes: float, on_front: bool) -> Point:
    psnr = _score(row, "psnr")
    note = f"{row['method']}, {row['setting']}: {psnr:.2f} dB after {minutes:.2f} min, {row['gaussians']} Gaussians"
    return Point(minutes, psnr, note, faded=not on_front)


def _published_levels(case: str, x: Axis, color: int) -> list[Series]:
    """The paper's PSNR on this capture, where its ablation is on it, as levels: its times are not published."""
    return [
        Series(row.label, (Point(x.high, row.psnr, f"{row.psnr:.2f} dB, {SOURCE}"),), ends, color + index, hollow=True)
        for index, row in enumerate(paper_rows("ablation", presets=("backbone", "full")))
        if row.scene and row.scene in case and f"{row.views} views" in case
        for ends in [((x.low, row.psnr), (x.high, row.psnr))]
    ]


def _variants(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Rows of the same method and number of steps, which differ by seed."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(f"{row['method']}, {row['iterations']} steps", []).append(row)
    return groups


def ablation(rows: Sequence[Row]) -> Section:
    """What each variant gains over the backbone alone, every seed a mark, and the scores as mean and deviation."""
    plots = [_gains(case, mine) for case, mine in cases_of(_scored(rows)).items()]
    groups = [
        (case, name, [row for row in mine if row["method"] == name])
        for case, mine in cases_of(rows).items()
        for name in dict.fromkeys(row["method"] for row in mine)
    ]
    height = 90 + 24 * max((len(plot.y.names) for plot in plots), default=0)
    return Section(
        "ablation",
        "Ablation: what each part is worth",
        f"Held-out PSNR beyond the mean of the backbone alone on the same capture. {PAPER_TEXT} Compare the order, "
        "not the size.",
        {"ablation": figure(plots, "Gain of each variant over the backbone", size=(720, height))},
        (("Mean ± deviation over seeds", _scores_table("variant", groups)),),
        sources=sources_of(rows),
    )


def _gains(case: str, scored: Sequence[Row]) -> Plot:
    names = list(dict.fromkeys(row["method"] for row in scored))
    base = _backbones(scored)
    points = []
    for row in scored:
        gain = _score(row, "psnr") - base[row["method"].partition(" ")[0]]
        note = f"{row['method']}, {row['setting']}: {gain:+.2f} dB"
        points.append(Point(gain, names.index(row["method"]), note))
    series = [Series("here, one mark per seed", tuple(points))]
    published = _published_gains(names)
    if published:
        series.append(Series("the paper (sear_steak, 4 views)", published, color=1, hollow=True))
    x = Axis.around("dB over the backbone alone", [p.x for s in series for p in s.points])
    return Plot(case, x, Axis.listing("", names), tuple(series))


def _backbones(rows: Sequence[Row]) -> dict[str, float]:
    """Mean PSNR of each backbone alone; where that was not run, of its worst variant."""
    found: dict[str, float] = {}
    for backbone in dict.fromkeys(row["method"].partition(" ")[0] for row in rows):
        mine = [row for row in rows if row["method"].partition(" ")[0] == backbone]
        alone = [row for row in mine if row["method"] == f"{backbone} backbone"]
        found[backbone] = (
            mean(_score(row, "psnr") for row in alone) if alone else min(_score(row, "psnr") for row in mine)
        )
    return found


def _published_gains(names: Sequence[str]) -> tuple[Point, ...]:
    """The paper's gains over its backbone, beside our variants of the same preset."""
    published = {row.preset: row for row in paper_rows("ablation")}
    return tuple(
        Point(row.psnr - published["backbone"].psnr, place, f"{row.label}: {row.psnr:.2f} dB, {SOURCE}")
        for place, name in enumerate(names)
        if (row := published.get(name.partition(" ")[2])) is not None
    )


def _score(row: Row, name: str) -> float | None:
    return (row.get("scores") or {}).get(name)


def _scored(rows: Sequence[Row]) -> list[Row]:
    """The rows of runs that held a camera out."""
    return [row for row in rows if _score(row, "psnr") is not None]


def _mean(rows: Sequence[Row], name: str) -> float:
    return mean(row[name] for row in rows)


def _spread(values: Sequence[float | None], digits: int) -> str:
    known = [value for value in values if value is not None]
    if not known:
        return "-"
    return f"{mean(known):.{digits}f}" + (f" ± {stdev(known):.{digits}f}" if len(known) > 1 else "")


def _scores_table(what: str, groups: Sequence[tuple[str, str, Sequence[Row]]]) -> Table:
    """One row per (case, name, runs): scores that any run has, Gaussians and times; the best of a case stand out."""
    scores = [each for each in SCORES if any(_score(row, each[1]) is not None for *_, mine in groups for row in mine)]
    costs = (("Gaussians", "gaussians", 0), ("prior s", "prior_seconds", 1), ("train s", "seconds", 1))
    header = ("capture", what, "runs", *(title for title, _, _ in (*scores, *costs)))
    cells = []
    for case, name, mine in groups:
        scored = [_spread([_score(row, key) for row in mine], digits) for _, key, digits in scores]
        spent = [_spread([row.get(key) for row in mine], digits) for _, key, digits in costs]
        cells.append((case, name, str(len(mine)), *scored, *spent))
    return Table(header, tuple(cells), _best(groups, [key for _, key, _ in scores]))


def _best(groups: Sequence[tuple[str, str, Sequence[Row]]], keys: Sequence[str]) -> frozenset[tuple[int, int]]:
    """The cells with the best score of each capture."""
    found = set()
    for case in dict.fromkeys(case for case, _, _ in groups):
        for column, key in enumerate(keys, start=3):
            values = {
                index: mean(known)
                for index, (of, _, mine) in enumerate(groups)
                if of == case and (known := [s for row in mine if (s := _score(row, key)) is not None])
            }
            if len(values) > 1:
                choose = min if key in ("lpips", "depth_absrel") else max
                found.add((choose(values, key=values.__getitem__), column))
    return frozenset(found)
