"""`d2 ablate`: the paper's ablation tables on any recording: each row over several seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from d2_plugin.durable import write_text
from d2_plugin.errors import D2Error
from d2_plugin.runs.ablation.presets import PRESETS, PUBLISHED, TABLES, Preset
from d2_plugin.runs.rows import Row, case_name
from d2_plugin.runs.scene import Scene
from d2_plugin.runs.settings import RunSettings, prior_settings
from d2_plugin.runs.shared import Shared, share, share_points
from d2_plugin.runs.tables import STUDY_COLUMNS, Table, markdown
from d2_plugin.runs.training.measured import Work, by_key, measure_missing
from d2_plugin.runs.verdict import EXPLANATION, estimated, seeds_in_words, verdicts_table
from d2_plugin.values import counted

MARK = "○"
"""What a published figure carries in a table, where ours carry nothing."""


def ablate(
    base: RunSettings,
    presets: Sequence[Preset],
    backbones: Sequence[str],
    seeds: Sequence[int],
    output: Path,
    workers: int,
    command: str,
) -> str:
    """Train and score what is not finished, `workers` runs at a time with one thread each; returns the tables.

    Priors and starting points are made once under `output`, before the runs that share them start. Writes ablation.md,
    and in runs.jsonl one row per run as soon as it is finished.

    `base` gives recording, cameras, iterations and the user's own tables, and `command`, for the rows, is how this was
    started. Runs with the same variant of the prior share one.

    Raises:
        D2Error: no camera is held out.
    """
    if not Scene.open(base).test_cameras:
        raise D2Error("all cameras train, so no run can be scored: leave one out of --train-cameras")
    output = output.absolute()
    works = [
        _work(base, backbone, preset, seed, output, command)
        for backbone in backbones
        for preset in presets
        for seed in seeds
    ]
    rows = by_key(measure_missing("ablate", works, output / "runs.jsonl", workers))
    text = report([rows[key] for key in dict.fromkeys(work.key for work in works)], presets)
    write_text(output / "ablation.md", text)
    return text


def _work(base: RunSettings, backbone: str, preset: Preset, seed: int, output: Path, command: str) -> Work:
    """One run with all that it shares, in a folder that is its own from here on."""
    guidance = None if preset.guidance is None else preset.guidance(base.iterations)
    settings = replace(base, backbone=backbone, hooks=preset.hooks, seed=seed, overrides=preset.merged(base.overrides))
    variant = prior_settings(settings).variant
    settings = replace(settings, priors=str(output / "priors" / variant))
    case = case_name(Path(settings.recording).resolve().name, settings)
    case += f", {counted(len(settings.frames), 'frame')}" if settings.frames else ""
    shared = Shared(output, variant)
    share_points(settings, output)
    if preset.hooks or guidance is not None:
        share(settings, output)
    work = Work(
        *(settings, output / backbone / preset.name / f"seed{seed}", shared.points),
        *(case, f"{backbone} {preset.name}", command, f"{settings.iterations} steps"),
        {"prior_seconds": preset.seconds_of_prior(settings, shared), "protocol": settings.protocol},
        kind="ablation",
        guidance=guidance,
        kept=True,
    )
    work.run()  # refuses a folder of other settings, with one sentence
    return work


def report(rows: Sequence[Row], presets: Sequence[Preset]) -> str:
    """All tables whose rows were run, and the paper's order of the rows, for each backbone."""
    parts, names = [], {preset.name for preset in presets}
    for backbone in dict.fromkeys(row["method"].partition(" ")[0] for row in rows):
        parts.append(f"## {backbone}")
        mine = {
            preset.name: [row for row in rows if row["method"] == f"{backbone} {preset.name}"] for preset in presets
        }
        complete = [title for title in PUBLISHED if set(TABLES[title]) <= names]
        for title in complete:
            about, published = PUBLISHED[title]
            parts.append(table({name: mine[name] for name in TABLES[title]}, published))
            parts.append(f"{MARK} as published, not measured here ({about}).")
        if not complete:
            parts.append(table(mine))
        order = order_table(mine)
        if order.rows:
            parts += [EXPLANATION, markdown(order)]
    parts += [f"{row['method']}, {row['setting']} has no score: {row['failed']}." for row in rows if row.get("failed")]
    return "\n\n".join(parts) + "\n"


def table(runs: Mapping[str, Sequence[Row]], published: Mapping[str, float] | None = None) -> str:
    """One Markdown table: mean ± standard error over the seeds of each preset; what was not measured shows as `-`.

    `published` holds the paper's PSNR by preset: it stands in a column of its own, labelled as the paper's.
    """
    scores = {name: [_scores(row) for row in mine] for name, mine in runs.items()}
    measured = {key for mine in scores.values() for score in mine for key, value in score.items() if value is not None}
    columns = [column for column in STUDY_COLUMNS if column.always or column.key in measured]
    header = ["variant", "seeds", *(column.title for column in columns), "Gaussians", "train s"]
    lines = []
    for name, mine in runs.items():
        shown = [([score.get(column.key) for score in scores[name]], column.form) for column in columns]
        shown += [([row.get("gaussians") for row in mine], ".0f"), ([row["seconds"] for row in mine], ".1f")]
        seeds = seeds_in_words(sum(bool(score) for score in scores[name]))
        lines.append([_title(name), seeds, *(estimated(*values) for values in shown)])
        if published:
            lines[-1].append(f"{published[name]:.2f}" if name in published else "-")
    header += [f"{MARK} paper's PSNR"] if published else []
    return markdown(Table(tuple(header), tuple(map(tuple, lines))))


def order_table(runs: Mapping[str, Sequence[Row]]) -> Table:
    """Whether the full method is better than each other preset that was run, metric by metric."""
    scores = {_title(name): [_scores(row) for row in mine if row.get("scores")] for name, mine in runs.items()}
    full = PRESETS["full"].title
    return verdicts_table(scores, full, [name for name in scores if name != full], f"{full} is better than")


def _scores(row: Row) -> dict[str, float | None]:
    return row.get("scores") or {}


def _title(name: str) -> str:
    return PRESETS[name].title if name in PRESETS else name
