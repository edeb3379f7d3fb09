"""Depth-guided densification (paper, section "Densification and Pruning")."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import torch
from torch import Tensor

from d2_plugin.hooks.expected import check_splats
from d2_plugin.hooks.hook import Context, Hook, HookConfig, Surveyed
from d2_plugin.hooks.views import back_project
from d2_plugin.protocol import DepthPrior, Edit, Label, Points, Splats, View
from d2_plugin.settings import Count, Every, Positive, Range, Share, Steps

if TYPE_CHECKING:
    from d2_plugin.hooks.carried_on import CarriedOn

log = logging.getLogger(__name__)

EPSILON = 1e-8
"""The paper's epsilon: only keeps 0/0 away. What bounds the gradient of a depth is tau_v, not epsilon."""

SIGMAS = 2.5
"""A pixel also counts as under-reconstructed only beyond this many standard deviations of its depth."""

OCCUPIED = 0.08
"""An existing Gaussian that is more opaque than this occupies its cell: one that was inserted and has not faded."""

CHANGED = 24
"""A channel, of 0 to 255, that differs by more than this from the camera's median over time shows something else."""

INSTANTS = 9
"""Of how many instants the median is taken."""

FEWEST = 3
"""With fewer there is no median to differ from."""

CANDIDATES = 8
"""Random pixels to choose from for each Gaussian that the budget allows: one square in 3,000 then has none of them."""

MOST = 1_000_000
"""Gaussians up to which there is insertion, where `max_gaussians` is not set."""

LEAST_CAMERAS = 3
"""From which on depth is carried on: of two, each sees much alone, and one looks through little of the space."""

MOST_MOVING = 0.5
"""Where more of an image differs, it is the light or the camera that changes, and nothing is known."""


@dataclass(frozen=True)
class DensifyConfig(HookConfig):
    """Depth-guided insertion of Gaussians."""

    stop: Steps | None = 1500
    """First step at which it no longer runs; refinement continues after it."""
    every: Every = 100
    """Steps between evaluations."""
    tau_v: Share = 0.5
    """A rendered depth is valid where the accumulated alpha exceeds this."""
    tau_u: Annotated[float, Range(1e-6, 1e6)] = 0.1
    """Relative depth error above which a pixel counts as under-reconstructed, where its depth is that exact; 2.5 of its
    standard deviations where it is less exact."""
    tau_u_mono: Annotated[float, Range(0, 1e6, infinite=True)] = 0.2
    """The threshold of pixels without a finite sigma: they may propose and no more."""
    spacing: Annotated[float, Range(1, 65_535, unit="pixels")] = 4.0
    """Distance between samples: one new Gaussian per square of this side where a surface is missing. The first
    evaluation so covers what the prior knows; later ones repair."""
    budget_per_view: Count = 20_000
    """No more samples than this in one view and evaluation: they lie further apart instead."""
    max_gaussians: Count | None = None
    """No more Gaussians than this, by insertion or by the trainer's own densification: the faintest of those that it
    added last go. None: a million for insertion, and no limit for the trainer."""
    scale: Annotated[float, Range(1e-3, 1000)] = 0.7
    """Standard deviation of a new Gaussian, which is round, in units of the distance between samples."""
    opacity: Annotated[float, Range(1e-6, 1)] = 0.1
    """Opacity of a new Gaussian. A faint one cannot spoil what stands; training makes it opaque where it is right."""
    carry_on: bool = True
    """Whether what one camera alone sees gets the depth of what is known beside it where stereo alone is believed, see
    `d2_plugin.hooks.carried_on`; the paper has no such depth."""
    lifetime: Positive | None = 1.0
    """Standard deviation in time of a new Gaussian where the image moves, in intervals from instant to instant, in a
    backbone that has one; none: as it begins there. New ones stand still."""

    @classmethod
    def for_iterations(cls, iterations: int) -> DensifyConfig:
        """Insertion from the first fortieth to half of the run, in numbers that the run has time to train."""
        every = max(5, min(iterations // 10, max(40, iterations // 20), 100))  # each costs as much as several steps
        start = max(1, min(every, iterations // 40))
        budget = max(10 * iterations, 200 * every)
        return cls(start=start, stop=max(iterations // 2, every + 1), every=every, budget_per_view=budget)


def rendered_depth(depth_sum: Tensor, alpha: Tensor, tau_v: float) -> tuple[Tensor, Tensor]:
    """D_hat = sum w z / (A + eps) and M^r = [A > tau_v], both [H, W].

    Where M^r is 0 the depth is 0 with no gradient; the denominator is made safe before the division, since a mask
    applied afterwards would turn inf * 0 into NaN.
    """
    valid = alpha > tau_v
    safe = torch.where(valid, alpha + EPSILON, torch.ones_like(alpha))
    return torch.where(valid, depth_sum, torch.zeros_like(depth_sum)) / safe, valid


def under_reconstructed(depth: Tensor, valid: Tensor, prior: Tensor, support: Tensor, tau_u: float | Tensor) -> Tensor:
    """U: pixels of the prior's support where nothing valid is rendered, or at another depth; bool [H, W].

    `depth`, `valid` are D_hat and M^r; `tau_u` may be a map [H, W], since a mono-only depth is less exact than a
    verified one.
    """
    delta = torch.abs(depth - prior) / (prior + EPSILON)  # meaningful where the prior has support (D* > 0)
    return support & (~valid | (delta > tau_u))


def shuffled_pixels(mask: Tensor, generator: torch.Generator) -> Tensor:
    """All pixels [K, 2] (column, row) of `mask` [H, W], in random order."""
    rows, columns = torch.nonzero(mask, as_tuple=True)
    order = torch.randperm(len(rows), generator=generator, device="cpu").to(rows.device, non_blocking=True)
    return torch.stack([columns, rows], -1)[order]


def frustum_cells(view: View, points: Tensor, stride: float, depth_step: float) -> Tensor:
    """Which cell of the view's frustum each world point lies in: int64 [K]; -1 outside the image.

    Cells are `stride` pixels wide and `depth_step` (relative) deep, so they grow with distance as the prior's own
    uncertainty does. Two points in one cell describe the same piece of surface.
    """
    pose, K = view.T_camera_world.to(points), view.K.to(points)
    camera, inside = points @ pose[:3, :3].T + pose[:3, 3], view.sees(points)
    safe = torch.where(inside, camera[:, 2], torch.ones_like(camera[:, 2]))
    image = (camera / safe[:, None]) @ K.T
    image = torch.where(inside[:, None], image, torch.zeros_like(image))
    column, row = (image[:, 0] / stride).long(), (image[:, 1] / stride).long()
    layer = torch.floor(safe.double().log() / math.log1p(depth_step)).long() + (1 << 27)  # 1e-6 deep: up to 2^27
    key = (layer * (1 << 16) + row) * (1 << 16) + column
    return torch.where(inside, key, torch.full_like(key, -1))


def first_of_each(keys: Tensor) -> Tensor:
    """Mask [K]: True for the first element of each distinct key (in order)."""
    order = torch.argsort(keys, stable=True)
    ordered = keys[order]
    first = torch.ones_like(ordered, dtype=torch.bool)
    first[1:] = ordered[1:] != ordered[:-1]
    return torch.zeros_like(first).scatter(0, order, first)


class MovingPixels:
    """Compares the images of a camera that stands still with their median over time, from the prior's colours.

    A Gaussian that is inserted where the image moves must not outlive its instant.
    """

    def __init__(self) -> None:
        self._still: dict[str, tuple[tuple[int, ...], Tensor]] = {}
        self._places: dict[tuple[str, int], list[float]] = {}

    def intervals(self, view: View, context: Context) -> Tensor | None:
        """The time from one instant to the next at pixels that move, infinite elsewhere: [H, W], the views' unit.

        None where nothing is known: a prior without colours, fewer than three instants, a camera that moves, light
        that changes.
        """
        seen = [other for other in context.instants(view.camera) if self._place(view) == self._place(other)]
        prior, still = context.prior(view), self._median(view.camera, seen[:INSTANTS], context)
        if prior is None or prior.colors is None or still is None:
            return None
        moving = ((prior.colors.short() - still.short()).abs() > CHANGED).any(-1)
        if moving.float().mean() > MOST_MOVING:
            return None
        return torch.where(moving, _interval(seen), torch.inf)

    def _place(self, view: View) -> list[float]:
        """Where a view is and what it looks through, on the host; each is asked once, since that waits for a GPU."""
        key = (view.camera, view.frame)
        if key not in self._places:
            self._places[key] = torch.cat([view.T_camera_world.flatten(), view.K.flatten()]).tolist()
        return self._places[key]

    def _median(self, camera: str, views: Sequence[View], context: Context) -> Tensor | None:
        """The median image uint8 [H, W, 3] of some views of a camera."""
        frames = tuple(view.frame for view in views)
        if camera not in self._still or self._still[camera][0] != frames:
            priors = [prior for view in views if (prior := context.prior(view)) is not None]
            images = [prior.colors for prior in priors if prior.colors is not None]
            if len(images) < FEWEST:
                return None
            self._still[camera] = frames, torch.stack(images).median(0).values
        return self._still[camera][1]


class Densify(Hook):
    """Inserts Gaussians where the prior has a surface that the render lacks or puts at another depth."""

    config: DensifyConfig

    def __init__(self, config: DensifyConfig) -> None:
        super().__init__(config)
        self._moving = MovingPixels()
        self._carry_on: CarriedOn | None = None
        self._full = False

    def edit(self, context: Context) -> Edit | None:
        """Points from the under-reconstructed pixels of the evaluated views, within the budget."""
        most = MOST if self.config.max_gaussians is None else self.config.max_gaussians
        room = most - len(context.backbone)
        if room <= 0 and not self._full:
            self._full = True
            count = len(context.backbone)
            log.warning("step %d: %d Gaussians, so none are inserted: max_gaussians = %d", context.step, count, most)
        inserted: list[Points] = []
        for surveyed, lives in (
            *(self._carried_on(surveyed, context) for surveyed in context.evaluation),
            *((surveyed, self._interval_everywhere(surveyed.view, context)) for surveyed in context.halfway),
        ):
            budget = min(self.config.budget_per_view, room - sum(len(p.positions) for p in inserted))
            if budget > 0:
                points = self._propose(surveyed, inserted, budget, context.generator, lives)
                inserted += [points] if len(points.positions) else []
        return Edit(insert=Points.joined(inserted)) if inserted else None

    def _propose(
        self,
        surveyed: Surveyed,
        earlier: list[Points],
        budget: int,
        generator: torch.Generator,
        lifetimes: Tensor | None,
    ) -> Points:
        """New points of one view that no existing Gaussian and no point of an earlier view already stands for;
        `lifetimes` [H, W] is how long they may live."""
        config, view, prior = self.config, surveyed.view, surveyed.prior
        check_splats(surveyed.splats, len(surveyed.splats.means), inserting=True)
        depth, valid = rendered_depth(surveyed.survey.depth_sum, surveyed.survey.alpha, config.tau_v)
        region = under_reconstructed(depth, valid, prior.depth, prior.support, self._tau_u(prior))
        pixels = shuffled_pixels(region, generator)
        spacing = max(config.spacing, math.sqrt(len(pixels) / budget))
        pixels = pixels[: CANDIDATES * budget]
        column, row = pixels.unbind(-1)
        target = prior.depth[row, column].float()  # as the Gaussians are
        positions = back_project(view, pixels, target)
        free = torch.nonzero(self._free(view, surveyed.splats, positions, earlier, spacing)).squeeze(1)[:budget]
        colors = (
            prior.colors[row, column].to(target) / 255 if prior.colors is not None else torch.full_like(positions, 0.5)
        )
        focal = torch.sqrt(view.K[0, 0] * view.K[1, 1])
        scales = config.scale * spacing * target / focal
        times, opacities = torch.full_like(target, view.time), torch.full_like(target, config.opacity)
        lifetimes = None if lifetimes is None else lifetimes[row, column]
        return Points(positions, colors, times, scales, opacities, lifetimes).select(free)

    def _carried_on(self, surveyed: Surveyed, context: Context) -> tuple[Surveyed, Tensor | None]:
        """A view, its prior carried on to what its camera alone sees; and `_lifetimes` of its pixels."""
        lives = self._lifetimes(surveyed.view, context)
        if not self.config.carry_on or len(context.beside(surveyed.view)) < LEAST_CAMERAS:
            return surveyed, lives
        if self._carry_on is None:
            from d2_plugin.hooks.carried_on import CarriedOn  # most trainers never get here

            self._carry_on = CarriedOn()
        still = None if lives is None else torch.isinf(lives)
        return surveyed._replace(prior=self._carry_on(surveyed.prior, surveyed.view, context, still)), lives

    def _lifetimes(self, view: View, context: Context) -> Tensor | None:
        """How long a new Gaussian may live at each pixel [H, W], infinite where nothing moves; None: not known."""
        intervals = None if self.config.lifetime is None else self._moving.intervals(view, context)
        return None if self.config.lifetime is None or intervals is None else self.config.lifetime * intervals

    def _interval_everywhere(self, view: View, context: Context) -> Tensor | None:
        """The same [H, W] halfway between instants, where whatever has a depth moves."""
        interval = _interval(context.instants(view.camera))
        like, lifetime = view.T_camera_world, self.config.lifetime
        return None if lifetime is None else like.new_full((view.height, view.width), lifetime * interval)

    def _tau_u(self, prior: DepthPrior) -> Tensor:
        """The relative depth error [H, W] that counts as under-reconstructed, by how exact each pixel is."""
        config = self.config
        if prior.sigma is None:
            return torch.where(prior.labels == Label.VERIFIED, config.tau_u, config.tau_u_mono)
        exact = (SIGMAS * prior.sigma).clamp(min=config.tau_u)
        return torch.where(torch.isfinite(prior.sigma), exact, config.tau_u_mono)

    def _free(self, view: View, splats: Splats, positions: Tensor, earlier: list[Points], spacing: float) -> Tensor:
        """Mask of candidates whose frustum cell is empty, the first one of each cell: a stratified sample."""
        taken = torch.cat([splats.means, *(p.positions for p in earlier)])
        cells = frustum_cells(view, positions, spacing, self.config.tau_u)
        occupied = frustum_cells(view, taken, spacing, self.config.tau_u)
        opaque = splats.opacities > OCCUPIED
        occupied[: len(opaque)].masked_fill_(~opaque, -1)
        return (cells >= 0) & ~_among(cells, occupied) & first_of_each(cells)


def _among(keys: Tensor, known: Tensor) -> Tensor:
    """Mask [K]: which keys are among the known ones [N]; unlike `torch.isin` it waits for no GPU."""
    if not len(known):
        return torch.zeros_like(keys, dtype=torch.bool)
    known = known.sort().values
    return known[torch.searchsorted(known, keys).clamp(max=len(known) - 1)] == keys


def _interval(views: Sequence[View]) -> float:
    """The shortest time between two instants; infinite if there is but one."""
    times = torch.tensor(sorted({view.time for view in views}), dtype=torch.float64)
    return float(times.diff().min()) if len(times) > 1 else torch.inf
