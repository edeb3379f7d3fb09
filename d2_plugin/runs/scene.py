"""A recording with its split into training and test cameras, the plan for it, and new trainers on it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any, Protocol

from d2_plugin import registry
from d2_plugin.errors import D2Error, refuse_unknown
from d2_plugin.hooks import Hook
from d2_plugin.priors.settings import PriorSettings
from d2_plugin.recordings import Recording, open_recording
from d2_plugin.recordings.cameras.camera import same_spot
from d2_plugin.recordings.cameras.check import check_background_weight, check_recording
from d2_plugin.recordings.checks.memory import check_memory
from d2_plugin.runs.metrics import GAUSSIAN_WINDOW
from d2_plugin.runs.plan import ScenePlan, appearance_decision, plan_scene
from d2_plugin.runs.settings import RunSettings, hooks_in_use, prior_settings, training_settings
from d2_plugin.runs.start import TimedPoints, TrainingFrames, initial_points, scene_extent


@dataclass(frozen=True, eq=False)
class Scene:
    """What a run is about: the recording, who trains and who tests, and what is left out."""

    recording: Recording
    train_cameras: tuple[str, ...]
    test_cameras: tuple[str, ...]
    plan: ScenePlan
    priors: PriorSettings
    """Of the prior builder, before the plan."""
    between: tuple[int, ...] = ()
    """Frames between those of `recording`, which train nothing and are scored apart."""

    @property
    def scored(self) -> Recording:
        """The recording with all frames that are scored, those between the trained ones too."""
        return replace(self.recording, frames=tuple(sorted((*self.recording.frames, *self.between))))

    @property
    def prior_settings(self) -> PriorSettings:
        """Of the prior builder, with what the plan leaves out."""
        return self.plan.obeyed_by(self.priors)

    @classmethod
    def open(cls, settings: RunSettings) -> Scene:
        """Open the recording that `settings` name, split its cameras, and measure what it needs.

        Where training and test cameras are both named, as a camera preset does, only those are read and checked: a
        preset passes over cameras without calibration or images, so the run must not refuse them.
        """
        test = settings.test_cameras
        named = None if test is None else dict.fromkeys((*settings.train_cameras, *test))
        recording = open_recording(
            settings.recording, cameras=named, frames=settings.frames, downscale=settings.downscale
        )
        recording, between = _without_held_out_instants(recording, settings.hold_out_instants)
        train, test = _split(recording, settings)
        for name in (*train, *test):
            if min(size := (recording.cameras[name].width, recording.cameras[name].height)) < GAUSSIAN_WINDOW:
                raise D2Error(
                    f"camera {name} has {size[0]}x{size[1]} pixels and scores need {GAUSSIAN_WINDOW} each way: give a "
                    "smaller --downscale or larger images"
                )
        check_memory(recording, train)
        masks = check_background_weight(recording, train, settings.background_weight)
        notes = (*recording.notes, *masks, *check_recording(recording, (*train, *test), scored=test))
        notes += (*_at_one_point(recording, train),)
        for name in sorted({*settings.hooks} - {*hooks_in_use(settings), "prior"}):
            notes += (f"a run of {settings.iterations} steps leaves `{name}` out: a table [{name}] brings it back",)
        recording = replace(recording, notes=notes)
        priors, mono = prior_settings(settings), None
        if settings.mono_onnx:
            mono = f"ONNX model {Path(settings.mono_onnx).name}"
        elif recording.mono_kind is not None:
            mono = f"{recording.mono_kind} maps on disk" + (" (emulated)" if recording.mono_emulated else "")
        plan = plan_scene(recording, train, mono, priors)
        return cls(recording, train, test, plan.override(**settings.overrides.get("plan", {})), priors, between)

    def with_points(self, points: TimedPoints, settings: RunSettings) -> Scene:
        """The same scene with what triangulated points decide: whether the cameras' exposures differ."""
        decision = appearance_decision(self.recording, self.train_cameras, points.positions, points.times)
        plan = self.plan.with_decision(decision).override(**settings.overrides.get("plan", {}))
        return replace(self, plan=plan)

    def trainer(
        self,
        settings: RunSettings,
        sparse: TimedPoints,
        start: TimedPoints,
        attach: Callable[[Any], Any] | None = None,
        appearance: bool = True,
    ) -> Any:
        """A new trainer of the run's backbone on the training cameras.

        Args:
            sparse: the triangulated points, by which the extent of the scene is known where they are enough.
            start: what Gaussians start from, filled up with random points.
            attach: makes the hooks of a model; None for none.
            appearance: whether cameras learn a change of colour where the plan says so.
        """
        backbone: Any = registry.load(registry.BACKBONES, settings.backbone)
        recording, cameras = self.recording, self.train_cameras
        extent = scene_extent(recording, cameras, sparse.positions, start.positions)
        # What the scene needs, that alone: a backbone of somebody else's may not know the name.
        needed = {"appearance": True} if appearance and self.plan.uses("appearance") else {}
        model = backbone.create(
            *initial_points(recording, cameras, start, extent, settings.seed).tensors(settings.device),
            extent=extent.radius,
            duration=recording.seconds(recording.frames[-1]),
            temporal=self.plan.uses("temporal"),
            settings=needed | dict(settings.overrides.get("backbone", {})),
        )
        # A model that learns exposures begins with those that the import of the videos measured.
        gains = {name: one.gain for name, one in recording.exposures.items() if name in (*cameras, *self.test_cameras)}
        if gains and (begin := getattr(getattr(model, "appearance", None), "start_from", None)):
            begin(gains, cameras)
        images = TrainingFrames(recording, cameras, settings.device, settings.background_weight)
        return backbone.Trainer(model, images, training_settings(settings, backbone), attach)


class Guidance(Protocol):
    """What guides a run in place of D2's hooks: an object that is given to it, so a run never imports a rival."""

    def identity(self) -> Mapping[str, Any]:
        """Its `name` and settings as JSON has them: part of what makes two runs the same run."""

    def start(self, scene: Scene, points: TimedPoints, priors: Path) -> TimedPoints:
        """What Gaussians start from, given the triangulated points and the folder of the depth prior."""

    def hooks(self, scene: Scene, points: TimedPoints, priors: Path) -> Mapping[str, Hook]:
        """The hooks that run in place of D2's, by name."""


def _without_held_out_instants(recording: Recording, every: int) -> tuple[Recording, tuple[int, ...]]:
    """The recording with every so-manieth frame, and the frames between them; those after the last one are left out."""
    trained = recording.frames[:: max(every, 1)]
    if len(trained) == len(recording.frames):
        return recording, ()
    if len(trained) < 2:
        raise D2Error(
            f"--hold-out-instants {every} leaves one of {len(recording.frames)} instants: give a smaller number"
        )
    between = tuple(frame for frame in recording.frames if frame not in trained and frame < trained[-1])
    return replace(recording, frames=trained), between


def _at_one_point(recording: Recording, cameras: Sequence[str]) -> Iterator[str]:
    """Which training cameras stereo learns nothing from together; where it is all of them, the plan says so."""
    at = {name: recording.cameras[name] for name in cameras}
    pairs = [f"{one} and {other}" for one, other in combinations(at, 2) if same_spot(at[one], at[other])]
    if 0 < 2 * len(pairs) < len(at) * (len(at) - 1):
        listed = ", ".join(pairs[:4]) + (", ..." if len(pairs) > 4 else "")
        yield f"cameras {listed} stand at one point and give no depth together: correct their poses if they do not"


def _split(recording: Recording, settings: RunSettings) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Training cameras as named, test cameras as named or all others."""
    test = settings.test_cameras
    if test is None:
        test = tuple(name for name in recording.cameras if name not in settings.train_cameras)
    names = (*settings.train_cameras, *test)
    refuse_unknown("camera", names, recording.cameras)
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise D2Error(f"camera {twice[0]} is named twice: name each once, for training or for test")
    return settings.train_cameras, test
