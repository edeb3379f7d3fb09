"""Tables of scores: what stands out is bold, and no cell can break its table."""

from __future__ import annotations

from typing import Any

from d2_plugin.runs.tables import Table, markdown, metrics_table


def run(gaussians: int = 1, **test: float | None) -> dict[str, Any]:
    return {"test": test, "gaussians": gaussians, "seconds": {"priors": 0.0, "train": 1.25}}


def cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_a_missing_score_is_a_dash_and_an_unmeasured_column_is_left_out() -> None:
    table = metrics_table({"a": run(5, psnr=20.0, lpips=None), "b": run(6, psnr=21.5, flicker=0.02)})
    head, _, first, second = (cells(line) for line in table.splitlines())
    assert head[:5] == ["run", "PSNR", "SSIM1", "SSIM2", "LPIPS"]
    assert "depth delta1" not in head
    assert first[head.index("LPIPS")] == "-"
    assert first[head.index("flicker")] == "-"
    assert second[head.index("flicker")] == "0.0200"
    assert second[-3:] == ["6", "0.0", "1.2"]
    assert len({len(line) for line in table.splitlines()}) == 1


TABLE = Table(("name", "dB"), (("a|b", "28.9 ± 0.5"), ("c", "3")), frozenset({(0, 1)}))


def test_markdown_keeps_bars_inside_their_cell_and_stresses_the_best() -> None:
    assert markdown(TABLE).splitlines() == ["| name | dB |", "| --- | --- |", r"| a\|b | **28.9 ± 0.5** |", "| c | 3 |"]
    best = Table(("a",), (("1|2",),), frozenset({(0, 0)}))
    assert markdown(best).splitlines()[-1] == r"| **1\|2** |"
