"""What a capture needs and what is left out, each decision with the measurement behind it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from d2_plugin.captures import Capture

CHANGED = 12 / 255
"""A pixel has changed when any channel differs by more than this (three times the noise of 8-bit compressed video)."""

MOVING_SHARE = 1e-3
"""A camera sees motion when more than this share of its pixels has changed."""


@dataclass(frozen=True)
class Decision:
    """One part of the method: whether it is used, and the measurement that decided."""

    name: str
    use: bool
    reason: str


@dataclass(frozen=True)
class ScenePlan:
    """The decisions for one capture and its training cameras."""

    decisions: tuple[Decision, ...]

    def uses(self, name: str) -> bool:
        """Whether the named part is used."""
        return next(d.use for d in self.decisions if d.name == name)

    def as_dict(self) -> dict[str, dict[str, object]]:
        """For metrics.json."""
        return {d.name: {"use": d.use, "reason": d.reason} for d in self.decisions}

    def override(self, **choices: bool | None) -> ScenePlan:
        """The same plan with some decisions taken by the user; None leaves a decision alone."""
        return ScenePlan(tuple(_overridden(d, choices.get(d.name)) for d in self.decisions))


def plan_scene(capture: Capture, cameras: Sequence[str], mono_source: str | None) -> ScenePlan:
    """Decide for `capture` trained with `cameras`; `mono_source` says where monocular depth comes from, if anywhere."""
    stereo = _stereo(capture, cameras)
    mono = Decision("monocular", mono_source is not None, mono_source or "no maps on disk and no ONNX model given")
    both = stereo.use and mono.use
    verification = Decision(
        "verification", both, "two depth sources check each other" if both else "there is one depth source at most"
    )
    return ScenePlan((_temporal(capture, cameras), stereo, mono, verification))


def _temporal(capture: Capture, cameras: Sequence[str]) -> Decision:
    if len(capture.frames) == 1:
        return Decision("temporal", False, "one instant")
    share = max(changed_share(capture, camera) for camera in cameras)
    moves = share > MOVING_SHARE
    return Decision(
        "temporal", moves, f"{'' if moves else 'no '}motion: up to {share:.2%} of a camera's pixels change over time"
    )


def _stereo(capture: Capture, cameras: Sequence[str]) -> Decision:
    if len(cameras) < 2:
        return Decision("stereo", False, "one training camera")
    centres = np.stack([capture.cameras[name].centre for name in cameras])
    if np.ptp(centres, axis=0).max() == 0:
        return Decision("stereo", False, "all training cameras stand at one point")
    return Decision("stereo", True, f"{len(cameras)} training cameras")


def changed_share(capture: Capture, camera: str, samples: int = 5) -> float:
    """Largest share of a camera's pixels that differ from the first frame, over a few frames spread in time."""
    chosen = np.unique(np.linspace(0, len(capture.frames) - 1, samples).round().astype(int))
    first = capture.image(camera, capture.frames[0]).astype(np.int16)
    shares = [
        np.mean(np.abs(capture.image(camera, capture.frames[i]).astype(np.int16) - first).max(-1) > CHANGED * 255)
        for i in chosen[1:]
    ]
    return float(max(shares))


def _overridden(decision: Decision, choice: bool | None) -> Decision:
    if choice is None or choice == decision.use:
        return decision
    return Decision(decision.name, choice, f"overridden by the user (measured: {decision.reason})")
