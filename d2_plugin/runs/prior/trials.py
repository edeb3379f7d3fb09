"""What of the depth prior is worth inserting in this recording: short trials with a training camera left out.

A declared error, however honest, does not say whether a depth helps cameras that nobody trained on: that also depends
on what would stand there without it. A training camera shows it as long as it is left out: the others are trained for
a moment on small images, once with the whole prior and once with its stereo alone, and what the left-out camera would
see is compared with its images: the whole images and what moves in them, which a network may know less well, alike.
SSIM sees lost detail, and PSNR what stands at a wrong place; both count. Cameras are left out in turn until it is
clear.

The prior is the run's own, so a trial costs its training and no more. Stereo of the left-out camera's images is in it,
for both beliefs alike.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from d2_plugin import registry
from d2_plugin.durable import CannotWrite, write_table
from d2_plugin.hooks.prior import Belief, Store
from d2_plugin.plugin import D2Hooks
from d2_plugin.progress import progress_bar
from d2_plugin.protocol import DepthPrior, RasterSettings
from d2_plugin.recordings import open_recording
from d2_plugin.runs.evaluation import as_recorded, still_image, what_counts, what_moves
from d2_plugin.runs.metrics import NO_DIFFERENCE, psnr, ssim_uniform
from d2_plugin.runs.scene import Scene
from d2_plugin.runs.settings import HOOK_NAMES, RunSettings, hook_config
from d2_plugin.runs.start import TimedPoints, make_view, scene_extent, with_stereo
from d2_plugin.store.store import TRIALS, PriorStore

LEAST_ITERATIONS = 300
"""Of a run that makes trials; a shorter one would take less time than they, and only knows what was tried before."""
LEAST_CAMERAS = 2
ALONE = 0.01
"""How much worse the whole prior may predict either of two cameras from the other: one alone trains worse with it than
two do."""
STEPS = 100
"""Of one trial, which begins on stereo: in twice as many its seeds and cameras agree less."""
SIDE = 320
"""Pixels of the longer side of the images in a trial, at least. On fewer, errors of depth are too small to be seen."""
INSTANTS = 4
"""Of the recording in a trial, evenly spread."""
MOST_LEFT_OUT = 4
"""Cameras that are left out, spread evenly in the order in which they are named."""
CLEAR = 0.025
"""How far ahead in the sum either belief is where no further camera is needed, if the two or more so far agree."""
DECIBEL = 0.02
"""What a decibel of PSNR counts beside SSIM: in full runs both rise together so."""
NOTHING_GOES = {"dispensable": 0.0}
"""What Gaussians are worth is a fifth of a trial's time, and hardly one goes in so few steps."""
NO_MORE = "here no monocular map that was accepted says more than stereo, which alone is used"


class Likeness(NamedTuple):
    """How like its images a left-out camera is predicted: mean of the whole images and of what moves in them."""

    psnr: float
    ssim: float

    @classmethod
    def of(cls, image: Tensor, truth: Tensor, within: np.ndarray | None = None) -> Likeness:
        """Of an image [H, W, 3], or of its pixels `within` [H, W]."""
        return cls(min(psnr(image, truth, within), NO_DIFFERENCE), ssim_uniform(image, truth, within=within))

    @classmethod
    def mean(cls, several: Iterable[Likeness]) -> Likeness:
        """The mean of several."""
        return cls(*(float(np.mean(scores)) for scores in zip(*several, strict=True)))

    @property
    def value(self) -> float:
        """Both in one number."""
        return self.ssim + DECIBEL * self.psnr


@dataclass(frozen=True)
class Trials:
    """What left-out training cameras say of the prior."""

    everything: Mapping[str, Likeness]
    """Of each left-out camera, where the others were trained with the whole prior."""
    stereo: Mapping[str, Likeness]
    """The same with stereo alone."""
    cpu_seconds: float
    allowance: float = 0.0
    """How much worse the whole prior may be."""

    @property
    def ahead(self) -> Sequence[float]:
        """How much better the whole prior predicts each left-out camera than its stereo, and the allowance."""
        return [seen.value - self.stereo[camera].value + self.allowance for camera, seen in self.everything.items()]

    @property
    def clear(self) -> bool:
        """Whether no further camera is needed: two at least agree, and together they are far from nothing."""
        agree = min(self.ahead) > 0 or max(self.ahead) < 0
        return len(self.ahead) > 1 and agree and abs(sum(self.ahead)) >= CLEAR

    @property
    def choice(self) -> Belief:
        """What predicts left-out cameras better; stereo alone where both do alike."""
        return "all" if sum(self.ahead) > 0 else "stereo"

    def __str__(self) -> str:
        if not self.ahead:
            return NO_MORE
        used = {"all": "is worth inserting: the whole prior is used", "stereo": "confirms stereo, which alone is used"}
        means = (Likeness.mean(of.values()) for of in (self.everything, self.stereo))
        with_it, without = (f"{mean.psnr:.2f} dB, SSIM {mean.ssim:.3f}" for mean in means)
        seen = f"left-out cameras, and what moves there: {with_it} with it; {without} without"
        return f"here monocular depth {used[self.choice]} ({seen})"

    def as_dict(self) -> dict[str, Any]:
        """For the table beside the prior and for metrics.json."""
        beliefs = {"all": self.everything, "stereo": self.stereo}
        scores = {
            name: {belief: {camera: getattr(one, name) for camera, one in of.items()} for belief, of in beliefs.items()}
            for name in Likeness._fields
        }
        return {"choice": self.choice, **scores, "text": str(self), "cpu_seconds": self.cpu_seconds}


def can_decide(settings: RunSettings, scene: Scene) -> bool:
    """Whether trials can say anything: nothing is chosen, two depth sources that both insert, and two cameras."""
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
    middle = 2 * scene_extent(scene.recording, scene.train_cameras, points.positions).radius
    near = {} if middle > RasterSettings.near else {"raster": {"near": 0.05 * middle}}  # else nothing would be drawn
    plain |= {"backbone": NOTHING_GOES | near}
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
    seen: dict[Belief, dict[str, list[Likeness]]] = {"all": {}, "stereo": {}}
    more = {name for name in scene.train_cameras if trial.has_more_than_stereo(name)}
    chosen, done = [name for name in left_out(scene.train_cameras) if more - {name}], 0
    trials = Trials({}, {}, 0.0)
    allowance = ALONE if len(scene.train_cameras) == LEAST_CAMERAS else 0.0
    with progress_bar("trials", len(chosen) * len(seen)) as bar:
        for camera in chosen:
            others = [name for name in scene.train_cameras if name != camera]
            for belief, of_cameras in seen.items():
                earlier = of_cameras.setdefault(camera, [])
                earlier.append(trial.likeness(trial.model(others, belief, seed=len(earlier)), camera))
                bar.update(done := done + 1, f"without camera {camera}: {earlier[-1].psnr:.2f} dB")
            everything, stereo = _bests(seen["all"]), _bests(seen["stereo"])
            trials = Trials(everything, stereo, time.process_time() - begin, allowance)
            if trials.clear:
                break
    return trials


def _bests(seen: Mapping[str, Sequence[Likeness]]) -> dict[str, Likeness]:
    """The better of a camera's seeds: where one of them failed, that is no word on what was believed."""
    return {camera: max(several, key=lambda one: one.value) for camera, several in seen.items()}


def left_out(cameras: Sequence[str]) -> tuple[str, ...]:
    """At most `MOST_LEFT_OUT` of the cameras, evenly spread, every second one first; each of two cameras twice."""
    count = min(len(cameras), MOST_LEFT_OUT)
    spread = tuple(cameras[(2 * i + 1) * len(cameras) // (2 * count)] for i in range(count))
    return (spread[1::2] + spread[::2]) * (2 if count == LEAST_CAMERAS else 1)


@dataclass(frozen=True, eq=False)
class _Trial:
    """A run of a few steps on small images of a few instants."""

    settings: RunSettings
    scene: Scene
    points: TimedPoints
    store: Store

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
        return cls(replace(settings, iterations=STEPS), scene, points, SmallStore(store, factor))

    def has_more_than_stereo(self, camera: str) -> bool:
        """Whether anything in a camera's priors depends on what is believed."""
        priors = (self.store.prior(camera, frame) for frame in self.scene.recording.frames)
        return any(bool(((known.support | known.far) & ~known.verified).any()) for known in priors if known is not None)

    def model(self, cameras: Sequence[str], belief: Belief, seed: int) -> Any:
        """A model that some of the cameras trained, begun on their stereo as a run is, in too few steps to gather the
        evidence that pruning takes."""
        settings = replace(self.settings, seed=seed)
        config: Any = hook_config(settings, Path())
        config = replace(config, believe=belief, prune=None, parallax=None)
        adapter: Any = registry.load(registry.ADAPTERS, settings.backbone)
        scene = replace(self.scene, train_cameras=tuple(cameras))
        start = with_stereo(self.points, scene.recording, cameras, self.store.prior, belief, seed)
        trainer = scene.trainer(settings, self.points, start, lambda model: D2Hooks(config, adapter(model), self.store))
        trainer.run()
        return trainer.model

    @torch.no_grad()
    def likeness(self, model: Any, camera: str) -> Likeness:
        """How well a model predicts a camera, mean over the instants."""
        recording = self.scene.recording
        still, recorded = still_image(recording, camera, recording.frames), what_counts(recording, camera)
        whole, moving = [], []
        for frame in recording.frames:
            truth = torch.from_numpy(recording.image(camera, frame)).float() / 255
            view = make_view(recording, camera, frame, self.settings.device)
            predicted = as_recorded(model.render(view).color.cpu().clamp(0, 1), truth, recorded)
            whole.append(Likeness.of(predicted, truth, recorded))
            moves = what_moves(truth.numpy(), still)
            if moves is not None and not math.isnan((seen := Likeness.of(predicted, truth, moves)).ssim):
                moving.append(seen)
        return Likeness.mean([Likeness.mean(seen) for seen in (whole, moving) if seen])


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
