"""`d2 ablate`: the paper's ablation tables, and rivals, on any recording: each row over several seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import as_completed
from dataclasses import replace
from pathlib import Path

from d2_plugin import durable
from d2_plugin.durable import Kind, read_table, write_table, write_text
from d2_plugin.progress import be_silent, progress_bar
from d2_plugin.runs.ablation.job import Job, Metrics
from d2_plugin.runs.ablation.presets import Preset
from d2_plugin.runs.ablation.tables import report
from d2_plugin.runs.rows import Row, as_line, make_row
from d2_plugin.runs.saved.kinds import read_metrics
from d2_plugin.runs.settings import RunSettings, prior_settings
from d2_plugin.runs.shared import share
from d2_plugin.runs.workers import worker_pool

PRIOR_SECONDS = Kind("time of a prior", 1, "delete it")
"""PRIORS.seconds.json, beside each prior that runs share."""


def jobs(
    base: RunSettings, presets: Sequence[Preset], backbones: Sequence[str], seeds: Sequence[int], output: Path
) -> list[Job]:
    """Every run, preset by preset; runs with the same prior settings share one prior under `output`/priors.

    Where any row uses a prior, points and full prior are made here, and all rows get the background that it asks for.

    Args:
        base: gives recording, cameras, iterations and the user's own tables; hooks, backbone and seed are set here.
        presets, backbones, seeds: what is run.
        output: folder of the ablation.
    """
    output, made = output.absolute(), []
    if any(preset.hooks or preset.rival for preset in presets):
        share(base, output)
    for backbone in backbones:
        for preset in presets:
            for seed in seeds:
                settings = replace(
                    base, backbone=backbone, hooks=preset.hooks, seed=seed, overrides=preset.merged(base.overrides)
                )
                settings = replace(settings, priors=str(output / "priors" / prior_settings(settings).variant))
                folder = output / backbone / preset.name / f"seed{seed}"
                made.append(Job(preset.name, backbone, seed, settings, folder, preset.rival))
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
        with worker_pool(max(workers, 1), _prepare_worker) as pool:
            started = {pool.submit(_run, job): job for job in missing}
            for future in as_completed(started):
                job = started[future]
                try:
                    results[job] = future.result()
                except BaseException:
                    pool.shutdown(wait=False, cancel_futures=True)  # else all other runs would still be trained
                    raise
                bar.update(len(results), f"{job.backbone} {job.preset} seed {job.seed}")
    return {job: results[job] for job in work}


def _finished(job: Job) -> Metrics | None:
    """The metrics of a job that ran to its end with the same settings."""
    path = job.folder / "metrics.json"
    if not path.is_file():
        return None
    job.run()  # refuses a folder of other settings, with one sentence
    metrics = read_metrics(job.folder)
    return metrics if metrics["iterations"] == job.settings.iterations else None


def _share(work: Sequence[Job]) -> None:
    """Points for every run, and the other priors, each built once: runs side by side never build the same twice."""
    built: set[str | None] = set()
    output = Path(str(work[0].settings.priors)).parents[1]
    shared = share(work[0].settings, output) if (output / "shared.json").is_file() else None
    points = output / "points.npz" if shared is not None else None
    for job in work:
        run = job.run()
        if points is None:
            run.prepare(priors=False)
            points = run.folder / "points.npz"
        elif not (run.folder / "points.npz").is_file():
            durable.write(run.folder / "points.npz", points.read_bytes())
        if run.uses_prior and job.settings.priors not in built:
            run.prepare()
            built.add(job.settings.priors)
            measured = _prior_seconds_file(job.settings)
            if not measured.exists():  # a build that was cut off and continues would time its second part alone
                whole = shared is not None and Path(str(job.settings.priors)) == shared.priors
                seconds = shared.seconds if shared and whole else run.seconds["priors"]
                write_table(measured, {"seconds": seconds}, PRIOR_SECONDS)


def _prior_seconds_file(settings: RunSettings) -> Path:
    return Path(f"{settings.priors}.seconds.json")


def _prior_seconds(job: Job) -> float | None:
    """How long the prior of a run took, which others share; 0 without one, None where it was not measured."""
    if not job.settings.hooks and job.rival is None:
        return 0.0
    measured = _prior_seconds_file(job.settings)
    return read_table(measured, PRIOR_SECONDS)["seconds"] if measured.exists() else None


def _prepare_worker() -> None:
    import torch

    torch.set_num_threads(1)
    be_silent()


def _run(job: Job) -> Metrics:
    run = job.run()
    run.train()
    return run.evaluate(images=job.seed == 0)


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
    psnr = scores.get("psnr")
    protocol, frames = job.settings.protocol, job.settings.frames
    further = (f", {len(frames)} frames" if frames else "") + (f", {protocol}" if protocol else "")
    return make_row(
        "ablation",
        f"{metrics['recording']}, {len(metrics['train_cameras'])} cameras{further}",
        f"{job.backbone} {job.preset}",
        f"seed {job.seed}",
        error=None if psnr is None else 10 ** (-psnr / 20),
        seconds=metrics["seconds"]["train"],
        command=command,
        scores=scores,
        gaussians=metrics["gaussians"],
        iterations=metrics["iterations"],
        prior_seconds=_prior_seconds(job),
        cameras=list(metrics["train_cameras"]),
        protocol=protocol,
    )
