"""Tables of metrics, as Markdown for people and as LaTeX in the form of the paper's tables."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from d2_plugin.durable import write_text
from d2_plugin.runs.markup import Table, escaped, latex, markdown
from d2_plugin.runs.saved.kinds import read_metrics

__all__ = ["latex_table", "metrics_table", "read_metrics", "view_tables", "write_tables"]

Metrics = Mapping[str, Any]


@dataclass(frozen=True)
class Column:
    """One metric of a table."""

    title: str
    latex: str
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
    Column("PSNR", r"PSNR$\uparrow$", "psnr", ".2f", True, unit="dB"),
    Column("PSNR cc", r"PSNR$_\mathrm{cc}\uparrow$", "psnr_cc", ".2f", True, always=False, unit="dB"),
    Column("PSNR moving", r"PSNR$_\mathrm{moving}\uparrow$", "psnr_moving", ".2f", True, always=False, unit="dB"),
    Column("PSNR mask", r"PSNR$_\mathrm{mask}\uparrow$", "psnr_mask", ".2f", True, always=False, unit="dB"),
    Column("SSIM1", r"SSIM$_1\uparrow$", "ssim1", ".4f", True),
    Column("SSIM2", r"SSIM$_2\uparrow$", "ssim2", ".4f", True),
    Column("LPIPS", r"LPIPS$\downarrow$", "lpips", ".4f", False),
    Column("LPIPS vgg", r"LPIPS$_\mathrm{vgg}\downarrow$", "lpips_vgg", ".4f", False, always=False),
    Column("SSIM 3DGS", r"SSIM$_\mathrm{3DGS}\uparrow$", "ssim_3dgs", ".4f", True, always=False),
    Column("flicker", r"flicker$\downarrow$", "flicker", ".4f", False, always=False),
    Column("depth AbsRel", r"AbsRel$\downarrow$", "depth_absrel", ".4f", False),
    Column("depth delta1", r"$\delta_1\uparrow$", "depth_delta1", ".4f", True, always=False),
)

PAPER_COLUMNS = tuple(column for column in COLUMNS if column.key in ("psnr", "ssim1", "ssim2", "lpips"))
"""The columns of the paper's tables, which print four digits."""

STUDY_COLUMNS = tuple(c for c in COLUMNS if c.key in ("psnr", "psnr_moving", "ssim1", "ssim2", "lpips", "depth_absrel"))
"""The columns by which variants are compared: no single one of them says which is better."""


def metrics_table(runs: Mapping[str, Metrics]) -> str:
    """A Markdown table with one row per run of `metrics.json` contents; what was not measured shows as `-`."""
    scored = _scored(runs)
    columns = _columns(list(scored.values()))
    header = ("run", *(column.title for column in columns), "Gaussians", "priors s", "train s")
    rows = []
    for name, metrics in runs.items():
        seconds = metrics["seconds"]
        costs = (str(metrics["gaussians"]), f"{seconds['priors']:.1f}", f"{seconds['train']:.1f}")
        rows.append((name, *_cells(scored[name], columns), *costs))
    return markdown(Table(header, tuple(rows)), padded=True)


def latex_table(runs: Mapping[str, Metrics], columns: Sequence[Column] = PAPER_COLUMNS) -> str:
    """The same runs as a LaTeX table in the form of the paper's (booktabs): four digits, the best of a column bold.

    What was not measured shows as `--`.
    """
    scored = _scored(runs)
    header = ("Method", *(column.latex for column in columns))
    rows = tuple((escaped(name), *(_latex_cell(scores.get(c.key)) for c in columns)) for name, scores in scored.items())
    best = {column.key: _best(column, list(scored.values())) for column in columns}
    stressed = frozenset(
        (row, place)
        for row, scores in enumerate(scored.values())
        for place, column in enumerate(columns, start=1)
        if scores.get(column.key) is not None and scores[column.key] == best[column.key]
    )
    return latex(Table(header, rows, stressed))


def _scored(runs: Mapping[str, Metrics]) -> dict[str, Mapping[str, Any]]:
    return {name: metrics.get("test") or {} for name, metrics in runs.items()}


def view_tables(metrics: Metrics) -> str:
    """Markdown of one run: the mean, then per camera, per frame and per view, and what each column means."""
    means = {name: metrics[name] for name in ("test", "train") if metrics.get(name)}
    parts = [_section(f"Mean over {name} views", [{"": "all", **scores}], [""]) for name, scores in means.items()]
    parts.append(_section("Per camera", metrics["per_camera"], ["camera"]))
    parts.append(_section("Per frame", metrics["per_frame"], ["frame"]))
    parts.append(_section("Per view", metrics["per_view"], ["camera", "frame"]))
    shown = _columns(metrics["per_view"])
    variants = "\n".join(f"- {column.title}: {metrics['variants'][column.key]}" for column in shown)
    return "\n\n".join([*parts, f"## What is measured\n\n{variants}"]) + "\n"


def write_tables(metrics: Metrics, folder: Path) -> None:
    """metrics.md (`view_tables`) and metrics.tex (`latex_table` with one row) beside metrics.json in `folder`."""
    write_text(folder / "metrics.md", view_tables(metrics))
    name = f"{metrics['backbone']} {'+'.join(metrics['hooks']) or 'alone'}"
    write_text(folder / "metrics.tex", latex_table({name: metrics}) + "\n")


def _columns(scored: Sequence[Mapping[str, Any]]) -> list[Column]:
    return [c for c in COLUMNS if c.always or any(scores.get(c.key) is not None for scores in scored)]


def _section(title: str, rows: Sequence[Mapping[str, Any]], keys: Sequence[str]) -> str:
    columns = _columns(rows)
    header = (*keys, *(column.title for column in columns))
    lines = tuple((*(str(row[key]) for key in keys), *_cells(row, columns)) for row in rows)
    return f"## {title}\n\n{markdown(Table(header, lines), padded=True)}"


def _cells(scores: Mapping[str, Any], columns: Sequence[Column]) -> list[str]:
    return [column.text(scores.get(column.key)) for column in columns]


def _best(column: Column, scored: Sequence[Mapping[str, Any]]) -> float | None:
    """The best score of a column; None where fewer than two were measured, since the best of one says nothing."""
    known = [scores[column.key] for scores in scored if scores.get(column.key) is not None]
    if len(known) < 2:
        return None
    return max(known) if column.larger_is_better else min(known)


def _latex_cell(value: float | None) -> str:
    if value is None:
        return "--"
    return f"{value:.4f}" if math.isfinite(value) else r"$\infty$"
