"""Tables of texts as Markdown, and those of metrics."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple


class Table(NamedTuple):
    """A table of texts; `best` are the cells (row, column) that stand out."""

    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    best: frozenset[tuple[int, int]] = frozenset()


def markdown(table: Table, padded: bool = False) -> str:
    """The table as Markdown; what stands out is bold. `padded` makes its columns line up in a terminal."""
    rows = [[_cell(cell, (i, k) in table.best) for k, cell in enumerate(row)] for i, row in enumerate(table.rows)]
    lines = [[_cell(title, False) for title in table.header], ["---"] * len(table.header), *rows]
    if padded:
        widths = [max(len(line[column]) for line in lines) for column in range(len(table.header))]
        lines = [[cell.ljust(width) for cell, width in zip(line, widths, strict=True)] for line in lines]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _cell(cell: str, best: bool) -> str:
    text = " ".join(cell.splitlines()).replace("|", "\\|").replace("<", "&lt;")  # no tag in a page made of it
    return f"**{text}**" if best else text


Metrics = Mapping[str, Any]


@dataclass(frozen=True)
class Column:
    """One metric of a table."""

    title: str
    key: str
    form: str
    larger_is_better: bool
    always: bool = True
    """Otherwise the column is left out of a table in which nothing has it."""
    unit: str = ""

    def text(self, value: float | None) -> str:
        """The value in its digits, `-` where it was not measured."""
        return "-" if value is None else format(value, self.form)


COLUMNS = (
    Column("PSNR", "psnr", ".2f", True, unit="dB"),
    Column("PSNR cc", "psnr_cc", ".2f", True, always=False, unit="dB"),
    Column("PSNR moving", "psnr_moving", ".2f", True, always=False, unit="dB"),
    Column("PSNR between", "psnr_between", ".2f", True, always=False, unit="dB"),
    Column("moving between", "psnr_moving_between", ".2f", True, always=False, unit="dB"),
    Column("PSNR mask", "psnr_mask", ".2f", True, always=False, unit="dB"),
    Column("SSIM1", "ssim1", ".4f", True),
    Column("SSIM2", "ssim2", ".4f", True),
    Column("LPIPS", "lpips", ".4f", False),
    Column("LPIPS vgg", "lpips_vgg", ".4f", False, always=False),
    Column("FLIP", "flip", ".4f", False, always=False),
    Column("SSIM 3DGS", "ssim_3dgs", ".4f", True, always=False),
    Column("flicker", "flicker", ".4f", False, always=False),
    Column("depth AbsRel", "depth_absrel", ".4f", False),
    Column("depth delta1", "depth_delta1", ".4f", True, always=False),
)

_STUDY = ["psnr", "psnr_moving", "psnr_between", "psnr_moving_between", "ssim1", "ssim2", "lpips", "depth_absrel"]
STUDY_COLUMNS = tuple(column for column in COLUMNS if column.key in _STUDY)
"""The columns by which variants are compared: no single one of them says which is better."""


def metrics_table(runs: Mapping[str, Metrics]) -> str:
    """A Markdown table with one row per run of `metrics.json` contents; what was not measured shows as `-`."""
    scores = {name: metrics.get("test") or {} for name, metrics in runs.items()}
    columns = [c for c in COLUMNS if c.always or any(score.get(c.key) is not None for score in scores.values())]
    header = ("run", *(column.title for column in columns), "Gaussians", "priors s", "train s")
    rows = []
    for name, metrics in runs.items():
        seconds = metrics["seconds"]
        costs = (str(metrics["gaussians"]), f"{seconds['priors']:.1f}", f"{seconds['train']:.1f}")
        rows.append((name, *(column.text(scores[name].get(column.key)) for column in columns), *costs))
    return markdown(Table(header, tuple(rows)), padded=True)
