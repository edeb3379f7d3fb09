"""Tables of metrics, as text and Markdown."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from d2_plugin.errors import D2Error

COLUMNS = (
    ("PSNR", "psnr", ".2f"),
    ("SSIM1", "ssim1", ".4f"),
    ("SSIM2", "ssim2", ".4f"),
    ("LPIPS", "lpips", ".4f"),
    ("depth AbsRel", "depth_absrel", ".4f"),
)


def metrics_table(runs: Mapping[str, Mapping[str, Any]]) -> str:
    """A Markdown table with one row per run of `metrics.json` contents; what was not measured shows as `-`."""
    header = ["run", *(title for title, _, _ in COLUMNS), "Gaussians", "priors s", "train s"]
    rows = [header, ["---"] * len(header)]
    for name, metrics in runs.items():
        scores = metrics.get("test") or {}
        cells = [_cell(scores.get(key), form) for _, key, form in COLUMNS]
        seconds = metrics["seconds"]
        rows.append([name, *cells, str(metrics["gaussians"]), f"{seconds['priors']:.1f}", f"{seconds['train']:.1f}"])
    widths = [max(len(row[i]) for row in rows) for i in range(len(header))]
    return "\n".join("| " + " | ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)) + " |" for row in rows)


def read_metrics(folder: Path) -> dict[str, Any]:
    """The metrics.json of a run folder."""
    try:
        return json.loads((folder / "metrics.json").read_text())
    except FileNotFoundError:
        raise D2Error(f"{folder} has no metrics.json: finish `d2 train` there, or run `d2 eval`") from None


def _cell(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)
