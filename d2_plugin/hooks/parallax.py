"""Supervision of parallax: what a camera on its way to another one would have seen (an addition to the paper).

Images alone say nothing of the views between the cameras: Gaussians at a wrong depth can reproduce every trained image
and stand before everything else in all others. A surface on which two cameras agree is in sight on the way from one to
the other as well, in the colours that they saw, unless something known, or something that moves, hides it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from d2_plugin.hooks.densify import INSTANTS, MovingPixels
from d2_plugin.hooks.hook import Context, HookConfig, ImageHook
from d2_plugin.hooks.prior import camera_centre
from d2_plugin.protocol import DepthPrior, View
from d2_plugin.settings import Every, Range

PARTS = (1 / 3, 2 / 3)
"""Parts of the way in turn."""

APART = 1.5
"""Pixels on the way within which both cameras must place a surface."""

HIDES = 0.98
"""A surface is hidden by what lies nearer than this share of its depth."""

COARSE = 4
"""Side, in pixels, of the squares in which what moves may hide a surface."""

DEPTHS = 24
"""At how many depths it may stand, evenly spread in inverse depth."""

NEAREST = 0.05
"""The nearest of them, as a share of the largest depth."""

RIM = 4
"""Pixels around what moves that may belong to it."""

KEPT = 512 << 20
"""Bytes of what is in sight that are kept, so that it is found once."""

LEAST = 0.02
"""Share of a view that must be known on the way: less is not worth a render."""


@dataclass(frozen=True)
class ParallaxConfig(HookConfig):
    """Supervision between cameras. Each time costs a render, with gradients."""

    every: Every = 4
    """Steps from one time to the next."""
    weight: Annotated[float, Range(0, 1e6)] = 2.0
    """Weight beside the trainer's own photometric loss."""

    @classmethod
    def for_iterations(cls, iterations: int) -> ParallaxConfig:
        """From the twentieth of a run on, when it is known what moves."""
        return cls(start=max(1, iterations // 20))


class Side(NamedTuple):
    """A camera at one end of the way, and what it knows."""

    view: View
    prior: DepthPrior
    moving: Tensor | None = None
    """Where its image moves, bool [H, W]; none where that is not known."""


Sight = tuple[View, Tensor, Tensor]
"""A place on the way, the pixels [K] (int32, row * width + column) of a view that are seen there, and where, [2, K]."""


class Parallax(ImageHook):
    """Adds the photometric loss between each view of the present step and the same surfaces as seen from aside."""

    config: ParallaxConfig

    def __init__(self, config: ParallaxConfig) -> None:
        super().__init__(config)
        self._sights: dict[tuple[str, int, str, float], tuple[int, Sight]] = {}  # and of how many instants
        self._bytes = 0
        self._moving = MovingPixels()

    def term(self, context: Context, view: View) -> Tensor | None:
        """See `ImageHook.term`."""
        from d2_plugin.gaussians.photometric import photometric_loss  # a trainer without this hook needs none of it

        sight, prior = self._sight(context, view), context.prior(view)
        if sight is None or prior is None or prior.colors is None or len(sight[1]) < LEAST * prior.depth.numel():
            return None
        aside, pixels, places = sight[0], sight[1].long(), sight[2]
        drawn = self.drawn(context.backbone, aside)
        if drawn is None:
            return None
        image = prior.colors.to(drawn.color) / 255
        trained = image.view(-1, 3)
        seen = _sampled(torch.cat([drawn.color, 1 - drawn.alpha[..., None]], -1), places)
        # What is transparent shows what it should: a background would learn there what no camera sees of it.
        shown = trained.index_copy(0, pixels, seen[:, :3] + seen[:, 3:] * trained[pixels])
        return photometric_loss(shown.view_as(image), image)

    def _sight(self, context: Context, view: View) -> Sight | None:
        """What is seen on the way to one other camera, in turn; None where there is none, or no prior."""
        cameras, turn = context.beside(view), context.step // self.config.every
        others = [other for other in cameras if other.camera != view.camera and other.frame == view.frame]
        if not others:
            return None
        other, part = others[turn % len(others)], PARTS[turn // len(others) % len(PARTS)]
        ends = view, other
        # What moves is known better while instants are seen for the first time.
        instants = min(INSTANTS, *(len(context.instants(end.camera)) for end in ends))
        key = view.camera, view.frame, other.camera, part
        known, sight = self._sights.get(key, (0, None))
        if sight is None or known != instants:
            sides = [Side(end, prior) for end in ends if (prior := context.prior(end)) is not None]
            moving = [life.isfinite() for end in ends if (life := self._moving.intervals(end, context)) is not None]
            if len(sides) < 2:
                return None
            if len(moving) == 2:
                sides = [side._replace(moving=pixels) for side, pixels in zip(sides, moving)]
            aside = on_the_way(view, other, part)
            room = KEPT - self._bytes + (12 * len(sight[1]) if sight else 0)
            sight = aside, *in_sight(aside, *sides)
            if (size := 12 * len(sight[1])) <= room:
                self._bytes, self._sights[key] = KEPT - room + size, (instants, sight)
        return sight


def on_the_way(view: View, other: View, part: float) -> View:
    """The view, moved and turned that part of the way to another camera; it keeps its name, lens and time."""
    blend = torch.lerp(view.T_camera_world, other.T_camera_world, part)[:3, :3]
    left, _, right = torch.linalg.svd(blend)
    left[:, 2] *= torch.linalg.det(left @ right)  # no reflection, where they look in opposite directions
    pose = view.T_camera_world.clone()
    pose[:3, :3] = left @ right  # the rotation that is nearest to the blend
    centres = camera_centre(view.T_camera_world), camera_centre(other.T_camera_world)
    pose[:3, 3] = -pose[:3, :3] @ torch.lerp(*centres, part)
    return replace(view, T_camera_world=pose)


def in_sight(aside: View, own: Side, other: Side) -> tuple[Tensor, Tensor]:
    """Pixels [K] (row * width + column) of the own view whose surface is seen from aside, and where, in pixels [2, K].

    Both cameras know the surface and place it within `APART` pixels of each other there. Nothing hides it that either
    of them knows, nor what moves, which may stand wherever both see something that moves.
    """
    pixels, surface = _surface(own.view, own.prior)
    _, surface_beside = _surface(other.view, other.prior)
    places, _, met = _projected(other.view, surface)
    there = _index(other.view, places)  # what the other camera has in the same direction
    counterpart = _back_projected(other.view, there, other.prior.depth)
    places, depth, inside = _projected(aside, surface)
    same = (_projected(aside, counterpart)[0] - places).norm(dim=0) < APART
    nearest = _nearest(aside, torch.cat([surface, surface_beside], 1))
    if own.moving is not None and other.moving is not None and len(depth):
        hull = _nearest_that_moves(aside, [(own.view, own.moving), (other.view, other.moving)], depth.max())
        nearest = torch.minimum(nearest, hull)
    hidden = depth * HIDES >= nearest[_index(aside, places)]
    known = inside & met & other.prior.trusted.flatten()[there] & same & ~hidden
    return pixels[known].int(), places[:, known]


def _surface(view: View, prior: DepthPrior) -> tuple[Tensor, Tensor]:
    """The trusted pixels [K] of a view and the world points [3, K] there."""
    pixels = torch.nonzero((prior.trusted & (prior.depth > 0)).flatten()).squeeze(1)
    return pixels, _back_projected(view, pixels, prior.depth)


def _back_projected(view: View, pixels: Tensor, depth: Tensor) -> Tensor:
    """World points [3, K] at the depth [H, W] of pixels [K]."""
    row, column = torch.div(pixels, view.width, rounding_mode="floor"), pixels % view.width
    rays = torch.stack([column + 0.5, row + 0.5, torch.ones_like(pixels)])
    return _unprojected(view, rays * depth.flatten()[pixels].float())


def _projection(view: View) -> tuple[Tensor, Tensor]:
    """Matrix [3, 3] and shift [3, 1] in float64 that take world points to (column, row, 1) * depth."""
    both = view.K.double() @ view.T_camera_world[:3].double()
    return both[:, :3], both[:, 3:]


def _unprojected(view: View, seen: Tensor) -> Tensor:
    """World points [3, K] of pixels times their depth, (column, row, 1) * depth [3, K]."""
    matrix, shift = _projection(view)
    return torch.linalg.inv_ex(matrix).inverse.float() @ (seen - shift.float())


def _projected(view: View, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Places of world points [3, K] in a view, in pixels [2, K], their planar depths [K], and which are in it [K]."""
    matrix, shift = _projection(view)
    image = torch.addmm(shift.float(), matrix.float(), points)
    places, depth = image[:2] / image[2].clamp(min=1e-9), image[2]
    inside = (depth > 0) & (places >= 0).all(0) & (places[0] < view.width) & (places[1] < view.height)
    return places, depth, inside


def _nearest_that_moves(aside: View, sides: Sequence[tuple[View, Tensor]], far: Tensor) -> Tensor:
    """Depth [H * W] from aside of the nearest place up to `far` that lies in what moves [H, W] in all of the views."""
    sizes = aside.height, aside.width  # of which the last block may be a part
    middles = (torch.arange(COARSE / 2, size + COARSE / 2, COARSE, device=far.device) for size in sizes)
    down, right = (middle.clamp(max=size - 0.5) for middle, size in zip(middles, sizes))
    row, column = torch.meshgrid(down, right, indexing="ij")
    depths = 1 / torch.linspace(1, 1 / NEAREST, DEPTHS, device=far.device) * far
    rays = torch.stack([column.flatten(), row.flatten(), torch.ones_like(row).flatten()])
    points = _unprojected(aside, (rays[:, None] * depths[:, None]).flatten(1))
    filled = torch.ones_like(points[0], dtype=torch.bool)
    for view, moving in sides:
        places, _, inside = _projected(view, points)
        wide = F.max_pool2d(moving[None].to(far), 2 * RIM + 1, 1, RIM).flatten() > 0
        filled &= inside & wide[_index(view, places)]
    nearest = torch.where(filled.view(DEPTHS, -1), depths[:, None], torch.inf).amin(0).view_as(row)
    fine = nearest.repeat_interleave(COARSE, 0).repeat_interleave(COARSE, 1)
    return fine[: aside.height, : aside.width].flatten()


def _sampled(maps: Tensor, places: Tensor) -> Tensor:
    """Maps [H, W, C] at places [2, K], in pixels, between their pixels: [K, C]."""
    height, width, _ = maps.shape
    grid = torch.stack([2 / width * places[0] - 1, 2 / height * places[1] - 1], -1)
    maps = maps.permute(2, 0, 1)[None]
    return F.grid_sample(maps, grid[None, None].to(maps), padding_mode="border", align_corners=False)[0, :, 0].T


def _index(view: View, places: Tensor) -> Tensor:
    """The pixels [K] that places [2, K] lie in; the nearest ones for those beside the image."""
    column, row = places[0].clamp(0, view.width - 1).long(), places[1].clamp(0, view.height - 1).long()
    return row * view.width + column


def _nearest(view: View, points: Tensor) -> Tensor:
    """Depth [H * W] of the nearest of world points [3, K] in each pixel of a view and the eight around it."""
    places, depth, inside = _projected(view, points)
    nearest = depth.new_full((view.height * view.width,), torch.inf)
    nearest.scatter_reduce_(0, _index(view, places[:, inside]), depth[inside], "amin")
    return -F.max_pool2d(-nearest.view(1, view.height, view.width), 3, 1, 1).flatten()
