"""The paper's figures are those of the paper, and cannot be mistaken for ours."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from d2_plugin.errors import D2Error
from d2_plugin.runs.ablation.paper_tables import DATASETS, MARK, ROWS, TABLES, PaperRow, paper_rows, paper_table
from d2_plugin.runs.ablation.presets import PRESETS
from d2_plugin.runs.ablation.presets import TABLES as OUR_TABLES

LABELS = {"main": "tab:main_results", "ablation": "tab:ablation", "pruning": "tab:pruning_criteria"}


def numbers_of(text: str) -> list[float]:
    """Every number with four decimals, in the order of the source."""
    return [float(number) for number in re.findall(r"\d+\.\d{4}", text)]


def source_of(tex: str, label: str) -> str:
    """The tabular that stands before a label."""
    end = tex.index(f"\\label{{{label}}}")
    return tex[tex.rindex(r"\begin{tabular", 0, end) : end]


@pytest.mark.parametrize("table", list(TABLES))
def test_every_figure_is_the_papers(shared_data, table: str) -> None:
    tex = Path(shared_data("../paper/d2-4dgs.tex")).read_text()
    assert LABELS[table] in TABLES[table]
    rows = [number for row in paper_rows(table) for number in row.scores.values()]
    assert rows == numbers_of(source_of(tex, LABELS[table]))


def test_the_main_comparison_is_complete() -> None:
    rows = paper_rows("main")
    assert len(rows) == 7 * len(DATASETS) * 3
    for dataset in DATASETS:
        for views in (2, 3, 4):
            group = paper_rows("main", dataset=dataset, views=views)
            # The paper's claim: its method has the highest PSNR in all nine settings.
            assert max(group, key=lambda row: row.psnr).preset == "full"
    gains = []
    for dataset in DATASETS:
        for views in (2, 3, 4):
            ours, *others = sorted(paper_rows("main", dataset=dataset, views=views), key=lambda row: -row.psnr)
            gains.append(ours.psnr - others[0].psnr)
    assert sum(gains) / len(gains) == pytest.approx(1.33, abs=0.005)  # as its abstract says


def test_rows_are_named_as_our_presets() -> None:
    for table in ("ablation", "pruning"):
        rows = paper_rows(table)
        assert [row.preset for row in rows] == [name for name in OUR_TABLES[table] if name in {r.preset for r in rows}]
    for row in ROWS:
        assert row.preset is None or row.preset in PRESETS
    for row in paper_rows("ablation"):
        assert row.method == PRESETS[row.preset].title
    assert [row.method for row in paper_rows("ablation", presets=["full", "backbone"])] == ["Backbone", "D²-4DGS"]


def test_published_rows_are_labelled_as_the_papers() -> None:
    text = paper_table(paper_rows("pruning"))
    lines = text.splitlines()
    assert all(line.startswith(f"| {MARK}") and "(paper)" in line for line in lines[2:6])
    assert "not measured here" in lines[-1]
    assert "22.2082" in text
    latex = paper_table(paper_rows("pruning"), as_latex=True)
    assert r"actor5\_6" in latex
    assert latex.count(r"\\") == 5
    assert latex.isascii()


def test_the_error_is_that_of_the_psnr() -> None:
    row = PaperRow("main", "any", None, "N3DV", None, 4, 20.0, 0.5, 0.5, 0.1)
    assert row.error == pytest.approx(0.1)


def test_unknown_tables_and_data_sets_are_refused() -> None:
    with pytest.raises(D2Error, match="unknown table of the paper 'prune'.*did you mean 'pruning'"):
        paper_rows("prune")
    with pytest.raises(D2Error, match="unknown data set of the paper 'n3dv'"):
        paper_rows(dataset="n3dv")
