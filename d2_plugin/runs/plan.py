"""What a recording needs and what is left out, each decision with the measurement behind it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.priors.depth_on_disk import SensorDepth, find_depth_on_disk
from d2_plugin.priors.multiview.source import multiview_about
from d2_plugin.priors.settings import PriorSettings
from d2_plugin.priors.stereo.settings import NO_MATCHER
from d2_plugin.recordings import MonoKind, Recording
from d2_plugin.recordings.cameras.camera import same_spot
from d2_plugin.recordings.cameras.formats.colmap import find_model, read_points
from d2_plugin.recordings.checks.exposure import FEWEST, relative_exposures
from d2_plugin.recordings.selection import spread
from d2_plugin.runs.overlap import Overlap, measure_overlap, measure_texture

CHANGED = 12 / 255
"""A pixel has changed when any channel differs by more than this (three times the noise of 8-bit compressed video)."""

MOVING_SHARE = 1e-3
"""A camera sees motion when more than this share of its pixels has changed."""

MIN_OVERLAP = 0.02
"""Cameras overlap when at least one of them shares more than this part of its image with another."""

MIN_TEXTURE = 0.02
"""Images have texture when at least one camera finds it in more than this part of them."""

DIFFERENT_GAIN = 0.05
"""Exposures differ when a camera's gain in a channel is off the mean by more than this share, and by more than three
of its standard errors."""


@dataclass(frozen=True)
class Decision:
    """One part of the method: whether it is used, and the measurement that decided."""

    name: str
    use: bool
    reason: str
    impossible: str = ""
    """Why the other way cannot be taken; empty where it can."""


@dataclass(frozen=True)
class ScenePlan:
    """The decisions for one recording and its training cameras."""

    measured: tuple[Decision, ...]
    """Taken by measurement: temporal, sensor (where one lies beside the images), stereo."""
    mono_source: str | None = None
    """Where monocular depth comes from, or None where there is none."""
    mono_kind: MonoKind | None = None
    multiview: str = ""
    """Where depth of all views from one network comes from; empty where there is none."""

    @property
    def decisions(self) -> tuple[Decision, ...]:
        """All decisions: those measured, and those that follow from them."""
        return (*self.measured, *self._following())

    def uses(self, name: str) -> bool:
        """Whether the named part is used; False for a part on which nothing had to be decided."""
        return any(d.use for d in self.decisions if d.name == name)

    @property
    def emulated(self) -> bool:
        """Whether depth that guides the run was made from true depth, not predicted."""
        return "(emulated)" in f"{self.mono_source} {self.multiview}"

    @property
    def geometric(self) -> bool:
        """Whether there is geometric depth, matched or measured."""
        return any(d.use for d in self.measured if d.name in ("sensor", "stereo"))

    def as_dict(self) -> dict[str, dict[str, object]]:
        """For metrics.json."""
        return {d.name: {"use": d.use, "reason": d.reason} for d in self.decisions}

    def override(self, **choices: bool | None) -> ScenePlan:
        """The same plan with some of the measured decisions taken by the user; None leaves a decision alone.

        Raises:
            D2Error: what is asked for is impossible, such as stereo with one camera.
        """
        return replace(self, measured=tuple(_overridden(d, choices.get(d.name)) for d in self.measured))

    def with_decision(self, decision: Decision) -> ScenePlan:
        """The same plan with one decision taken anew, or for the first time."""
        others = tuple(d for d in self.measured if d.name != decision.name)
        return replace(self, measured=(*others, decision))

    def obeyed_by(self, settings: PriorSettings) -> PriorSettings:
        """The settings of the prior builder that do what the plan says: without stereo nothing is matched."""
        if self.geometric:
            return settings
        return replace(settings, stereo=replace(settings.stereo, matcher=NO_MATCHER))

    def _following(self) -> tuple[Decision, ...]:
        mono = Decision("monocular", self.mono_source is not None, self.mono_source or "no maps on disk and no network")
        if mono.use and self.mono_kind == "relative" and not self.geometric:
            mono = replace(mono, use=False, reason=f"{mono.reason}: no geometric depth gives their scale")
        several = (Decision("multiview", True, self.multiview),) if self.multiview else ()
        count = [self.geometric, mono.use, bool(several)].count(True)
        reason = "depth sources check each other" if count > 1 else "there is one depth source at most"
        return mono, *several, Decision("verification", self.geometric and count > 1, reason)


def plan_scene(
    recording: Recording, cameras: Sequence[str], mono_source: str | None, settings: PriorSettings | None = None
) -> ScenePlan:
    """Decide for `recording` trained with `cameras`.

    `mono_source` says where monocular depth comes from, None where there is none; `settings` are those of the prior
    builder, whose stereo's angles and texture decide what can be matched.
    """
    settings = settings or PriorSettings()
    kind = settings.mono_kind if settings.mono_onnx else recording.mono_kind
    decisions = (_temporal(recording, cameras), *_geometric(recording, cameras, settings))
    several = "" if settings.multiview is None else multiview_about(Path(settings.multiview))
    return ScenePlan(decisions, mono_source, kind, several)


def _temporal(recording: Recording, cameras: Sequence[str]) -> Decision:
    if len(recording.frames) == 1:
        return Decision("temporal", False, "one instant")
    share = max(changed_share(recording, camera) for camera in cameras)
    moves = share > MOVING_SHARE
    return Decision(
        "temporal", moves, f"{'' if moves else 'no '}motion: up to {share:.2%} of a camera's pixels change over time"
    )


def _geometric(recording: Recording, cameras: Sequence[str], settings: PriorSettings) -> tuple[Decision, ...]:
    """Sensor and stereo: depth on disk, from a sensor or COLMAP, is used first."""
    source = find_depth_on_disk(recording, cameras, settings.stereo)
    if source is not None and source.name == SensorDepth.name:
        reason = "a sensor measured the depth: nothing is matched"
        instead = 'the sensor is taken first: choose a matcher, such as stereo.matcher = "patchmatch" in [priors]'
        return Decision("sensor", True, source.about), Decision("stereo", False, reason, instead)
    if source is not None:
        return (Decision("stereo", True, source.about),)
    stereo = _stereo(recording, cameras, settings)
    folder = settings.stereo.folder or "depth"
    if recording.path is None or not (recording.path / folder / "depth.json").is_file():
        return (stereo,)
    reason = f"{folder}/ does not serve every training camera, or the settings name another source"
    return Decision("sensor", False, reason), stereo


def _stereo(recording: Recording, cameras: Sequence[str], settings: PriorSettings) -> Decision:
    if len(cameras) < 2:
        return Decision("stereo", False, "one training camera", "it takes a second training camera")
    if settings.stereo.matcher == NO_MATCHER:
        return Decision("stereo", False, "the settings of the priors say so", "the settings of the priors rule it out")
    calibrations = [recording.cameras[name] for name in cameras]
    if all(same_spot(calibrations[0], camera) for camera in calibrations):
        return Decision("stereo", False, "all training cameras stand at one point", "it takes cameras that stand apart")
    # The sparse points of a recording that is a COLMAP model tell the depths.
    model = find_model(recording.path) if recording.path is not None and recording.layout == "colmap" else None
    points = None if model is None else read_points(model).positions
    seen = measure_overlap(calibrations, settings.stereo, depth_range=settings.depth_range, points=points)
    texture = measure_texture(recording, cameras)
    overlap, textured = max(seen.shares) > MIN_OVERLAP, max(texture) > MIN_TEXTURE
    lacking = "" if overlap and textured else f"no {'texture' if overlap else 'overlap'}: "
    figures = f"{len(cameras)} training cameras, {_in_words(seen)}, {np.mean(texture):.0%} textured"
    return Decision("stereo", overlap and textured, lacking + figures)


def appearance_decision(
    recording: Recording, cameras: Sequence[str], positions: np.ndarray, times: np.ndarray
) -> Decision:
    """Whether each training camera learns a change of colour: only where their exposures differ.

    `positions` [P, 3] and `times` [P] are triangulated points and the seconds at which each was seen.
    """
    if len(cameras) < 2:
        return Decision("appearance", False, "one training camera", "it takes a second training camera")
    if set(cameras) <= recording.exposures.keys():  # the import of the videos measured them
        gains = np.log([recording.exposures[name].gain for name in cameras])
        off, errors = np.abs(gains - gains.mean(0)), np.array([recording.exposures[name].error for name in cameras])
        gain, error = float(off.max()), float(errors.flat[off.argmax()])
        measured = "measured at import"
    else:
        exposures = relative_exposures(recording, cameras, positions, times)
        if exposures is None:
            reason = f"exposures not known: a camera shares fewer than {FEWEST} points"
            return Decision("appearance", False, reason)
        gain, error = exposures.largest
        measured = f"{exposures.points} points or more"
    differ = gain > DIFFERENT_GAIN and gain > 3 * error
    figures = f"gains off the mean by {gain:.1%} at most (standard error {error:.1%}, {measured})"
    return Decision("appearance", differ, f"the cameras' exposures {'differ' if differ else 'agree'}: {figures}")


def _in_words(seen: Overlap) -> str:
    share = f"{np.mean(seen.shares):.0%} of each image seen by another"
    angles = sorted({round(angle) for angle in seen.angles})
    ends = " to ".join(str(angle) for angle in dict.fromkeys((*angles[:1], *angles[-1:])))
    apart = f", {ends} degrees apart" if angles else ""
    return f"{share}{apart}" if seen.depth_known else f"at most {share} (depths unknown){apart}"


def changed_share(recording: Recording, camera: str) -> float:
    """Largest share of a camera's pixels that differ from the first frame, over five frames spread in time."""
    first, *later = (recording.image(camera, frame).astype(np.int16) for frame in spread(recording.frames, 5))
    return float(max(np.mean(np.abs(image - first).max(-1) > CHANGED * 255) for image in later))


def _overridden(decision: Decision, choice: bool | None) -> Decision:
    if choice is None or choice == decision.use:
        return decision
    if decision.impossible:
        choice_said = str(choice).lower()
        raise D2Error(f"[plan] {decision.name} = {choice_said}, but {decision.reason}: {decision.impossible}")
    return replace(decision, use=choice, reason=f"overridden by the user (measured: {decision.reason})")
