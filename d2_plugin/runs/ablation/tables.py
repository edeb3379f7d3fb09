"""The tables of an ablation: mean ± standard error over the seeds, and whether the paper's order of rows holds here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from d2_plugin.runs.ablation.claims import EXPLANATION, Scores, claims_table
from d2_plugin.runs.ablation.job import Job, Metrics
from d2_plugin.runs.ablation.paper_tables import MARK, SOURCE, paper_rows
from d2_plugin.runs.ablation.paper_tables import TABLES as PAPER_TABLES
from d2_plugin.runs.ablation.presets import PRESETS, TABLES, Preset
from d2_plugin.runs.markup import Table, latex, markdown
from d2_plugin.runs.tables import STUDY_COLUMNS
from d2_plugin.runs.verdict import Estimate, seeds_in_words

OTHERS = (*TABLES["ablation"][:8], "opacity_only", "depth_only", *TABLES["rivals"][1:-1])
"""Rows that the paper puts below the full method, and the rivals."""


PLUS_MINUS = r"\pm"


def table(
    results: Mapping[Job, Metrics],
    backbone: str,
    rows: Sequence[str],
    as_latex: bool = False,
    published: Mapping[str, float] | None = None,
) -> str:
    """One table, Markdown or LaTeX: mean ± standard error over seeds per preset; what was not measured shows as `-`.

    `published` holds the paper's PSNR by preset: it stands in a column of its own, labelled as the paper's.
    """
    header = ["variant", "seeds", *(column.title for column in STUDY_COLUMNS), "Gaussians", "train s"]
    lines = [[PRESETS[name].title, *_cells(_of(results, backbone, name), as_latex)] for name in rows]
    if published:
        header.append(f"{MARK} paper's PSNR")
        lines = [[*line, f"{published[name]:.2f}" if name in published else "-"] for line, name in zip(lines, rows)]
    made = Table(tuple(header), tuple(map(tuple, lines)))
    return latex(made) if as_latex else markdown(made)


def _of(results: Mapping[Job, Metrics], backbone: str, preset: str) -> list[Metrics]:
    return [metrics for job, metrics in results.items() if (job.backbone, job.preset) == (backbone, preset)]


def _cells(runs: Sequence[Metrics], as_latex: bool) -> list[str]:
    scores = [run["test"] or {} for run in runs]
    found = [(Estimate.of([score.get(column.key) for score in scores]), column.form) for column in STUDY_COLUMNS]
    found.append((Estimate.of([run["gaussians"] for run in runs]), ".0f"))
    found.append((Estimate.of([run["seconds"]["train"] for run in runs]), ".1f"))
    return [seeds_in_words(len(runs)), *(_cell(value, form, as_latex) for value, form in found)]


def _cell(value: Estimate | None, form: str, as_latex: bool) -> str:
    if value is None:
        return "-"
    return f"${value.text(form, PLUS_MINUS)}$" if as_latex else value.text(form)


def scores_of(results: Mapping[Job, Metrics], backbone: str) -> Scores:
    """The held-out scores of one backbone's runs, by the titles of their presets."""
    return {
        preset.title: [run["test"] for run in _of(results, backbone, name) if run["test"]]
        for name, preset in PRESETS.items()
    }


def order_table(results: Mapping[Job, Metrics], backbone: str) -> Table:
    """What the paper's two tables say about the full method, tested on these runs; only rows that were run."""
    full, others = PRESETS["full"].title, [PRESETS[name].title for name in OTHERS]
    return claims_table(scores_of(results, backbone), full, others, f"{full} is better than")


def report(results: Mapping[Job, Metrics], presets: Sequence[Preset], as_latex: bool = False) -> str:
    """All tables whose rows were run, and the paper's order of the rows, for each backbone."""
    names = {preset.name for preset in presets}
    parts = []
    for backbone in dict.fromkeys(job.backbone for job in results):
        parts.append(f"% {backbone}" if as_latex else f"## {backbone}")
        complete = [title for title, rows in TABLES.items() if title != "main" and set(rows) <= names]
        for title in complete:
            of_paper = paper_rows(title) if title in PAPER_TABLES else []
            published = {row.preset: row.psnr for row in of_paper if row.preset}
            parts.append(table(results, backbone, TABLES[title], as_latex, published))
            if of_paper:
                parts.append(f"{'% ' if as_latex else ''}{MARK} {SOURCE} ({PAPER_TABLES[title]}).")
        if not complete:
            parts.append(table(results, backbone, [preset.name for preset in presets], as_latex))
        order = order_table(results, backbone)
        if order.rows and not as_latex:
            parts += [EXPLANATION, markdown(order)]
    return "\n\n".join(part for part in parts if part) + "\n"
