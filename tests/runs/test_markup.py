"""One writer of tables: what stands out is bold, and no cell can break the table it stands in."""

from __future__ import annotations

from d2_plugin.runs.markup import Table, latex, markdown

TABLE = Table(("name", "dB"), (("a|b", "28.9 ± 0.5"), ("c", "3")), frozenset({(0, 1)}))


def test_markdown_keeps_bars_inside_their_cell_and_stresses_the_best() -> None:
    assert markdown(TABLE).splitlines() == ["| name | dB |", "| --- | --- |", r"| a\|b | **28.9 ± 0.5** |", "| c | 3 |"]
    best = Table(("a",), (("1|2",),), frozenset({(0, 0)}))
    assert markdown(best).splitlines()[-1] == r"| **1\|2** |"


def test_padded_columns_line_up() -> None:
    lines = markdown(TABLE, padded=True).splitlines()
    assert len({len(line) for line in lines}) == 1
    assert [cell.strip() for cell in lines[3].strip("|").split("|")] == ["c", "3"]


def test_latex_is_a_booktabs_table() -> None:
    assert latex(Table(("method", "D²"), (("a", "1"), ("b", "2")))).splitlines() == [
        r"\begin{tabular}{lc}",
        r"\toprule",
        r"method & D$^2$ \\",
        r"\midrule",
        r"a & 1 \\",
        r"b & 2 \\",
        r"\bottomrule",
        r"\end{tabular}",
    ]
