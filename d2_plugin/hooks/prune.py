"""Consistency-aware pruning (paper, section "Densification and Pruning")."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from d2_plugin.hooks.densify import EPSILON
from d2_plugin.hooks.hook import Context, Hook, HookConfig, Surveyed
from d2_plugin.hooks.prior import camera_centre
from d2_plugin.protocol import Backbone, Edit, View
from d2_plugin.settings import Every, Range, Share, Steps

FLOATS = 0.4
"""A Gaussian floats where its trusted light, times how deep in free space it stands, is more than this share of it."""

LEAST_LIGHT = 2e-5
"""That light, as a share of all of the evaluation, below which a Gaussian is too small to be worth a hole."""

FAINT = 0.05
"""A Gaussian that is no larger a part of any pixel of the surveyed views shows nothing that would be missed."""

RIM = 0.1
"""In the last evaluation a Gaussian's centre must lie in an image by this share of its size: of one whose fringe alone
is seen most is not, and a held-out camera sees it whole."""

LEAST_CAMERAS = 3
"""Of two, each sees much of what there is alone."""

PARALLEL = 1e-4
"""Optical axes are parallel and meet nowhere where the mean of what projects across them has a smaller eigenvalue."""


@dataclass(frozen=True)
class PruneConfig(HookConfig):
    """Consistency-aware removal of Gaussians."""

    start: Steps = 300
    """First step at which it may run."""
    stop: Steps | None = 2000
    """First step at which it no longer runs."""
    score_stop: Steps | None = None
    """First step from which scores remove nothing more; none: they go on to `stop`. From then on what floats in free
    space goes, however opaque it is: the paper's score forgives that, and a camera that did not train may see little
    else. So does what is too faint to be seen."""
    every: Every = 100
    """Steps between evaluations."""
    tau_u: Annotated[float, Range(1e-6, 1e6)] = 0.1
    """Relative depth error at which E_k saturates."""
    tau_p: Share = 0.75
    """Score above which an evaluation counts against a Gaussian."""
    lambda_e: Share = 0.5
    """Weight of depth inconsistency; that of missing opacity contribution is lambda_o = 1 - lambda_e."""
    patience: Annotated[int, Range(1, 1000)] = 5
    """Evaluations in a row, each with evidence, before a Gaussian is removed."""
    free_space: bool = True
    """Whether standing in space that the prior says is free counts as inconsistency too, and removes after
    `score_stop`; the paper has no such term."""
    sight: bool = True
    """Whether Gaussians go whose centre no camera sees; the paper has no such term. Images train their rim alone: they
    may grow into what held-out cameras see, and nothing tells."""
    alone: Steps | None = None
    """Step at which Gaussians go whose centre one camera alone sees, in front of where another one could stand
    (`before_cameras`); none: they stay. Nothing says how far from that one they are, and to another they may hide all.
    The paper has no such term. Last in a run: training would put others in their place."""
    light: Share = 0.05
    """Largest share of the light in the surveyed views that one evaluation takes away: the faintest go first, the rest
    waits with its evidence for the next. 1 sets no limit, as the paper. What a random start has in front of every
    surface leaves holes where it is removed at once."""

    @classmethod
    def for_iterations(cls, iterations: int) -> PruneConfig:
        """Pruning from a fifth to two thirds of the run, then of what floats up to the last twentieth, and shortly
        before the end, as trainers save before their last step ends, of what one camera alone sees. Runs of less than
        about 250 iterations are too short to gather evidence in: there what floats stays."""
        every, score_stop, stop = max(40, min(100, iterations // 20)), 2 * iterations // 3, 19 * iterations // 20
        alone = max(1, iterations - 1 - iterations // 200)
        return cls(start=iterations // 5, stop=stop, score_stop=score_stop, every=every, alone=alone)

    def due(self, step: int) -> bool:
        """See `HookConfig.due`; and at `alone`, in place of an evaluation."""
        return step == self.alone or super().due(step)

    def due_when_retired(self, step: int) -> bool:
        """See `HookConfig.due_when_retired`."""
        return step == self.alone


def depth_inconsistency(error: Tensor, weight: Tensor, tau_u: float) -> Tensor:
    """E_k = min(E~_k / tau_u, 1) in 0..1, [N].

    `error` [N] is the sum of w |z - D*| / (D* + eps) over trusted pixels and `weight` [N] the sum of w; where a
    Gaussian touches no trusted pixel (weight 0) E_k is 0, as there is no evidence against it. The paper sums over
    Omega^v; trusted pixels are those, and the ones that two cameras agree on.
    """
    touched = weight > 0
    mean = torch.where(touched, error, torch.zeros_like(error)) / torch.where(touched, weight + EPSILON, 1.0)
    return (mean / tau_u).clamp(max=1.0)


def opacity_contribution(weight_maxima: Tensor, observations: Tensor) -> Tensor:
    """O_k in 0..1, [N]: mean over visible observations of the largest compositing weight.

    `weight_maxima` [N] sums max_p w over the views where the Gaussian is visible, `observations` [N] counts them;
    O_k is 0 where it is visible nowhere.
    """
    return weight_maxima / observations.clamp(min=1)


def pruning_score(inconsistency: Tensor, contribution: Tensor, lambda_e: float) -> Tensor:
    """S_k = lambda_e E_k + lambda_o (1 - O_k), [N], with lambda_o = 1 - lambda_e."""
    return lambda_e * inconsistency + (1 - lambda_e) * (1 - contribution)


class Sums(NamedTuple):
    """The surveys of several views, summed per Gaussian: each [N]."""

    error: Tensor
    weight: Tensor
    maxima: Tensor
    observations: Tensor
    largest: Tensor
    """The largest compositing weight in any pixel of any view."""
    front: Tensor
    """Weight in free space, times how deep in it 1 - z / D_near: evidence with the relative error 1, in `error` and
    `weight` as well."""


def gather(evaluation: Sequence[Surveyed], count: int, free_space: bool) -> Sums:
    """Sum the surveys of several views per Gaussian."""
    error, weight, maxima, observations, largest, front = evaluation[0].survey.weight.new_zeros(6, count)
    for _, splats, _, survey in evaluation:
        if free_space:
            front.index_add_(0, splats.rows, survey.front)
        error.index_add_(0, splats.rows, survey.error)
        weight.index_add_(0, splats.rows, survey.weight)
        maxima.index_add_(0, splats.rows, survey.max_weight)
        observations.index_add_(0, splats.rows, (survey.max_weight > 0).to(maxima))
        largest.scatter_reduce_(0, splats.rows, survey.max_weight, "amax")
    return Sums(error + front, weight + front, maxima, observations, largest, front)


def floating(sums: Sums) -> Tensor:
    """Gaussians [N] whose light stands deep in free space, bool: whatever they contribute there hides a surface."""
    enough = sums.front > LEAST_LIGHT * sums.weight.sum(dtype=torch.float64)
    return enough & (sums.front > FLOATS * (sums.weight - sums.front))


def faint(sums: Sums) -> Tensor:
    """Gaussians [N] that are seen, but nowhere by as much as `FAINT`, bool."""
    return (sums.largest > 0) & (sums.largest < FAINT)


def out_of_sight(
    evaluation: Sequence[Surveyed], beside: Callable[[View], Sequence[View]], count: int, rim: float = 0.0
) -> Tensor:
    """Gaussians [N] that live in an evaluated view, and whose centre lies in no image of any camera then, bool.

    `beside` gives a view of each camera for an evaluated one; none where they move, and then nothing is said. Centres
    less than `rim` of a Gaussian's size (root of the trace of its covariance) within an image do not count.
    """
    alive, seen = torch.zeros(2, count, dtype=torch.bool, device=evaluation[0].splats.rows.device)
    for view, splats, _, _ in evaluation:
        around = rim * splats.covariances[:, [0, 3, 5]].sum(1).sqrt() if rim else 0.0
        for other in beside(view):
            alive[splats.rows] = True
            seen[splats.rows] |= other.sees(splats.means, around)
    return alive & ~seen


def before_cameras(points: Tensor, cameras: Sequence[View]) -> Tensor:
    """Which world points [K, 3] lie in front of where a camera could stand, bool [K]: nearer to what the cameras look
    at than one of them, and by an angle to the side of it that is smaller than that to the next. None where fewer than
    two cameras look at one place."""
    poses = torch.stack([camera.T_camera_world for camera in cameras]).to(points.device, torch.float64)
    centres, forwards = torch.stack([camera_centre(pose) for pose in poses]), poses[:, 2, :3]
    across = torch.eye(3, dtype=poses.dtype, device=poses.device) - forwards[:, :, None] * forwards[:, None]
    if torch.linalg.eigvalsh(across.sum(0))[0] < PARALLEL * len(poses):
        return torch.zeros(len(points), dtype=torch.bool, device=points.device)
    focus = torch.linalg.solve(across.sum(0), (across @ centres[:, :, None]).sum(0)[:, 0])
    outwards, away = F.normalize(centres - focus, dim=1), (centres - focus).norm(dim=1)
    towards, distance = F.normalize(points.double() - focus, dim=1), (points.double() - focus).norm(dim=1)
    nearest = (outwards @ outwards.T).fill_diagonal_(-1).amax(1)  # cosine of the angle to the next camera
    looks = (outwards * forwards).sum(1) < 0
    return (looks & (towards @ outwards.T > nearest) & (distance[:, None] < away)).any(1)


def alone_before_cameras(backbone: Backbone, cameras: Sequence[View], instants: Sequence[View]) -> Tensor:
    """Gaussians [N] whose centre one of several cameras that stand still alone sees, `before_cameras`, bool; judged at
    the one of the instants at which they are most opaque. Those that are not half as opaque at half of them stay: what
    moves has one camera that sees it more often than a wall has."""
    most, alone, lasts = (torch.zeros(len(backbone), device=cameras[0].K.device) for _ in range(3))
    for view in instants:
        splats = backbone.slice_at(view)
        one = torch.stack([camera.sees(splats.means) for camera in cameras]).sum(0) == 1
        more = splats.opacities > most[splats.rows]
        rows = splats.rows[more]
        alone[rows] = (one & before_cameras(splats.means, cameras))[more].to(alone)
        most[rows] = splats.opacities[more].to(most)
    for view in instants:
        splats = backbone.slice_at(view)
        lasts[splats.rows] += (splats.opacities > most[splats.rows] / 2).to(lasts)
    return (alone > 0) & (2 * lasts >= len(instants))


def within_light(remove: Tensor, weight: Tensor, share: float) -> Tensor:
    """Of the rows of `remove` [N], the faintest that together carry at most `share` of all `weight` [N]; at least one,
    so that a bright floater that is alone goes, too."""
    if share >= 1 or not remove.any():
        return remove
    rows = torch.nonzero(remove).squeeze(1)
    rows = rows[torch.argsort(weight[rows], stable=True)]
    taken = torch.cumsum(weight[rows].double(), 0) <= share * weight.sum(dtype=torch.float64)
    taken[0] = True
    return torch.zeros_like(remove).index_fill(0, rows[taken], True)


class Prune(Hook):
    """Removes Gaussians whose score stays above tau_p in consecutive evaluations with evidence, and some that the paper
    keeps: see `PruneConfig`."""

    config: PruneConfig

    def __init__(self, config: PruneConfig) -> None:
        super().__init__(config)
        self.settling = config.patience - 1
        self.streak: Tensor | None = None  # [N] evaluations in a row with S_k > tau_p

    @torch.no_grad()
    def edit(self, context: Context) -> Edit | None:
        """Propose what has no evidence for it, or too little; see `PruneConfig`."""
        remove = self._alone(context) if context.step == self.config.alone else self._scored(context)
        return Edit(remove=remove) if remove is not None and remove.any() else None

    def _alone(self, context: Context) -> Tensor | None:
        """What one of three cameras and more alone sees; None where they move, or are two, of which each sees much."""
        views = context.sample()
        cameras = context.beside(views[0]) if views else ()
        if len(cameras) < LEAST_CAMERAS:
            return None
        return alone_before_cameras(context.backbone, cameras, context.instants(views[0].camera))

    def _scored(self, context: Context) -> Tensor | None:
        """Update the streaks with one evaluation; the rows whose streak is long enough, and what is out of sight."""
        if not context.evaluation:
            return None
        config, count = self.config, len(context.backbone)
        sums = gather(context.evaluation, count, config.free_space)
        if config.score_stop is None or context.step < config.score_stop:
            inconsistency = depth_inconsistency(sums.error, sums.weight, config.tau_u)
            contribution = opacity_contribution(sums.maxima, sums.observations)
            high = pruning_score(inconsistency, contribution, config.lambda_e) > config.tau_p
        else:
            high = floating(sums) | faint(sums)
        if self.streak is None:
            self.streak = torch.zeros(count, dtype=torch.int64, device=high.device)
        streak = self.streak.to(high.device)  # its state may have been loaded elsewhere
        self.streak = torch.where(sums.weight > 0, torch.where(high, streak + 1, 0), streak)
        remove = within_light(self.streak >= config.patience, sums.weight, config.light)
        if config.sight:
            last = config.stop is not None and context.step + config.every >= config.stop
            remove = remove | out_of_sight(context.evaluation, context.beside, count, RIM if last else 0.0)
        return remove

    def follow(self, index: Tensor) -> None:
        """Streaks move with their Gaussians; new ones start at 0."""
        if self.streak is not None:
            streak = self.streak.to(index.device)
            before = streak[index.clamp(min=0)] if len(streak) else streak.new_zeros(len(index))
            self.streak = torch.where(index >= 0, before, 0)

    def reset(self) -> None:
        """Forget all streaks."""
        self.streak = None

    def state_dict(self) -> dict[str, Tensor]:
        """The streaks, if there are any yet."""
        return {} if self.streak is None else {"streak": self.streak.clone()}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Continue from `state_dict()`."""
        self.streak = state["streak"].clone() if "streak" in state else None
