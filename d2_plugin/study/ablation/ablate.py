"""`d2 ablate`: the paper's ablation tables on any capture, each variant over several seeds, as mean and deviation."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from statistics import mean, stdev
from typing import Any

from d2_plugin.progress import be_silent, progress_bar
from d2_plugin.runs.settings import RunSettings, prior_settings
from d2_plugin.study.ablation.paper_tables import MARK, SOURCE, paper_rows
from d2_plugin.study.ablation.paper_tables import TABLES as PAPER_TABLES
from d2_plugin.study.ablation.presets import PRESETS, TABLES, Preset

Metrics = Mapping[str, Any]

COLUMNS = (
    ("PSNR", "psnr", 2),
    ("SSIM1", "ssim1", 4),
    ("SSIM2", "ssim2", 4),
    ("LPIPS", "lpips", 4),
    ("depth AbsRel", "depth_absrel", 4),
)


@dataclass(frozen=True, eq=False)
class Job:
    """One run of an ablation."""

    preset: str
    backbone: str
    seed: int
    settings: RunSettings
    folder: Path


@dataclass(frozen=True)
class Claim:
    """One order that the paper's method implies, and the margin by which it holds here."""

    sentence: str
    margin: float
    """dB of mean PSNR; negative where it is the other way round."""
    error: float
    """Standard error of the margin over the seeds, dB."""

    @property
    def verdict(self) -> str:
        """ "holds" or "fails" where the margin is more than two standard errors, otherwise "undecided"."""
        if abs(self.margin) <= 2 * self.error:
            return "undecided"
        return "holds" if self.margin > 0 else "fails"

    def __str__(self) -> str:
        return f"- {self.verdict}: {self.sentence} ({self.margin:+.2f} ± {self.error:.2f} dB)"


def jobs(
    base: RunSettings, presets: Sequence[Preset], backbones: Sequence[str], seeds: Sequence[int], output: Path
) -> list[Job]:
    """Every run, preset by preset; runs with the same prior settings share one prior under `output`/priors.

    `base` gives capture, cameras, iterations and the user's own tables; hooks, backbone and seed are set here.
    """
    made = []
    for backbone in backbones:
        for preset in presets:
            for seed in seeds:
                settings = replace(
                    base, backbone=backbone, hooks=preset.hooks, seed=seed, overrides=preset.merged(base.overrides)
                )
                settings = replace(settings, priors=str(output / "priors" / prior_settings(settings).variant))
                made.append(Job(preset.name, backbone, seed, settings, output / backbone / preset.name / f"seed{seed}"))
    return made


def run_jobs(work: Sequence[Job], workers: int) -> dict[Job, Metrics]:
    """Train and score what is not finished, `workers` runs at a time with one thread each; the metrics of all.

    Priors and starting points are made once, before the runs that share them start.
    """
    results = {job: found for job in work if (found := _finished(job)) is not None}
    missing = [job for job in work if job not in results]
    with progress_bar("ablate", len(work)) as bar:
        bar.update(len(results))
        if missing:
            _share(missing)
        with ProcessPoolExecutor(max(workers, 1), get_context("spawn"), _prepare_worker) as pool:
            started = {pool.submit(_run, job): job for job in missing}
            for future in as_completed(started):
                job = started[future]
                try:
                    results[job] = future.result()
                except BaseException:
                    pool.shutdown(wait=False, cancel_futures=True)  # the rest would run to its end unheard
                    raise
                bar.update(len(results), f"{job.backbone} {job.preset} seed {job.seed}")
    return {job: results[job] for job in work}


def _finished(job: Job) -> Metrics | None:
    """The metrics of a job that ran to its end with the same settings."""
    from d2_plugin.runs.run import Run

    path = job.folder / "metrics.json"
    if not path.is_file():
        return None
    Run(job.settings, job.folder)  # refuses a folder of other settings, with one sentence
    metrics = json.loads(path.read_text())
    return metrics if metrics["iterations"] == job.settings.iterations else None


def _share(work: Sequence[Job]) -> None:
    """Triangulate once, and build each prior once, so that runs side by side never build the same thing twice."""
    from d2_plugin.runs.run import Run

    first: dict[str, Run] = {}
    points: Path | None = None
    for job in work:
        run = Run(job.settings, job.folder)
        if points is None:
            run.prepare(priors=False)
            points = run.folder / "points.npz"
        elif not (run.folder / "points.npz").is_file():
            shutil.copyfile(points, run.folder / "points.npz")
        if run.uses_prior and job.settings.priors not in first:
            run.prepare()
            first[job.settings.priors] = run
            measured = _prior_seconds_file(job.settings)
            if not measured.exists():  # a build that goes on would only tell its rest
                measured.write_text(json.dumps(run.seconds["priors"]))


def _prior_seconds_file(settings: RunSettings) -> Path:
    return Path(f"{settings.priors}.seconds.json")


def _prior_seconds(settings: RunSettings) -> float | None:
    """How long the prior of a run took, which others share; 0 without a prior, None where it was not measured."""
    if not settings.hooks:
        return 0.0
    measured = _prior_seconds_file(settings)
    return json.loads(measured.read_text()) if measured.exists() else None


def _prepare_worker() -> None:
    import torch

    torch.set_num_threads(1)
    be_silent()


def _run(job: Job) -> Metrics:
    from d2_plugin.runs.run import Run

    run = Run(job.settings, job.folder)
    run.train()
    return run.evaluate(pictures=job.seed == 0)


def statistics(values: Sequence[float | None]) -> tuple[float, float] | None:
    """Mean and sample deviation (0 for a single value); None where nothing was measured."""
    known = [value for value in values if value is not None]
    if not known:
        return None
    return mean(known), stdev(known) if len(known) > 1 else 0.0


def table(
    results: Mapping[Job, Metrics],
    backbone: str,
    rows: Sequence[str],
    latex: bool = False,
    published: Mapping[str, float] | None = None,
) -> str:
    """One table, Markdown or LaTeX: mean ± deviation over seeds per preset; what was not measured shows as `-`.

    `published` holds the paper's PSNR by preset: it stands in a column of its own, labelled as the paper's.
    """
    titles = ["variant", *(title for title, _, _ in COLUMNS), "Gaussians", "train s"]
    lines = [[PRESETS[name].title, *_cells(_of(results, backbone, name), latex)] for name in rows]
    if published:
        titles.append(f"{MARK} paper's PSNR")
        lines = [[*line, f"{published[name]:.2f}" if name in published else "-"] for line, name in zip(lines, rows)]
    if latex:
        head = f"\\begin{{tabular}}{{l{'c' * (len(titles) - 1)}}}\n\\toprule\n"
        body = (
            "\n".join(" & ".join(line) + r" \\" for line in [titles, *lines])
            .replace("²", "$^2$")
            .replace(MARK, r"$\circ$")
        )
        return head + body.replace(r"\\", "\\\\\n\\midrule", 1) + "\n\\bottomrule\n\\end{tabular}"
    rule = ["---"] * len(titles)
    return "\n".join("| " + " | ".join(line) + " |" for line in [titles, rule, *lines])


def _of(results: Mapping[Job, Metrics], backbone: str, preset: str) -> list[Metrics]:
    return [metrics for job, metrics in results.items() if (job.backbone, job.preset) == (backbone, preset)]


def _cells(runs: Sequence[Metrics], latex: bool) -> list[str]:
    scores = [run["test"] or {} for run in runs]
    cells = [_cell(statistics([score.get(key) for score in scores]), digits, latex) for _, key, digits in COLUMNS]
    cells.append(_cell(statistics([run["gaussians"] for run in runs]), 0, latex))
    return [*cells, _cell(statistics([run["seconds"]["train"] for run in runs]), 1, latex)]


def _cell(value: tuple[float, float] | None, digits: int, latex: bool) -> str:
    if value is None:
        return "-"
    middle, spread = (f"{number:.{digits}f}" for number in value)
    return f"${middle} \\pm {spread}$" if latex else f"{middle} ± {spread}"


def claims(results: Mapping[Job, Metrics], backbone: str) -> list[Claim]:
    """What the paper's two tables say about the method, tested on these runs; only claims whose rows were run."""

    scores = {name: [run["test"]["psnr"] for run in _of(results, backbone, name) if run["test"]] for name in PRESETS}
    others = (*TABLES["ablation"][:8], "opacity_only", "depth_only")
    return [_claim(scores, other) for other in others if scores["full"] and scores[other]]


def _claim(scores: Mapping[str, Sequence[float]], other: str) -> Claim:
    (ours, spread), (theirs, their_spread) = statistics(scores["full"]), statistics(scores[other])
    error = math.sqrt(spread**2 / len(scores["full"]) + their_spread**2 / len(scores[other]))
    return Claim(f"{PRESETS['full'].title} is above {PRESETS[other].title}", ours - theirs, error)


def report(results: Mapping[Job, Metrics], presets: Sequence[Preset], latex: bool = False) -> str:
    """All tables whose rows were run, and the claims, for each backbone."""
    names = {preset.name for preset in presets}
    parts = []
    for backbone in dict.fromkeys(job.backbone for job in results):
        parts.append(f"% {backbone}" if latex else f"## {backbone}")
        complete = [title for title, rows in TABLES.items() if title != "main" and set(rows) <= names]
        for title in complete:
            published = {row.preset: row.psnr for row in paper_rows(title)}
            parts.append(table(results, backbone, TABLES[title], latex, published))
            parts.append(f"{'% ' if latex else ''}{MARK} {SOURCE} ({PAPER_TABLES[title]}).")
        if not complete:
            parts.append(table(results, backbone, [preset.name for preset in presets], latex))
        if not latex:
            parts.append("\n".join(str(claim) for claim in claims(results, backbone)))
    return "\n\n".join(part for part in parts if part) + "\n"


def write(results: Mapping[Job, Metrics], presets: Sequence[Preset], output: Path, command: str) -> str:
    """ablation.md, ablation.tex and one row per run in runs.jsonl under `output`; returns the Markdown."""
    from d2_plugin.study.rows import append_rows, make_row

    text = report(results, presets)
    (output / "ablation.md").write_text(text)
    (output / "ablation.tex").write_text(report(results, presets, latex=True))
    rows = output / "runs.jsonl"
    rows.unlink(missing_ok=True)
    append_rows(rows, (_row(make_row, job, metrics, command) for job, metrics in results.items()))
    return text


def _row(make_row: Any, job: Job, metrics: Metrics, command: str) -> dict[str, Any]:
    scores = metrics["test"] or {}
    psnr = scores.get("psnr")
    return make_row(
        "ablation",
        f"{metrics['capture']}, {len(metrics['train_cameras'])} cameras",
        f"{job.backbone} {job.preset}",
        f"seed {job.seed}",
        error=None if psnr is None else 10 ** (-psnr / 20),
        seconds=metrics["seconds"]["train"],
        command=command,
        scores=scores,
        gaussians=metrics["gaussians"],
        iterations=metrics["iterations"],
        prior_seconds=_prior_seconds(job.settings),
    )
