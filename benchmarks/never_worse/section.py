"""The part of the report about wrong monocular maps: held-out scores beside those of the backbone and of stereo."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import mean

from d2_plugin.runs.markup import Table, markdown
from d2_plugin.runs.report.page import Section, cases_of, sources_of
from d2_plugin.runs.rows import Row
from d2_plugin.runs.verdict import margin, seeds_in_words

BACKBONE, STEREO = "backbone alone", "stereo alone"
"""Methods that use no monocular map."""
ALLOWED = 0.1
"""A loss within this counts as none, dB: seeds differ by more."""
HEADER = ("recording", "monocular maps", "seeds", "PSNR", "over the backbone", "over stereo", "SSIM1", "depth AbsRel")


def never_worse(rows: Sequence[Row]) -> Section:
    """One table: every kind of map against the backbone alone and against stereo alone."""
    return Section(
        "never_worse",
        "Never worse than without",
        "Held-out scores where the monocular maps are not what they should be: `noise` is a random value at every "
        "pixel, `smooth` random blobs, `constant` one value, `other` the map of another frame (of another camera "
        "where there is one frame), `network` a small network that runs on phones. `stereo alone` uses no monocular "
        f"map. Not worse is at most {ALLOWED} dB below the backbone alone; what is stands out.",
        tables=(("Held-out scores by monocular maps", table(rows)),),
        sources=sources_of(rows),
    )


def never_worse_text(rows: Sequence[Row]) -> str:
    """The table, for a terminal."""
    return markdown(table(rows), padded=True)


def table(rows: Sequence[Row]) -> Table:
    """A row per recording and method, in the order of measurement; what is not worse than the backbone stands out."""
    rows = [row for row in rows if row.get("scores")]
    cells: list[tuple[str, ...]] = []
    fine: list[tuple[int, int]] = []
    for case, mine in cases_of(rows).items():
        methods = _by_method(mine)
        for name, runs in methods.items():
            if name not in (BACKBONE, STEREO) and not _worse(methods, runs):
                fine.append((len(cells), HEADER.index("over the backbone")))
            compared = [_over(methods, other, name) for other in (BACKBONE, STEREO)]
            counts = seeds_in_words(len(runs))
            cells.append((case, name, counts, f"{mean(map(psnr, runs)):.2f}", *compared, *_others(runs)))
    return Table(HEADER, tuple(cells), frozenset(fine))


def psnr(row: Row) -> float:
    """The held-out PSNR of a run, dB."""
    return row["scores"]["psnr"]


def _others(runs: Sequence[Row]) -> list[str]:
    """Means of the other scores; a dash where they were not measured."""
    found = [[row["scores"].get(key) for row in runs] for key in ("ssim1", "depth_absrel")]
    return ["-" if None in values else f"{mean(v for v in values if v is not None):.4f}" for values in found]


def _by_method(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """The runs of each method, the last one of each seed."""
    last = {(row["method"], row["setting"]): row for row in rows}
    methods = dict.fromkeys(row["method"] for row in rows)
    return {name: [row for (method, _), row in last.items() if method == name] for name in methods}


def _over(methods: dict[str, list[Row]], other: str, name: str) -> str:
    """By how much a method is above another one; a dash beside itself."""
    if name == other or other not in methods:
        return "-"
    return margin([*map(psnr, methods[name])], [*map(psnr, methods[other])]).text(2, "dB")


def _worse(methods: dict[str, list[Row]], runs: Sequence[Row]) -> bool:
    """Whether the mean lies below that of the backbone by more than is allowed."""
    reference = methods.get(BACKBONE)
    return reference is not None and mean(map(psnr, runs)) < mean(map(psnr, reference)) - ALLOWED
