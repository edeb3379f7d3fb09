"""The tables of an ablation: mean ± standard error over the seeds, and whether the paper's order of rows holds here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from d2_plugin.runs.ablation.presets import PRESETS, PUBLISHED, TABLES, Preset
from d2_plugin.runs.shared import Job, Metrics
from d2_plugin.runs.tables import STUDY_COLUMNS, Column, Table, latex, markdown
from d2_plugin.runs.verdict import EXPLANATION, Estimate, seeds_in_words, verdicts_table

MARK = "○"
"""What a published figure carries in a table, where ours carry nothing."""


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
    measured = {key for run in results.values() for key, value in (run["test"] or {}).items() if value is not None}
    columns = [column for column in STUDY_COLUMNS if column.always or column.key in measured]
    header = ["variant", "seeds", *(column.title for column in columns), "Gaussians", "train s"]
    lines = [[_title(name), *_cells(_of(results, backbone, name), columns, as_latex)] for name in rows]
    if published:
        header.append(f"{MARK} paper's PSNR")
        lines = [[*line, f"{published[name]:.2f}" if name in published else "-"] for line, name in zip(lines, rows)]
    made = Table(tuple(header), tuple(map(tuple, lines)))
    return latex(made) if as_latex else markdown(made)


def _title(name: str) -> str:
    return PRESETS[name].title if name in PRESETS else name


def _of(results: Mapping[Job, Metrics], backbone: str, preset: str) -> list[Metrics]:
    return [metrics for job, metrics in results.items() if (job.settings.backbone, job.preset) == (backbone, preset)]


def _cells(runs: Sequence[Metrics], columns: Sequence[Column], as_latex: bool) -> list[str]:
    scores = [run["test"] or {} for run in runs]
    estimates = [(Estimate.of([score.get(column.key) for score in scores]), column.form) for column in columns]
    estimates.append((Estimate.of([run["gaussians"] for run in runs]), ".0f"))
    estimates.append((Estimate.of([run["seconds"]["train"] for run in runs]), ".1f"))
    return [seeds_in_words(len(runs)), *(_cell(value, form, as_latex) for value, form in estimates)]


def _cell(value: Estimate | None, form: str, as_latex: bool) -> str:
    if value is None:
        return "-"
    return "$" + value.text(form, r"\pm") + "$" if as_latex else value.text(form)


def order_table(results: Mapping[Job, Metrics], backbone: str) -> Table:
    """Whether the full method is better than each other row that was run, metric by metric."""
    scores = {
        _title(name): [run["test"] for run in _of(results, backbone, name) if run["test"]]
        for name in dict.fromkeys(job.preset for job in results)
    }
    full = PRESETS["full"].title
    return verdicts_table(scores, full, [name for name in scores if name != full], f"{full} is better than")


def report(results: Mapping[Job, Metrics], presets: Sequence[Preset], as_latex: bool = False) -> str:
    """All tables whose rows were run, and the paper's order of the rows, for each backbone."""
    names = {preset.name for preset in presets}
    parts = []
    for backbone in dict.fromkeys(job.settings.backbone for job in results):
        parts.append(f"% {backbone}" if as_latex else f"## {backbone}")
        complete = [title for title, rows in TABLES.items() if title != "main" and set(rows) <= names]
        for title in complete:
            about, published = PUBLISHED[title]
            parts.append(table(results, backbone, TABLES[title], as_latex, published))
            parts.append(f"{'% ' if as_latex else ''}{MARK} as published, not measured here ({about}).")
        if not complete:
            parts.append(table(results, backbone, [preset.name for preset in presets], as_latex))
        order = order_table(results, backbone)
        if order.rows and not as_latex:
            parts += [EXPLANATION, markdown(order)]
    return "\n\n".join(part for part in parts if part) + "\n"
