"""Tables of texts, written as Markdown or LaTeX: the one place that knows how either of them writes a table."""

from __future__ import annotations

from typing import NamedTuple

_LATEX = {"²": "$^2$", "○": r"$\circ$", "µ": r"$\mu$"}
"""Signs of our tables that LaTeX writes otherwise."""


class Table(NamedTuple):
    """A table of texts; `best` are the cells (row, column) that stand out."""

    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    best: frozenset[tuple[int, int]] = frozenset()


def markdown(table: Table, padded: bool = False) -> str:
    """The table as Markdown; what stands out is bold. `padded` makes its columns line up in a terminal."""
    rows = [
        [_markdown_cell(cell, (i, k) in table.best) for k, cell in enumerate(row)] for i, row in enumerate(table.rows)
    ]
    lines = [[_markdown_cell(title, False) for title in table.header], ["---"] * len(table.header), *rows]
    if padded:
        widths = [max(len(line[column]) for line in lines) for column in range(len(table.header))]
        lines = [[cell.ljust(width) for cell, width in zip(line, widths, strict=True)] for line in lines]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def latex(table: Table) -> str:
    """The table in the form of the paper's (booktabs): the first column to the left, the others centred.

    Its cells are LaTeX already; signs that LaTeX lacks are replaced here.
    """
    head, *body = (" & ".join(line) + r" \\" for line in (table.header, *table.rows))
    begin = rf"\begin{{tabular}}{{l{'c' * (len(table.header) - 1)}}}"
    text = "\n".join([begin, r"\toprule", head, r"\midrule", *body, r"\bottomrule", r"\end{tabular}"])
    for sign, written in _LATEX.items():
        text = text.replace(sign, written)
    return text


def _markdown_cell(cell: str, best: bool) -> str:
    text = " ".join(cell.splitlines()).replace("|", "\\|").replace("<", "&lt;")  # no tag in a page made of it
    return f"**{text}**" if best else text
