"""One run from a capture to a held-out score: plan, points, priors, training, evaluation, in one resumable folder."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from d2_plugin import registry
from d2_plugin.errors import D2Error
from d2_plugin.plugin import D2Hooks
from d2_plugin.progress import progress_bar
from d2_plugin.runs.provenance import circumstances
from d2_plugin.runs.start import Extent, TrainingFrames, initial_points, make_view, scene_extent, triangulated_points
from d2_plugin.runs.scene import Scene
from d2_plugin.runs.settings import HOOK_NAMES, RunSettings, check, hook_config, prior_settings

RENDERED_ALPHA = 0.5
"""A rendered depth is reported where the accumulated alpha exceeds this."""

CHECKPOINTS = 10
"""Times in a run that it is saved; a run that was cut off continues from the last one, bitwise."""


class Run:
    """A run folder: run.json (settings), points.npz, priors/, checkpoint.pt, metrics.json, pictures/."""

    def __init__(self, settings: RunSettings, folder: Path) -> None:
        self.settings, self.folder = check(settings), folder
        self.scene = Scene.open(self.settings)
        _claim(folder, self.settings)
        self.seconds = {"priors": 0.0, "train": 0.0, "eval": 0.0}
        self.retired: dict[str, int] = {}
        """Hooks that stopped because they changed next to nothing, and at which step."""

    @classmethod
    def load(cls, folder: Path) -> Run:
        """The run that lies in `folder`."""
        path = folder / "run.json"
        if not path.is_file():
            raise D2Error(f"{folder} holds no run: expected run.json; give the --output folder of `d2 train`")
        table = json.loads(path.read_text())
        tuples = {key: tuple(value) if isinstance(value, list) else value for key, value in table.items()}
        return cls(RunSettings(**tuples), folder)

    @property
    def uses_prior(self) -> bool:
        """Whether any hook of this run needs the depth prior."""
        return any(name in self.settings.hooks for name in HOOK_NAMES[1:])

    def prepare(self, priors: bool = True) -> tuple[Extent, tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Triangulate the sparse points and build the depth prior where they are missing; the extent and the points."""
        with self._timed("priors"):
            extent, sparse = self._points()
            if priors and self.uses_prior:
                build_priors_for(self.settings, self.scene, sparse[0], self.priors)
        return extent, sparse

    def train(self) -> None:
        """Build what is missing, then train to the last iteration, continuing from a checkpoint if there is one."""
        extent, sparse = self.prepare()
        trainer = self._trainer(extent, sparse)
        self._restore(trainer)
        iterations = self.settings.iterations
        chunk = max(iterations // CHECKPOINTS, 1)
        with progress_bar("train", iterations) as bar:
            while trainer.step < iterations:
                until = min((trainer.step // chunk + 1) * chunk, iterations)
                with self._timed("train"):
                    trainer.run(until, lambda step, loss: bar.update(step, f"loss {loss:.4f}"))
                self._save(trainer)
        self.retired = {} if trainer.d2 is None else dict(trainer.d2.retired)

    def evaluate(self, pictures: bool = True) -> dict[str, Any]:
        """Score every held-out camera at every frame; returns the metrics.

        Writes metrics.json (per view, per frame, per camera, mean), the same as tables in metrics.md and metrics.tex,
        and pictures/.
        """
        from d2_plugin.runs.evaluation import evaluate
        from d2_plugin.runs.lpips import find_lpips
        from d2_plugin.runs.tables import write_tables

        trainer, scene = self._trained(), self.scene
        cameras = scene.test_cameras or scene.train_cameras
        total = len(cameras) * len(scene.capture.frames)
        with progress_bar("evaluate", total) as bar, self._timed("eval"):
            scores = evaluate(
                self._renderer(trainer.model),
                scene.capture,
                cameras,
                scene.capture.frames,
                self.folder / "pictures" if pictures else None,
                lpips=find_lpips("alex"),
                lpips_vgg=find_lpips("vgg"),
                progress=lambda done, _: bar.update(done),
            )
        if not scene.test_cameras:
            scores = {"test": None, "train": scores.pop("test")} | scores
        metrics = scores | {
            "gaussians": len(trainer.model),
            "iterations": trainer.step,
            "seconds": {name: round(value, 3) for name, value in self.seconds.items()},
            "train_cameras": list(scene.train_cameras),
            "test_cameras": list(scene.test_cameras),
            "backbone": self.settings.backbone,
            "hooks": list(self.settings.hooks),
            "retired": self.retired,
            "plan": scene.plan.as_dict(),
            "capture": scene.capture.name,
            "mono_emulated": scene.capture.mono_emulated,
            "notes": list(scene.capture.notes),
            "made": circumstances(),
        }
        _write_json(self.folder / "metrics.json", metrics)
        write_tables(metrics, self.folder)
        return metrics

    def export_ply(self) -> list[Path]:
        """One 3DGS PLY per frame under ply/: the Gaussians of that instant, temporal opacity folded in."""
        from d2_plugin.runs.gaussian_ply import write_ply

        trainer = self._trained()
        paths = []
        for frame in self.scene.capture.frames:
            view = make_view(self.scene.capture, self.scene.train_cameras[0], frame, self.settings.device)
            with torch.no_grad():
                splats = trainer.model.slice_at(view)
                colors = trainer.model.colors(view, splats)
            paths.append(self.folder / "ply" / f"frame_{frame:05d}.ply")
            paths[-1].parent.mkdir(exist_ok=True)
            write_ply(paths[-1], splats.means, splats.covariances, colors, splats.opacities)
        return paths

    @property
    def priors(self) -> Path:
        """Folder of the depth prior."""
        return Path(self.settings.priors) if self.settings.priors else self.folder / "priors"

    def _points(self) -> tuple[Extent, tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Extent of the scene and its triangulated points (positions, colors, frames), kept in points.npz."""
        path = self.folder / "points.npz"
        if not path.is_file():
            _write_npz(path, **triangulated_points(self.scene.capture, self.scene.train_cameras))
        with np.load(path) as stored:
            sparse = (stored["positions"], stored["colors"], stored["frames"])
        return scene_extent(self.scene.capture, self.scene.train_cameras, sparse[0]), sparse

    def _trainer(self, extent: Extent, sparse: tuple, attach: bool = True) -> Any:
        backbone = registry.load(registry.BACKBONES, self.settings.backbone)
        points = initial_points(self.scene.capture, self.scene.train_cameras, sparse, extent, self.settings.seed)
        frames = self.scene.capture.frames
        model = backbone.create(
            *(values.to(self.settings.device) for values in (points.positions, points.colors, points.times)),
            extent=extent.radius,
            duration=self.scene.capture.seconds(frames[-1]),
            temporal=self.scene.plan.uses("temporal"),
            settings=self.settings.overrides.get("backbone", {}),
        )
        training = backbone.TrainSettings(iterations=self.settings.iterations, seed=self.settings.seed)
        pictures = TrainingFrames(self.scene.capture, self.scene.train_cameras, self.settings.device)
        return backbone.Trainer(model, pictures, training, self._attach if attach and self.uses_prior else None)

    def _trained(self) -> Any:
        """The trainer at the last checkpoint, without hooks."""
        trainer = self._trainer(*self._points(), attach=False)
        if not self._restore(trainer):
            raise D2Error(f"{self.folder} holds no checkpoint yet: run `d2 train` to its end first")
        return trainer

    def _attach(self, model: object) -> D2Hooks:
        adapter = registry.load(registry.ADAPTERS, self.settings.backbone)
        config = hook_config(self.settings, self.priors)
        (self.folder / "d2.toml").write_text(config.to_toml())
        return D2Hooks.from_config(config, backbone=adapter(model))

    def _renderer(self, model: Any) -> Callable[[str, int], tuple[Tensor, Tensor]]:
        @torch.no_grad()
        def render(camera: str, frame: int) -> tuple[Tensor, Tensor]:
            view = make_view(self.scene.capture, camera, frame, self.settings.device)
            color, depth_sum, alpha = (part.cpu() for part in model.render(view)[:3])
            solid = alpha > RENDERED_ALPHA
            depth = torch.where(solid, depth_sum / alpha.clamp(min=RENDERED_ALPHA), torch.zeros_like(alpha))
            return color.clamp(0, 1), depth

        return render

    def _save(self, trainer: Any) -> None:
        state = trainer.state_dict() | {"seconds": dict(self.seconds)}
        temporary = self.folder / "checkpoint.tmp"
        torch.save(state, temporary)
        os.replace(temporary, self.folder / "checkpoint.pt")

    def _restore(self, trainer: Any) -> bool:
        path = self.folder / "checkpoint.pt"
        if not path.is_file():
            return False
        state = torch.load(path, map_location=self.settings.device, weights_only=True)
        self.retired = dict(state["d2"]["retired"]) if state["d2"] else {}
        if trainer.d2 is None:
            state["d2"] = None
        trainer.load_state_dict(state)
        self.seconds = {name: max(value, self.seconds[name]) for name, value in state["seconds"].items()}
        return True

    @contextmanager
    def _timed(self, name: str) -> Iterator[None]:
        start = time.monotonic()
        try:
            yield
        finally:
            self.seconds[name] += time.monotonic() - start


def build_priors_for(
    settings: RunSettings,
    scene: Scene,
    points: np.ndarray,
    folder: Path,
    *,
    shard: tuple[int, int] | None = None,
    cluster: Mapping[str, Any] | None = None,
) -> Any:
    """Build what is missing of the depth prior in `folder`; `points` [P, 3] bound the depths that are searched.

    `shard` (index from 0, count) builds one part of it, which any scheduler may run beside the others; `cluster`
    (`scheduler` or `workers`) hands the frames to dask.distributed instead.
    """
    with progress_bar("priors", len(scene.capture.frames) * len(scene.train_cameras)) as bar:
        what = (scene.capture, scene.train_cameras, folder, prior_settings(settings))
        how = {"sparse_points": points, "progress": lambda done, total, note="": bar.update(done, note)}
        if cluster is not None:
            from d2_plugin.priors.dask_build import build_priors_on_cluster

            return build_priors_on_cluster(*what, **how, **cluster)
        from d2_plugin.priors.build import build_priors

        return build_priors(*what, **how, shard=shard)


def _claim(folder: Path, settings: RunSettings) -> None:
    """Take the folder, or find this very run in it; anything else is refused and nothing is written."""
    identity = json.loads(json.dumps(asdict(settings)))
    path = folder / "run.json"
    if path.is_file():
        found = json.loads(path.read_text())
        changed = sorted(k for k in identity.keys() | found.keys() if identity.get(k) != found.get(k))
        if changed:
            raise D2Error(
                f"{folder} holds another run, made with other settings of {', '.join(changed)}: "
                "give another --output, or remove that folder"
            )
        return
    if folder.is_dir() and any(folder.iterdir()):
        raise D2Error(f"{folder} is not empty and holds no run of ours: give another --output")
    folder.mkdir(parents=True, exist_ok=True)
    _write_json(path, identity)


def _write_json(path: Path, table: Mapping[str, Any]) -> None:
    temporary = path.with_suffix(".tmp")
    temporary.write_text(json.dumps(table, indent=1))
    os.replace(temporary, path)


def _write_npz(path: Path, **arrays: np.ndarray) -> None:
    temporary = path.with_suffix(".tmp.npz")
    np.savez(temporary, **arrays)
    os.replace(temporary, path)
