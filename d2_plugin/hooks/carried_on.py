"""Depth for what one camera alone sees: that of what is known beside it; an addition to the paper.

No second camera says how far such a surface is, so neither stereo nor images do: what is left to training drifts along
the ray, and held-out cameras see it smeared over their rim. Surfaces mostly go on where a second camera's image ends,
as the plane that they are, else as far away as next to it. What stands in front of them does not: depth is carried on
only where other cameras look through the space before it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from d2_plugin.hooks.hook import Context
from d2_plugin.hooks.prior import camera_centre
from d2_plugin.hooks.views import back_project
from d2_plugin.protocol import DepthPrior, Label, View

ACROSS = 48
"""Blocks along the longer side of an image; each has one depth."""
FEWEST = 0.25
"""Share of a block's pixels that have a depth, of a block that passes it on."""
REACH = 0.1
"""How far depth is carried on, in longer sides of the image; farther on nothing is known."""
NEIGHBOURS = 16
"""Blocks next to one that a plane is laid through."""
FEWEST_KNOWN = 6
"""Blocks with a depth in a view from which it is carried on."""
SCATTER = 0.02
"""Median distance from the plane, relative and as a standard deviation, from which on it is none. Planes meet the rim
of studio within 3 %, where the nearest depth is 13 % off."""
BEYOND = 1.25
"""How many times nearer or farther than all of those blocks the plane may run."""
FITS = 3
"""Times that it is laid, with less weight on what lay far from the last one."""
INSTANTS = 5
"""At how many of a camera's instants others have to look through the space: a person there is not matched at each."""
NEAREST = 0.2
"""Share of the depth at which that space begins."""
SAMPLES = 12
"""Places on a ray at which it is looked at."""
BEHIND = 1.05
"""A camera looks through a place where it has a depth that many times as far."""
SIGMA = 0.05
"""Relative standard deviation of a depth that was carried on."""


@dataclass(frozen=True, eq=False)
class Blocks:
    """The depth of one view in B blocks of pixels, row by row."""

    view: View
    side: int
    """Pixels along a block's side."""
    rows: int
    columns: int
    middles: Tensor
    """[B, 2] column and row, pixels."""
    depth: Tensor
    """[B], carried on to blocks that have none; NaN where that cannot be."""

    @classmethod
    def of(cls, view: View, prior: DepthPrior | None) -> Blocks:
        """Those of a view and its prior, if it has one."""
        side = -(-max(view.height, view.width) // ACROSS)
        rows, columns = -(-view.height // side), -(-view.width // side)
        block = torch.arange(rows * columns, device=view.K.device)
        places = torch.stack([torch.div(block, columns, rounding_mode="floor"), block % columns], -1).to(view.K)
        depth = places.new_full((len(places),), torch.nan)
        if prior is not None:
            known = torch.where(prior.support & torch.isfinite(prior.depth), prior.depth.to(places), torch.nan)
            around = (0, columns * side - view.width, 0, rows * side - view.height)
            pixels = F.pad(known, around, value=torch.nan).reshape(rows, side, columns, side).transpose(1, 2)
            pixels = pixels.reshape(rows * columns, -1)
            given = torch.isfinite(pixels).to(places).mean(1) >= FEWEST
            if int(given.sum()) >= FEWEST_KNOWN:
                depth[given] = pixels[given].nanmedian(1).values
                depth[~given] = _beside(places[given], depth[given], places[~given], REACH * max(rows, columns))
        return cls(view, side, rows, columns, side * (places.flip(1) + 0.5), depth)

    def surface(self) -> Tensor:
        """World points [B, 3] of the blocks' middles."""
        return back_project(self.view, self.middles - 0.5, self.depth)

    def looks_through(self, points: Tensor) -> Tensor:
        """At which world points [..., 3] the camera sees nothing: they are not in its image, or before a depth that is
        known there; bool [...]."""
        pose, K = self.view.T_camera_world.to(points), self.view.K.to(points)
        at = (points @ pose[:3, :3].T + pose[:3, 3]) @ K.T
        seen, z = self.view.sees(points.reshape(-1, 3)).reshape(points.shape[:-1]), at[..., 2]
        column, row = (torch.where(seen, along / (self.side * z), 0.0).long() for along in (at[..., 0], at[..., 1]))
        return ~seen | (self.depth[row * self.columns + column] > BEHIND * z)

    def over_pixels(self, of_block: Tensor) -> Tensor:
        """The value of its block at each pixel [H, W]."""
        image = of_block.reshape(self.rows, self.columns)
        image = image.repeat_interleave(self.side, 0).repeat_interleave(self.side, 1)
        return image[: self.view.height, : self.view.width]


def _beside(known: Tensor, depth: Tensor, places: Tensor, reach: float) -> Tensor:
    """Depth [C] at `places` [C, 2]: on the plane through the nearest of the `known` [K, 2], where they lie on one, else
    that of the nearest; NaN where that is farther than `reach`."""
    apart, nearest = torch.cdist(places, known).topk(min(NEIGHBOURS, len(known)), largest=False)
    near = apart[:, 0] < reach
    nearest, beside = nearest[near], torch.full_like(apart[:, 0], torch.nan)
    inverse = 1 / depth[nearest]  # affine in the image, of a plane
    towards = known[nearest] - places[near][:, None]
    design = torch.cat([torch.ones_like(towards[..., :1]), towards], -1)
    weights, slight = torch.ones_like(inverse), 1e-3 * torch.diag(design.new_tensor([0.0, 1, 1]))
    for _ in range(FITS):
        weighted = (design * weights[..., None]).transpose(1, 2)
        plane = torch.linalg.solve_ex(weighted @ design + slight, weighted @ inverse[..., None]).result
        off = (design @ plane)[..., 0] / inverse - 1
        scatter = 1.48 * off.abs().median(1).values
        weights = (1 + (off / (2 * scatter.clamp(min=SCATTER / 10)[:, None])) ** 2) ** -2
    least, most = inverse.aminmax(dim=1)
    carried = 1 / plane[:, 0, 0].clamp(least / BEYOND, most * BEYOND)
    beside[near] = torch.where(scatter < SCATTER, carried, depth[nearest[:, 0]])
    return beside


class CarriedOn:
    """Carries depth on; remembers of each camera before which of its blocks something may stand."""

    def __init__(self) -> None:
        self._blocked: dict[str, tuple[tuple[tuple[str, int], ...], Tensor]] = {}

    def __call__(self, prior: DepthPrior, view: View, context: Context, still: Tensor | None) -> DepthPrior:
        """The prior of a view with depth where it has none, nothing moves and no other camera looks.

        It stays as it is where cameras move, and where a network's depth is believed, which fills what it can.

        Args:
            prior: what is believed of it.
            still: where nothing moves, bool [H, W]; None where that is not known.
        """
        others = [other for other in context.beside(view) if other.camera != view.camera]
        if not others or (prior.support & (prior.labels != Label.VERIFIED)).any():
            return prior
        own = Blocks.of(view, prior)
        if not torch.isfinite(own.depth).any():
            return prior
        carried, surface = torch.isfinite(own.depth) & ~self._before(view, context), own.surface()
        for other in others:
            carried = carried & ~other.sees(surface)
        taken = own.over_pixels(carried) & ~prior.support & ~prior.far
        taken = taken if still is None else taken & still
        return prior._replace(
            depth=torch.where(taken, own.over_pixels(own.depth).to(prior.depth), prior.depth),
            labels=prior.labels.masked_fill(taken, int(Label.MONO)),
            sigma=None if prior.sigma is None else prior.sigma.masked_fill(taken, SIGMA),
        )

    def _before(self, view: View, context: Context) -> Tensor:
        """Blocks [B] of a camera before which something may stand at one of its instants."""
        instants = context.instants(view.camera)[:INSTANTS]
        cameras = [context.beside(instant) for instant in instants]
        looked_at = tuple((camera.camera, camera.frame) for beside in cameras for camera in beside)
        if view.camera not in self._blocked or self._blocked[view.camera][0] != looked_at:
            blocked = [before(instant, beside, context.prior) for instant, beside in zip(instants, cameras)]
            self._blocked[view.camera] = looked_at, torch.stack(blocked).any(0)
        return self._blocked[view.camera][1]


def before(view: View, cameras: Sequence[View], prior: Callable[[View], DepthPrior | None]) -> Tensor:
    """Blocks [B] of a view between which and the camera something may stand: another camera sees a place there, and not
    through it. None without a depth."""
    own = Blocks.of(view, prior(view))
    surface, shares = own.surface(), torch.linspace(NEAREST, 1 / BEHIND, SAMPLES, device=view.K.device)
    centre = camera_centre(view.T_camera_world).to(surface)
    places = centre + shares.to(surface)[:, None, None] * (surface - centre)
    others = [Blocks.of(camera, prior(camera)) for camera in cameras if camera.camera != view.camera]
    through = torch.stack([other.looks_through(places).all(0) for other in others]).all(0)
    return torch.isfinite(own.depth) & ~through
