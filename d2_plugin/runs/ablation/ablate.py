"""`d2 ablate`: the paper's ablation tables on any recording: each row over several seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import as_completed
from dataclasses import replace
from pathlib import Path

from d2_plugin.durable import write_text
from d2_plugin.progress import be_silent, progress_bar
from d2_plugin.runs.ablation.presets import Preset
from d2_plugin.runs.ablation.tables import report
from d2_plugin.runs.rows import Row, as_line, make_row, rms_error
from d2_plugin.runs.saved import read_metrics
from d2_plugin.runs.settings import RunSettings, prior_settings
from d2_plugin.runs.shared import Cost, Job, Metrics, give_points, share, share_points
from d2_plugin.runs.workers import worker_pool


def jobs(
    base: RunSettings, presets: Sequence[Preset], backbones: Sequence[str], seeds: Sequence[int], output: Path
) -> list[Job]:
    """Every run, preset by preset; runs with the same variant of the prior share one under `output`/priors.

    Args:
        base: gives recording, cameras, iterations and the user's own tables; hooks, backbone and seed are set here.
        presets, backbones, seeds: what is run.
        output: folder of the ablation.
    """
    output, made = output.absolute(), []
    for backbone in backbones:
        for preset in presets:
            for seed in seeds:
                settings = replace(
                    base, backbone=backbone, hooks=preset.hooks, seed=seed, overrides=preset.merged(base.overrides)
                )
                settings = replace(settings, priors=str(output / "priors" / prior_settings(settings).variant))
                guidance = None if preset.guidance is None else preset.guidance(settings.iterations)
                folder = output / backbone / preset.name / f"seed{seed}"
                made.append(Job(preset.name, settings, folder, guidance))
    return made


def run_jobs(work: Sequence[Job], workers: int, output: Path) -> dict[Job, Metrics]:
    """Train and score what is not finished, `workers` runs at a time with one thread each; the metrics of all.

    Priors and starting points are made once under `output`, before the runs that share them start.
    """
    results = {job: metrics for job in work if (metrics := _finished(job)) is not None}
    missing = [job for job in work if job not in results]
    with progress_bar("ablate", len(work)) as bar:
        bar.update(len(results))
        for job in missing:
            job.run()  # takes its folder
            points = share_points(job.settings, output.absolute())
            if job.uses_prior:
                share(job.settings, output.absolute())
            give_points(points, job.folder)
        with worker_pool(max(workers, 1), _prepare_worker) as pool:
            started = {pool.submit(_run, job): job for job in missing}
            for future in as_completed(started):
                job = started[future]
                try:
                    results[job] = future.result()
                except BaseException:
                    pool.shutdown(wait=False, cancel_futures=True)  # else all other runs would still be trained
                    raise
                bar.update(len(results), f"{job.settings.backbone} {job.preset} seed {job.settings.seed}")
    return {job: results[job] for job in work}


def _finished(job: Job) -> Metrics | None:
    """The metrics of a job that ran to its end with the same settings."""
    path = job.folder / "metrics.json"
    if not path.is_file():
        return None
    job.run()  # refuses a folder of other settings, with one sentence
    metrics = read_metrics(job.folder)
    return metrics if metrics["iterations"] == job.settings.iterations else None


def _prepare_worker() -> None:
    import torch

    torch.set_num_threads(1)
    be_silent()


def _run(job: Job) -> Metrics:
    run = job.run()
    run.train()
    return run.evaluate(images=job.settings.seed == 0)


def write(results: Mapping[Job, Metrics], presets: Sequence[Preset], output: Path, command: str) -> str:
    """ablation.md, ablation.tex and one row per run in runs.jsonl under `output`; returns the Markdown."""
    text = report(results, presets)
    write_text(output / "ablation.md", text)
    write_text(output / "ablation.tex", report(results, presets, as_latex=True))
    rows = "".join(as_line(_row(job, metrics, command)) for job, metrics in results.items())
    write_text(output / "runs.jsonl", rows)
    return text


def _row(job: Job, metrics: Metrics, command: str) -> Row:
    scores = metrics["test"] or {}
    protocol, frames = job.settings.protocol, job.settings.frames
    further = (f", {len(frames)} frames" if frames else "") + (f", {protocol}" if protocol else "")
    return make_row(
        "ablation",
        f"{metrics['recording']}, {len(metrics['train_cameras'])} views{further}",
        f"{job.settings.backbone} {job.preset}",
        f"seed {job.settings.seed}",
        error=rms_error(scores),
        seconds=metrics["seconds"]["train"],
        command=command,
        scores=scores,
        gaussians=metrics["gaussians"],
        iterations=metrics["iterations"],
        seed=job.settings.seed,
        prior_seconds=Cost.of(Path(str(job.settings.priors))).seconds if job.uses_prior else 0.0,
        cameras=list(metrics["train_cameras"]),
        protocol=protocol,
    )
