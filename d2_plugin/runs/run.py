"""One run from a recording to a held-out score: plan, points, priors, training, evaluation, in one resumable folder."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from shlex import quote
from typing import Any

from d2_plugin import registry
from d2_plugin.durable import read_table, refuse_unwritable, remove_leftovers, write_table, write_text
from d2_plugin.errors import D2Error
from d2_plugin.locks import only_writer
from d2_plugin.plugin import D2Hooks
from d2_plugin.priors.frame import view_digest
from d2_plugin.priors.summary import PriorSummary
from d2_plugin.progress import progress_bar
from d2_plugin.reading import parsing
from d2_plugin.runs import saved
from d2_plugin.runs.prior.build import build_priors_for, refuse_unusable
from d2_plugin.runs.prior.trials import LEAST_ITERATIONS, can_decide, tried
from d2_plugin.runs.rows import circumstances
from d2_plugin.runs.scene import Guidance, Scene
from d2_plugin.runs.settings import HOOK_NAMES, RunSettings, check, hook_config, hooks_in_use
from d2_plugin.runs.shared import COST
from d2_plugin.runs.start import FROM_STEREO, TimedPoints, scene_extent, triangulated_points, with_stereo
from d2_plugin.store.store import PriorStore
from d2_plugin.values import checked_arguments

_log = logging.getLogger(__name__)

CHECKPOINTS = 10
"""How often a run is saved. One that was cut off continues from its last checkpoint, bitwise."""


class Run:
    """A run folder: run.json (settings), points.npz, priors/, checkpoint.pt, metrics.json, images/.

    A run is trained, scored and opened again:

        run = Run(RunSettings("studio", ("00", "02", "05", "07"), iterations=3000), Path("runs/full"))
        run.train()
        psnr = run.evaluate()["test"]["psnr"]
        model = Run.load(Path("runs/full")).trained().model

    Args:
        settings: what is trained, on what, for how long.
        folder: absent, empty, or that of this very run, which is continued.
        guidance: what guides the run in place of D2's hooks.

    Raises:
        D2Error: impossible settings, a recording that cannot be read, or a folder that holds something else.
    """

    @checked_arguments
    def __init__(self, settings: RunSettings, folder: Path, guidance: Guidance | None = None) -> None:
        self.settings, self.folder, self.guidance = check(settings), folder, guidance
        self._checkpoint = folder / "checkpoint.pt"
        self.scene = Scene.open(self.settings)
        guide = {} if guidance is None else {"guidance": dict(guidance.identity())}
        saved.claim(folder, self.settings.as_table() | guide)
        self.seconds = {"priors": 0.0, "train": 0.0, "eval": 0.0}
        self.cpu_seconds = dict(self.seconds)
        """The same in CPU time."""
        self._spent = folder / "prior.seconds.json"
        if self._spent.is_file() and not self._checkpoint.exists():
            self.seconds["priors"], self.cpu_seconds["priors"] = read_table(self._spent, COST)["seconds"]
        self.retired: dict[str, int] = {}
        """Hooks that stopped because they changed next to nothing, and at which step."""
        self.prior: dict[str, Any] | None = None
        """What the depth prior became, as `PriorSummary.as_dict` has it; None without one."""
        self.trials: dict[str, Any] | None = None
        """What trials showed of it, as `Trials.as_dict` has it; None where nothing was tried."""
        self._writes = False

    @classmethod
    @checked_arguments
    def load(cls, folder: Path, recording: Path | None = None) -> Run:
        """The run that lies in `folder`; `recording` is where its recording lies now, if it was moved, and is kept."""
        table = saved.read_run(folder)
        if "guidance" in table:
            raise D2Error(f"{folder} is a run of {table['guidance']}: continue it with the command that began it")
        settings = RunSettings.from_table(table, str(folder / "run.json"))
        if recording is not None:
            settings = check(replace(settings, recording=str(recording)))
            # What cannot be, and another recording, are refused before anything is written.
            _refuse_another_recording(folder, Scene.open(settings))
            with only_writer(folder):
                write_table(folder / "run.json", settings.as_table(), saved.RUN)
        elif not Path(settings.recording).exists():
            remedy = f"if it was moved, `d2 eval {quote(str(folder))} --recording PATH` says where to"
            raise D2Error(f"{settings.recording}, the recording of {folder}, is not there: {remedy}")
        return cls(settings, folder)

    @property
    def uses_prior(self) -> bool:
        """Whether anything that guides this run needs the depth prior."""
        return self.guidance is not None or any(name in self.settings.hooks for name in HOOK_NAMES[1:])

    def prepare(self, on_prior: Callable[[PriorSummary], None] | None = None) -> TimedPoints:
        """Triangulate the sparse points and build the depth prior where they are missing; returns the points.

        `on_prior` is called with what the prior became.

        Raises:
            D2Error: no view has a usable prior, and the settings do not allow that.
        """
        with self._writing(), self._timed("priors") as keep:
            points = self._points()
            keep()
            _refuse_before_the_near_plane(self.settings, self.scene, points)
            if self.uses_prior:
                between = "motion" in hooks_in_use(self.settings)
                summary = build_priors_for(self.scene, points.positions, self._store, between=between, on_view=keep)
                if on_prior is not None:
                    on_prior(summary)
                refuse_unusable(summary, self.settings.accept_empty_prior)
                self.prior = summary.as_dict()
                self.trials = self._tried(points)
        return points

    def _tried(self, points: TimedPoints) -> dict[str, Any] | None:
        """What trials showed of the prior, where that is left to them; a short run makes none."""
        settings = self.settings
        inserts = bool({"densify", "depth_loss"} & set(settings.hooks))
        if self.guidance is not None or not inserts or not can_decide(settings, self.scene):
            return None
        if settings.iterations < LEAST_ITERATIONS:
            return PriorStore.described(self.priors).tried()
        return tried(settings, self.scene, points, self.priors)

    def train(self, on_prior: Callable[[PriorSummary], None] | None = None, watch: saved.Watch | None = None) -> None:
        """Build what is missing, then train to the last iteration, continuing from a checkpoint if there is one.

        `watch` gets the trainer and returns what is called with step and loss after every step.

        Raises:
            D2Error: what `prepare` refuses, another process that writes this run, a damaged file, a disk that is full.
            Diverged: the loss or a parameter is no finite number any more.
        """
        with self._writing():
            points = self.prepare(on_prior)
            trainer = self._trainer(points)
            self._restore(trainer)
            watching = watch(trainer) if watch else lambda step, loss: None
            iterations = self.settings.iterations
            chunk = max(iterations // CHECKPOINTS, 1)
            with progress_bar("train", iterations) as bar:

                def on_step(check: saved.OnStep, step: int, loss: float) -> None:
                    check(step, loss)
                    bar.update(step, f"loss {loss:.4f}")
                    watching(step, loss)

                while trainer.step < iterations:
                    until = min((trainer.step // chunk + 1) * chunk, iterations)
                    with self._timed("train"), saved.watched(trainer, self._checkpoint) as check:
                        trainer.run(until, partial(on_step, check))
                    self._save(trainer)
            self.retired = {} if trainer.d2 is None else dict(trainer.d2.retired)

    def evaluate(self, images: bool = True) -> dict[str, Any]:
        """Score every held-out camera at every frame; returns the metrics.

        Writes metrics.json (per view, per frame, per camera, mean) and images/.
        """
        from d2_plugin.runs.evaluation import evaluate_scene

        with self._writing():
            trainer = self.trained()
            with self._timed("eval"):
                shown = self.folder / "images" if images else None
                scores = evaluate_scene(trainer.model, self.scene, self.settings.device, shown)
            if camera := _changed(self.folder, self.scene):
                _log.warning(
                    "images of camera %s were changed since this run was scored: these scores replace others", camera
                )
            metrics = scores | _about(self, trainer)
            write_table(self.folder / "metrics.json", metrics, saved.METRICS)
        return metrics

    @property
    def priors(self) -> Path:
        """Folder of the depth prior that was built from the training cameras."""
        return PriorStore.located(self._store, self.scene.train_cameras)

    @property
    def _store(self) -> Path:
        """Folder of the depth priors of all sets of cameras."""
        return Path(self.settings.priors or self.folder / "priors")

    def _points(self) -> TimedPoints:
        path = self.folder / "points.npz"
        if not path.is_file():
            triangulated_points(self.scene.recording, self.scene.train_cameras).save(path)
        return TimedPoints.load(path)

    def _trainer(self, triangulated: TimedPoints, attach: bool = True) -> Any:
        """A new trainer of the backbone, with hooks where the run has some and `attach` allows it."""
        self.scene = self.scene.with_points(triangulated, self.settings)
        start = triangulated
        if self.guidance is not None and attach:
            start = self.guidance.start(self.scene, triangulated, self.priors)
        elif attach:
            config, scene = hook_config(self.settings, self.priors, self.trials), self.scene
            if config.densify is not None and config.believe != "nothing":
                prior, most = PriorStore.open(self.priors).prior, FROM_STEREO
                if (limit := config.densify.max_gaussians) is not None:
                    most = min(most, max(limit - len(start), 0))
                chosen, seed = config.believe or "all", self.settings.seed
                start = with_stereo(start, scene.recording, scene.train_cameras, prior, chosen, seed, most)
        hooks = self._attach if attach and self.uses_prior else None
        return self.scene.trainer(self.settings, triangulated, start, hooks, appearance=attach)

    def trained(self) -> Any:
        """The trainer at the last checkpoint, without hooks or a look at the prior: the checkpoint says it all."""
        trainer = self._trainer(self._points(), attach=False)
        if not self._restore(trainer):
            raise D2Error(f"{self.folder} holds no checkpoint yet: run `d2 train` to its end first")
        return trainer

    def _attach(self, model: object) -> D2Hooks:
        adapter: Any = registry.load(registry.ADAPTERS, self.settings.backbone)
        config: Any = hook_config(self.settings, self.priors, self.trials)
        plan, alone = self.scene.plan, config.believe == "stereo" or self.scene.prior_settings.variant == "mvs"
        filled = not alone and (plan.uses("monocular") or bool(plan.multiview))
        if filled and "parallax" not in self.settings.overrides:
            # It gains nothing where another depth fills what stereo leaves empty (docs/evidence.md).
            config = replace(config, parallax=None)
        beside = os.path.relpath(self.priors.resolve(), self.folder.resolve())  # as `from_toml` reads it
        write_text(self.folder / "d2.toml", replace(config, prior=beside).to_toml())
        others = {} if self.guidance is None else self.guidance.hooks(self.scene, self._points(), self.priors)
        return D2Hooks(config, adapter(model), hooks=others)

    def _save(self, trainer: Any) -> None:
        used: dict[str, Any] = {"seconds": dict(self.seconds), "cpu_seconds": dict(self.cpu_seconds)}
        used |= {"prior": self.prior, "trials": self.trials}
        saved.save_checkpoint(self._checkpoint, trainer.state_dict() | used)

    def _restore(self, trainer: Any) -> bool:
        state = saved.load_checkpoint(self._checkpoint, self.settings.device)
        if state is None:
            return False
        with parsing(f"the checkpoint {self._checkpoint}", saved.REMEDY):
            self.retired = dict(state["d2"]["retired"]) if state["d2"] else {}
            if trainer.d2 is None:
                state["d2"] = None
            trainer.load_state_dict(state)
            for own, kept in ((self.seconds, state["seconds"]), (self.cpu_seconds, state["cpu_seconds"])):
                own.update({name: max(value, kept[name]) for name, value in own.items()})
            self.prior, self.trials = self.prior or state["prior"], self.trials or state["trials"]
        wrong = saved.what_diverged(trainer.model)
        if wrong:
            raise D2Error(f"the model in {self._checkpoint} diverged before step {trainer.step} ({wrong}): train anew")
        return True

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Be the only process that writes this run; within it, once more changes nothing."""
        if self._writes:
            yield
            return
        with only_writer(self.folder):
            refuse_unwritable(self.folder)
            for folder in (self.folder, self.folder / "images"):
                remove_leftovers(folder, below=False)
            self._writes = True
            try:
                yield
            finally:
                self._writes = False

    @contextmanager
    def _timed(self, name: str) -> Iterator[Callable[[], None]]:
        """Count the time of the block; what it gives counts and keeps what went by so far."""
        start, cpu = self.seconds[name] - time.monotonic(), self.cpu_seconds[name] - time.process_time()

        def keep() -> None:
            self.seconds[name], self.cpu_seconds[name] = start + time.monotonic(), cpu + time.process_time()
            if self._checkpoint.exists():  # which says it from now on
                self._spent.unlink(missing_ok=True)
            else:  # until then a run that is cut off would forget it
                write_table(self._spent, {"seconds": [self.seconds["priors"], self.cpu_seconds["priors"]]}, COST)

        try:
            yield keep
        finally:
            keep()


def _refuse_before_the_near_plane(settings: RunSettings, scene: Scene, points: TimedPoints) -> None:
    """Refuse a scene most of which the rasterizer would not draw, before the prior takes its time."""
    backbone: Any = registry.load(registry.BACKBONES, settings.backbone)
    raster = getattr(backbone.settings_from(settings.overrides.get("backbone", {})), "raster", None)
    near = getattr(raster, "near", 0.0)
    median = 2 * scene_extent(scene.recording, scene.train_cameras, points.positions).radius
    if median <= near:
        raise D2Error(
            f"the cameras see most of the scene nearer than {median:.2g} and Gaussians nearer than {near:g} are not "
            f"drawn: give the recording in a smaller unit, or set `near = {0.05 * median:.1g}` under "
            "[backbone.raster] in the TOML of --config"
        )


def _refuse_another_recording(folder: Path, scene: Scene) -> None:
    """Refuse a recording whose images are not those that the scores of the run in `folder` were measured with."""
    if camera := _changed(folder, scene):
        raise D2Error(
            f"{scene.recording.path} is not the recording of {folder}, its images of camera {camera} are others: give "
            "the place that the same recording was moved to"
        )


def _changed(folder: Path, scene: Scene) -> str:
    """A camera whose images are not those that the scores of the run in `folder` were measured with, or nothing."""
    known: dict[str, str] = {}
    with suppress(D2Error):  # of a run without scores, or with those of another version, nothing is known
        known = saved.read_metrics(folder).get("images_by_camera", {})
    return next((camera for camera, image in _digests(scene).items() if known.get(camera, image) != image), "")


def _digests(scene: Scene) -> dict[str, str]:
    """By which metrics.json knows the images of the first training camera and of those that are scored again."""
    recording, cameras = scene.recording, dict.fromkeys((scene.train_cameras[0], *scene.test_cameras))
    return {camera: view_digest(recording, camera, recording.frames[-1])[:8] for camera in cameras}


def _about(run: Run, trainer: Any) -> dict[str, Any]:
    """What metrics.json says beside the scores: the run, its cost, and the machine."""
    scene, digests = run.scene, _digests(run.scene)
    return {
        "gaussians": len(trainer.model),
        "iterations": trainer.step,
        "seconds": {name: round(value, 3) for name, value in run.seconds.items()},
        "cpu_seconds": {name: round(value, 3) for name, value in run.cpu_seconds.items()},
        "train_cameras": list(scene.train_cameras),
        "test_cameras": list(scene.test_cameras),
        "protocol": run.settings.protocol,
        "backbone": run.settings.backbone,
        "hooks": list(run.settings.hooks),
        "guidance": None if run.guidance is None else dict(run.guidance.identity()),
        "retired": run.retired,
        "background": getattr(trainer.model, "background", None) is not None,
        "appearance": getattr(trainer.model, "appearance", None) is not None,
        "prior": run.prior,
        "trials": run.trials,
        "plan": scene.plan.as_dict(),
        "recording": scene.recording.name,
        "images": [digests[scene.train_cameras[0]]],
        "images_by_camera": digests,
        "mono_emulated": scene.plan.emulated,
        "notes": list(scene.recording.notes),
        "made": circumstances(),
    }
