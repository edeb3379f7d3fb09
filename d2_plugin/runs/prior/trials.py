"""What of the depth prior is worth inserting in this recording: short trials with a training camera left out.

A declared error, however honest, does not say whether a depth helps cameras that nobody trained on: that also depends
on what would stand there without it. A training camera shows it as long as it is left out: the others are trained for
a moment on small images, once with the whole prior and once with its stereo alone, and what the left-out camera would
see is compared with its images. Where the first one does not decide clearly a second one is left out. SSIM decides:
single floaters and colours that cameras see differently weigh less in it than in PSNR. Where that is level, maps are
used if they are good where stereo was left out of their alignment.

The prior is the run's own, so a trial costs its training and no more. Stereo of the left-out camera's images is in it,
for both beliefs alike.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from d2_plugin import registry
from d2_plugin.durable import CannotWrite, write_table
from d2_plugin.hooks.prior import Belief, Store
from d2_plugin.plugin import D2Hooks
from d2_plugin.progress import progress_bar
from d2_plugin.protocol import DepthPrior
from d2_plugin.recordings import open_recording
from d2_plugin.runs.metrics import ssim_uniform
from d2_plugin.runs.scene import Scene
from d2_plugin.runs.settings import HOOK_NAMES, RunSettings, hook_config
from d2_plugin.runs.start import TimedPoints, make_view, with_stereo
from d2_plugin.store.store import TRIALS, PriorStore

LEAST_ITERATIONS = 300
"""Of a run that makes trials; a shorter one would take less time than they, and only knows what was tried before."""
LEAST_CAMERAS = 3
"""Without one of two cameras, one would train alone: that shows nothing of what two show."""
STEPS = 200
"""Of one trial. What is inserted begins faint, and a trial that is too short sees its cost alone."""
SIDE = 320
"""Pixels of the longer side of the images in a trial, at least. On fewer, errors of depth are too small to be seen."""
INSTANTS = 4
"""Of the recording in a trial, evenly spread."""
MOST_LEFT_OUT = 2
"""Cameras that are left out, spread evenly in the order in which they are named."""
CLEAR = 0.02
"""A difference of SSIM at one left-out camera that needs no second one."""
TIE = 0.01
"""A mean difference of SSIM below which it does not decide, but how good the maps are where stereo was left out:
priors of one recording that are hardly different have differed by .006."""
GOOD_MAPS = 3.0
"""Then they are used if depth is so many times as far off there without them."""


@dataclass(frozen=True)
class Trials:
    """What left-out training cameras say of the prior."""

    everything: Mapping[str, float]
    """SSIM of the images of each left-out camera, where the others were trained with the whole prior."""
    stereo: Mapping[str, float]
    """The same with stereo alone."""
    gain: float
    """How many times as far off depth is without maps where stereo was left out, median of the views; 0: unknown."""
    cpu_seconds: float

    @property
    def choice(self) -> Belief:
        """What predicts left-out cameras better; within `TIE` the whole prior if maps are good, else stereo alone."""
        ahead = _mean(self.everything) - _mean(self.stereo)
        better = ahead > 0 if abs(ahead) >= TIE else self.gain >= GOOD_MAPS
        return "all" if better else "stereo"

    def __str__(self) -> str:
        with_it, without = _mean(self.everything), _mean(self.stereo)
        used = {"all": "is worth inserting: the whole prior is used", "stereo": "confirms stereo, which alone is used"}
        verdict = used[self.choice]
        if abs(with_it - without) < TIE:
            known = f"depth is {self.gain:.1f} times as far off without it where stereo was left out"
            unknown = "there is too little stereo to leave some out"
            verdict += f": trials are level, and {known if self.gain else unknown}"
        return f"here monocular depth {verdict} (left-out cameras: SSIM {with_it:.3f} with it, {without:.3f} without)"

    def as_dict(self) -> dict[str, Any]:
        """For the table beside the prior and for metrics.json."""
        ssim = {"all": dict(self.everything), "stereo": dict(self.stereo)}
        about = {"text": str(self), "cpu_seconds": self.cpu_seconds, "gain": self.gain}
        return {"choice": self.choice, "ssim": ssim} | about


def _mean(ssim: Mapping[str, float]) -> float:
    return float(np.mean(list(ssim.values())))


def can_decide(settings: RunSettings, scene: Scene) -> bool:
    """Whether trials can say anything: nothing is chosen, two depth sources that both insert, and three cameras."""
    chosen = "believe" in settings.overrides.get("d2", {})
    both = scene.plan.uses("verification") and scene.prior_settings.variant == "dual"
    return not chosen and both and len(scene.train_cameras) >= LEAST_CAMERAS


def tried(settings: RunSettings, scene: Scene, points: TimedPoints, priors: Path) -> dict[str, Any]:
    """What trials with the prior in the folder `priors` show, as `Trials.as_dict` has it.

    They are made once, with the default backbone and all hooks, and lie beside the prior for every trainer.
    """
    store = PriorStore.open(priors)
    if (known := store.tried()) is not None:
        return known
    plain = {name: table for name, table in settings.overrides.items() if name in ("plan", "priors")}
    own = replace(settings, backbone=RunSettings.backbone, hooks=HOOK_NAMES, seed=0, overrides=plain)
    trials = leave_out_in_turn(own, scene, points, store).as_dict()
    with contextlib.suppress(CannotWrite):  # a finished prior may lie where nobody can write
        write_table(store.path / "trials.json", {**trials, "contents": store.contents}, TRIALS)
    return trials


def leave_out_in_turn(settings: RunSettings, scene: Scene, points: TimedPoints, store: PriorStore) -> Trials:
    """Leave out training cameras in turn and predict them, with all of the prior in `store` and with its stereo.

    Args:
        settings: of the run.
        scene: of the run.
        points: the triangulated points.
        store: the finished prior of all training cameras.
    """
    begin = time.process_time()
    trial = _Trial.of(settings, scene, points, store)
    scores: dict[Belief, dict[str, float]] = {"all": {}, "stereo": {}}
    chosen = left_out(scene.train_cameras)
    with progress_bar("trials", len(chosen) * len(scores)) as bar:
        for camera in chosen:
            others = [name for name in scene.train_cameras if name != camera]
            for belief, of_cameras in scores.items():
                ssim = of_cameras[camera] = trial.score(trial.model(others, belief), camera)
                bar.update(sum(map(len, scores.values())), f"without camera {camera}: SSIM {ssim:.3f}")
            if abs(scores["all"][camera] - scores["stereo"][camera]) >= CLEAR:
                break
    return Trials(scores["all"], scores["stereo"], trial.gain, time.process_time() - begin)


def left_out(cameras: Sequence[str]) -> tuple[str, ...]:
    """At most `MOST_LEFT_OUT` of the cameras, evenly spread."""
    count = min(len(cameras), MOST_LEFT_OUT)
    return tuple(cameras[(2 * i + 1) * len(cameras) // (2 * count)] for i in range(count))


@dataclass(frozen=True, eq=False)
class _Trial:
    """A run of a few steps on small images of a few instants."""

    settings: RunSettings
    scene: Scene
    points: TimedPoints
    store: Store
    gain: float

    @classmethod
    def of(cls, settings: RunSettings, scene: Scene, points: TimedPoints, store: PriorStore) -> _Trial:
        cameras, frames = scene.train_cameras, store.frames
        places = np.linspace(0, len(frames) - 1, INSTANTS + 2)[1:-1]
        longest = min(
            max(scene.recording.cameras[name].width, scene.recording.cameras[name].height) for name in cameras
        )
        factor = max(longest // SIDE, 1)
        recording = open_recording(
            settings.recording,
            cameras=cameras,
            frames=sorted({frames[round(place)] for place in places}),
            downscale=settings.downscale * factor,
        )
        scene = replace(scene.with_points(points, settings), recording=recording, test_cameras=())
        records = [store.record(camera, frame) or {} for camera in cameras for frame in frames]
        gains = [skill["gain"] for record in records if (skill := record.get("skill")) and skill["gain"]]
        small = SmallStore(store, factor)
        return cls(replace(settings, iterations=STEPS), scene, points, small, median(gains or [0.0]))

    def model(self, cameras: Sequence[str], belief: Belief) -> Any:
        """A model that some of the cameras trained, begun on their stereo as a run is, in too few steps to gather the
        evidence that pruning takes."""
        config: Any = hook_config(self.settings, Path())
        config = replace(config, believe=belief, prune=None, parallax=None)
        adapter: Any = registry.load(registry.ADAPTERS, self.settings.backbone)
        scene = replace(self.scene, train_cameras=tuple(cameras))
        start = with_stereo(self.points, scene.recording, cameras, self.store.prior)
        trainer = scene.trainer(
            self.settings, self.points, start, lambda model: D2Hooks(config, adapter(model), self.store)
        )
        trainer.run()
        return trainer.model

    @torch.no_grad()
    def score(self, model: Any, camera: str) -> float:
        """How well a model predicts a camera: SSIM, mean over the instants."""
        scores = []
        for frame in self.scene.recording.frames:
            truth = torch.from_numpy(self.scene.recording.image(camera, frame)).float() / 255
            view = make_view(self.scene.recording, camera, frame, self.settings.device)
            predicted = model.render(view).color.cpu().clamp(0, 1)
            scores.append(ssim_uniform(predicted, truth))
        return float(np.mean(scores))


class SmallStore:
    """The priors of a store for images that are `factor` times smaller along each side."""

    def __init__(self, store: Store, factor: int) -> None:
        self.store, self.factor = store, factor

    def prior(self, camera: str, frame: int) -> DepthPrior | None:
        """What is known at the middle pixel of each block, and the block's mean colour; see `downscaled`."""
        found = self.store.prior(camera, frame)
        return found if found is None or self.factor == 1 else small_prior(found, self.factor)


def small_prior(prior: DepthPrior, factor: int) -> DepthPrior:
    """The prior [H, W] of an image of H / factor by W / factor pixels; blocks that are not whole are cut off."""
    height, width = (size // factor * factor for size in prior.depth.shape)

    def middle(map_: Tensor | None) -> Tensor | None:
        half = factor // 2
        return None if map_ is None else map_[half:height:factor, half:width:factor].contiguous()

    depth, labels = middle(prior.depth), middle(prior.labels)
    assert depth is not None
    assert labels is not None
    colors = prior.colors
    if colors is not None:
        blocks = F.avg_pool2d(colors[:height, :width].permute(2, 0, 1)[None].float(), factor)[0]
        colors = blocks.permute(1, 2, 0).round().byte()
    return DepthPrior(depth, labels, colors, middle(prior.sigma), middle(prior.reliability))
