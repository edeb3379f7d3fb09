"""One run from a capture to a held-out score: plan, points, priors, training, evaluation, in one resumable folder."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from d2_plugin import registry
from d2_plugin.errors import D2Error
from d2_plugin.plugin import D2Hooks
from d2_plugin.priors.store import PriorStore
from d2_plugin.progress import progress_bar
from d2_plugin.runs.prior import build_priors_for
from d2_plugin.runs.provenance import circumstances
from d2_plugin.runs.scene import Scene
from d2_plugin.runs.settings import HOOK_NAMES, RunSettings, check, hook_config
from d2_plugin.runs.start import (
    TimedPoints,
    TrainingFrames,
    initial_points,
    make_view,
    scene_extent,
    triangulated_points,
)

RENDERED_ALPHA = 0.5
"""A rendered depth is reported where the accumulated alpha exceeds this."""

FAR_SHARE = 0.005
"""Mean share of far pixels in the prior above which the backbone gets a background."""

CHECKPOINTS = 10
"""How often a run is saved. One that was cut off continues from its last checkpoint, bitwise."""


OnStep = Callable[[int, float], None]
"""Called with the number of a training step and its loss."""
Watch = Callable[[Any], OnStep]


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
        return cls(RunSettings.from_table(json.loads(path.read_text()), str(path)), folder)

    @property
    def uses_prior(self) -> bool:
        """Whether any hook of this run needs the depth prior."""
        return any(name in self.settings.hooks for name in HOOK_NAMES[1:])

    def prepare(self, priors: bool = True) -> TimedPoints:
        """Triangulate the sparse points and build the depth prior where they are missing; returns the points."""
        with self._timed("priors"):
            points = self._points()
            if priors and self.uses_prior:
                build_priors_for(self.settings, self.scene, points.positions, self.priors)
        return points

    def train(self, watch: Watch | None = None) -> None:
        """Build what is missing, then train to the last iteration, continuing from a checkpoint if there is one.

        `watch` gets the trainer and returns what is called with step and loss after every step.
        """
        trainer = self._trainer(self.prepare())
        self._restore(trainer)
        watching = watch(trainer) if watch else lambda step, loss: None
        iterations = self.settings.iterations
        chunk = max(iterations // CHECKPOINTS, 1)
        with progress_bar("train", iterations) as bar:

            def on_step(step: int, loss: float) -> None:
                bar.update(step, f"loss {loss:.4f}")
                watching(step, loss)

            while trainer.step < iterations:
                until = min((trainer.step // chunk + 1) * chunk, iterations)
                with self._timed("train"):
                    trainer.run(until, on_step)
                self._save(trainer)
        self.retired = {} if trainer.d2 is None else dict(trainer.d2.retired)

    def evaluate(self, pictures: bool = True) -> dict[str, Any]:
        """Score every held-out camera at every frame; returns the metrics.

        Writes metrics.json (per view, per frame, per camera, mean), the same as tables in metrics.md and metrics.tex,
        and pictures/.
        """
        from d2_plugin.runs.tables import write_tables

        trainer = self.trained()
        with self._timed("eval"):
            scores = self._scores(trainer.model, self.folder / "pictures" if pictures else None)
        metrics = scores | self._about(trainer)
        _write_json(self.folder / "metrics.json", metrics)
        write_tables(metrics, self.folder)
        return metrics

    def _scores(self, model: Any, pictures: Path | None) -> dict[str, Any]:
        """What `evaluate` finds; under `train` instead of `test` where no camera was held out."""
        from d2_plugin.runs.evaluation import evaluate
        from d2_plugin.runs.lpips import find_lpips

        scene = self.scene
        cameras = scene.test_cameras or scene.train_cameras
        with progress_bar("evaluate", len(cameras) * len(scene.capture.frames)) as bar:
            scores = evaluate(
                self._renderer(model),
                scene.capture,
                cameras,
                scene.capture.frames,
                pictures,
                lpips=find_lpips("alex"),
                lpips_vgg=find_lpips("vgg"),
                progress=lambda done, _: bar.update(done),
            )
        if scene.test_cameras:
            return scores
        return {"test": None, "train": scores.pop("test")} | scores

    def _about(self, trainer: Any) -> dict[str, Any]:
        """What metrics.json says beside the scores: the run, its cost, and the machine."""
        scene = self.scene
        return {
            "gaussians": len(trainer.model),
            "iterations": trainer.step,
            "seconds": {name: round(value, 3) for name, value in self.seconds.items()},
            "train_cameras": list(scene.train_cameras),
            "test_cameras": list(scene.test_cameras),
            "backbone": self.settings.backbone,
            "hooks": list(self.settings.hooks),
            "retired": self.retired,
            "background": getattr(trainer.model, "background", None) is not None,
            "plan": scene.plan.as_dict(),
            "capture": scene.capture.name,
            "mono_emulated": scene.capture.mono_emulated,
            "notes": list(scene.capture.notes),
            "made": circumstances(),
        }

    def export_ply(self) -> list[Path]:
        """One 3DGS PLY per frame under ply/: the Gaussians of that instant, temporal opacity folded in.

        A background is not among them, since the format has no place for it: what it showed is black in a viewer.
        """
        from d2_plugin.runs.gaussian_ply import write_ply

        trainer = self.trained()
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

    def _points(self) -> TimedPoints:
        """The triangulated points, kept in points.npz."""
        path = self.folder / "points.npz"
        if not path.is_file():
            triangulated_points(self.scene.capture, self.scene.train_cameras).save(path)
        return TimedPoints.load(path)

    def _trainer(self, triangulated: TimedPoints, attach: bool = True) -> Any:
        """A new trainer of the backbone, with hooks where the run has some and `attach` allows it."""
        backbone: Any = registry.load(registry.BACKBONES, self.settings.backbone)
        capture, cameras = self.scene.capture, self.scene.train_cameras
        extent = scene_extent(capture, cameras, triangulated.positions)
        start = initial_points(capture, cameras, triangulated, extent, self.settings.seed)
        model = backbone.create(
            *start.tensors(self.settings.device),
            extent=extent.radius,
            duration=capture.seconds(capture.frames[-1]),
            temporal=self.scene.plan.uses("temporal"),
            settings=(self._background() if attach else {}) | dict(self.settings.overrides.get("backbone", {})),
        )
        training = backbone.TrainSettings(iterations=self.settings.iterations, seed=self.settings.seed)
        pictures = TrainingFrames(capture, cameras, self.settings.device)
        return backbone.Trainer(model, pictures, training, self._attach if attach and self.uses_prior else None)

    def _background(self) -> dict[str, Any]:
        """The backbone's setting where the scene needs it: one of somebody else's may not know the name."""
        return {"background": True} if self._sees_far() else {}

    def _sees_far(self) -> bool:
        """Whether the depth prior, where there is one, found far pixels: only then a background pays."""
        if not (self.priors / "store.json").is_file():
            return False
        store = PriorStore.open(self.priors)
        cameras = [camera for camera in self.scene.train_cameras if camera in store.cameras]
        keys = ((camera, frame) for camera in cameras for frame in self.scene.capture.frames)
        records = [record for key in keys if (record := store.record(*key)) is not None]
        return bool(records) and sum(r["shares"].get("far", 0.0) for r in records) / len(records) > FAR_SHARE

    def trained(self) -> Any:
        """The trainer at the last checkpoint, without hooks or a look at the prior: the checkpoint says it all."""
        trainer = self._trainer(self._points(), attach=False)
        if not self._restore(trainer):
            raise D2Error(f"{self.folder} holds no checkpoint yet: run `d2 train` to its end first")
        return trainer

    def _attach(self, model: object) -> D2Hooks:
        adapter: Any = registry.load(registry.ADAPTERS, self.settings.backbone)
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


def _claim(folder: Path, settings: RunSettings) -> None:
    """Take the folder, or find this very run in it; anything else is refused and nothing is written."""
    identity = settings.as_table()
    path = folder / "run.json"
    if path.is_file():
        found = RunSettings.from_table(json.loads(path.read_text()), str(path)).as_table()
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
    """Write a table; who reads the file meanwhile finds the old one or the new one, whole."""
    temporary = path.with_suffix(".tmp")
    temporary.write_text(json.dumps(table, indent=1))
    os.replace(temporary, path)
