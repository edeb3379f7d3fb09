"""Run folders of `d2 train` as rows of the report: held-out score, time with that of the prior, Gaussians."""

from __future__ import annotations

import base64
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from d2_plugin.errors import MissingExtra
from d2_plugin.recordings.images import opencv, read_image, shrink_image
from d2_plugin.runs.rows import Row, make_row, rms_error
from d2_plugin.runs.saved import read_metrics, read_run
from d2_plugin.runs.settings import HOOK_NAMES

IMAGE_WIDTH = 1600
"""Images in the report are made at most this wide by averaging whole blocks, pixels."""


def training_rows(folders: Sequence[Path]) -> list[Row]:
    """One row per run folder: seconds of training, those of the prior beside them, held-out scores.

    The error is the root mean square error of colour that the PSNR stands for. Device, versions and commit are those
    that the run recorded.

    Raises:
        D2Error: a folder without metrics.json.
    """
    return [_row(folder) for folder in folders]


def _row(folder: Path) -> Row:
    metrics = read_metrics(folder)
    settings = read_run(folder) if (folder / "run.json").is_file() else {}
    scores = metrics.get("test") or {}
    seconds = metrics["seconds"]
    row = make_row(
        "training",
        case_of(metrics, settings),
        method_of(metrics) + (", own settings" if settings.get("overrides") else ""),
        f"{metrics['iterations']} steps" + (f", seed {settings['seed']}" if "seed" in settings else ""),
        error=rms_error(scores),
        seconds=seconds["train"],
        failed=None if scores.get("psnr") is not None else "no camera was held out",
        command=command_of(metrics, settings, folder.name),
        run=folder.name,
        prior_seconds=seconds["priors"],
        gaussians=metrics["gaussians"],
        iterations=metrics["iterations"],
        seed=settings.get("seed"),
        protocol=settings.get("protocol"),
        frames=settings.get("frames"),
        cameras=list(metrics["train_cameras"]),
        test_cameras=metrics.get("test_cameras"),
        mono_emulated=metrics.get("mono_emulated", False),
        scores=scores,
    )
    return row | metrics["made"]


def command_of(metrics: dict[str, Any], settings: dict[str, Any], output: str) -> str:
    """The `d2 train` command of a run, from what its folder holds: names instead of paths, and no defaults."""
    hooks = metrics["hooks"]
    words = ["d2", "train", metrics["recording"], "--train-cameras", ",".join(metrics["train_cameras"])]
    words += ["--backbone", metrics["backbone"], "--iterations", str(metrics["iterations"])]
    words += ["--hooks", "all" if set(hooks) == set(HOOK_NAMES) else ",".join(hooks) or "none"]
    words += ["--seed", str(settings.get("seed", 0))]
    if settings.get("frames"):
        words += ["--frames", ",".join(map(str, settings["frames"]))]
    if settings.get("test_cameras"):
        words += ["--test-cameras", ",".join(settings["test_cameras"])]
    for name in ("downscale", "mono_kind"):
        if settings.get(name) not in (None, 1):
            words += [f"--{name.replace('_', '-')}", str(settings[name])]
    if settings.get("mono_onnx"):
        words += ["--mono-onnx", Path(settings["mono_onnx"]).name]
    if settings.get("overrides"):
        words += ["--config", "TABLES"]
    return shlex.join([*words, "--output", output])


def case_of(metrics: dict[str, Any], settings: dict[str, Any]) -> str:
    """The recording, how many cameras trained, the size where it is not its own, and the protocol where one chose."""
    smaller = settings.get("downscale", 1)
    size = f", 1/{smaller} size" if smaller > 1 else ""
    protocol = f", {settings['protocol']}" if settings.get("protocol") else ""
    return f"{metrics['recording']}, {len(metrics['train_cameras'])} views{size}{protocol}"


def method_of(metrics: dict[str, Any]) -> str:
    """The backbone with its hooks: `yang4d`, `yang4d + D2`, or the hooks by name."""
    hooks = [name for name in metrics["hooks"] if name != "prior"]
    if metrics.get("guidance"):
        return f"{metrics['backbone']} + {metrics['guidance']['name']}"
    if not hooks:
        return metrics["backbone"]
    return f"{metrics['backbone']} + " + ("D2" if set(HOOK_NAMES[1:]) <= set(hooks) else ", ".join(hooks))


def image_of(folder: Path) -> tuple[str, str] | None:
    """(name, data URI) of the held-out image in the middle of a run's, or None where it kept none.

    As a JPEG of at most `IMAGE_WIDTH` pixels where OpenCV is installed, else the file as it is.
    """
    images = sorted((folder / "images").glob("*.png"))
    if not images:
        return None
    path = images[len(images) // 2]
    try:
        cv2 = opencv("making images smaller")
    except MissingExtra:
        return path.stem, _uri("png", path.read_bytes())
    image = read_image(path)
    image = shrink_image(image, -(-image.shape[1] // IMAGE_WIDTH))
    encoded = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])[1]
    return path.stem, _uri("jpeg", encoded.tobytes())


def _uri(kind: str, data: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
