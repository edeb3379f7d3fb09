"""Run folders of `d2 train` as rows of the report: held-out score, time with that of the prior, Gaussians."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from d2_plugin.errors import MissingExtra
from d2_plugin.recordings.images import encode_jpeg, read_image, shrink_image
from d2_plugin.runs.rows import Row, case_name, command_line, make_row, rms_error
from d2_plugin.runs.saved import read_metrics, read_run
from d2_plugin.runs.settings import HOOK_NAMES, RunSettings
from d2_plugin.store.files import hash_of

IMAGE_WIDTH = 1600
"""Images in the report are made at most this wide by averaging whole blocks, pixels."""


def training_row(folder: Path) -> Row:
    """A run folder as a row: seconds of training, those of the prior beside them, held-out scores.

    The error is the root mean square error of colour that the PSNR stands for. Device, versions and commit are those
    that the run recorded.

    Raises:
        D2Error: no finished run lies there.
    """
    metrics, table = read_metrics(folder), read_run(folder)
    table.pop("guidance", None)
    settings = RunSettings.from_table(table, str(folder / "run.json"))
    scores, seconds = metrics["test"] or {}, metrics["seconds"]
    typed = replace(settings, hooks=settings.hooks or ("none",), overrides={}, protocol=None)
    own = [Path(given).name for given in (settings.mono_onnx, settings.multiview) if given and settings.hooks]
    own += [f"background {settings.background_weight:g}"] if settings.background_weight < 1 else []
    tables = f"TABLES-{hash_of(settings.overrides)[:4]}" if settings.overrides else ""
    command = command_line("d2 train", typed) + (f" --config {tables}" if tables else "")
    row = make_row(
        "training",
        case_name(metrics["recording"], settings),
        ", ".join([method_of(metrics), *own, *([f"own settings {tables[-4:]}"] if tables else [])]),
        f"{metrics['iterations']} steps, seed {settings.seed}",
        error=rms_error(scores),
        seconds=seconds["train"],
        failed=None if scores.get("psnr") is not None else "no camera was held out",
        command=f"{command} --output {folder.resolve().name}",
        run=folder.resolve().name,
        prior_seconds=seconds["priors"],
        gaussians=metrics["gaussians"],
        iterations=metrics["iterations"],
        seed=settings.seed,
        protocol=settings.protocol,
        frames=settings.frames,
        cameras=list(metrics["train_cameras"]),
        test_cameras=metrics.get("test_cameras"),
        images=metrics.get("images", []),
        mono_emulated=metrics.get("mono_emulated", False),
        scores=scores,
    )
    return row | metrics["made"]


def method_of(metrics: Mapping[str, Any]) -> str:
    """The backbone with its hooks: `yang4d`, `yang4d + D2`, or the hooks by name."""
    hooks = [name for name in metrics["hooks"] if name != "prior"]
    if metrics.get("guidance"):
        return f"{metrics['backbone']} + {metrics['guidance']['name']}"
    if not hooks:
        return metrics["backbone"]
    return f"{metrics['backbone']} + " + ("D2" if set(HOOK_NAMES[1:]) <= set(hooks) else ", ".join(hooks))


def image_of(folder: Path) -> tuple[str, str] | None:
    """(name, data URI) of a run's middle held-out image as a JPEG; None where it kept none, or without OpenCV."""
    images = sorted((folder / "images").glob("*.png"))
    if not images:
        return None
    path = images[len(images) // 2]
    try:
        image = read_image(path)
    except MissingExtra:
        return None
    encoded = encode_jpeg(shrink_image(image, -(-image.shape[1] // IMAGE_WIDTH)), 88)
    return path.stem, f"data:image/jpeg;base64,{base64.b64encode(encoded).decode()}"
