"""What all variants of diff_gaussian_rasterization share: from their arguments to this plugin's rasterizer and back."""

from __future__ import annotations

import logging
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from d2_plugin.compat.absolute import Drawing, WithAbsoluteGradient
from d2_plugin.errors import D2Error
from d2_plugin.gaussians.rotation4d import covariances_from_factors, rotation_matrices_3d
from d2_plugin.gaussians.spherical_harmonics import basis
from d2_plugin.protocol import RasterSettings, Splats, View
from d2_plugin.rasterizer import rasterize
from d2_plugin.rasterizer.reference import project

log = logging.getLogger(__name__)

SETTINGS = RasterSettings()
"""Inria's constants are the defaults of ours."""

TILE = 16
"""Side of Inria's tiles in pixels; a Gaussian that touches none has radius 0."""


class StandIn(nn.Module):
    """What all of Inria's heirs call GaussianRasterizer: it is made anew for every image."""

    def __init__(self, raster_settings: Any) -> None:
        super().__init__()
        self.raster_settings = raster_settings

    def markVisible(self, positions: Tensor) -> Tensor:
        """bool [N]: which positions [N, 3] lie before the near plane."""
        return in_front(positions, self.raster_settings.viewmatrix)


class Drawn(NamedTuple):
    """One rendered view in Inria's layout."""

    color: Tensor  # [C, H, W]
    depth: Tensor  # [1, H, W] sum of w z, not normalised
    alpha: Tensor  # [1, H, W]
    radii: Tensor  # [N] int32, pixels; 0 where not drawn


def draw(
    settings: Any,
    splats: Splats,
    colors: Tensor,
    background: Tensor,
    means2D: Tensor | None,
    count: int,
    absolute: Tensor | None = None,
    constants: RasterSettings = SETTINGS,
) -> Drawn:
    """Composite `splats`, which are rows `splats.rows` of `count` Gaussians.

    Args:
        settings: a GaussianRasterizationSettings of any variant.
        splats: 3D Gaussians [M] in the world.
        colors: [M, C].
        background: [C].
        means2D: [N, 3] or [N, 2]; receives dL/d(normalised device coordinate) as its gradient, which is dL/d(pixel)
            times half the image's size: the unit that `densify_grad_threshold` is in. Its values are not used.
        count: N.
        absolute: [N, 3]; receives the sum over pixels of absolute gradients in the same unit (`absolute.py`).
        constants: those of the variant's rasterizer, where they are not Inria's.
    """
    view = view_of(settings)
    offsets = None
    if means2D is not None and means2D.requires_grad:
        chosen = means2D[splats.rows, :2]
        offsets = (chosen - chosen.detach()) * chosen.new_tensor([0.5 * view.width, 0.5 * view.height])
    background = background.to(colors)[: colors.shape[1]]  # SpacetimeGaussians gives nine values for three channels
    image = rasterize(splats, colors, view, constants, background=background, screen_offsets=offsets)
    color = image.color
    if absolute is not None and absolute.requires_grad:
        drawing = Drawing(Splats(*(field.detach() for field in splats)), colors.detach(), view, constants)
        color = WithAbsoluteGradient.apply(color, absolute, drawing)
    radii = torch.zeros(count, dtype=torch.int32, device=splats.means.device)
    radii[splats.rows] = screen_radii(splats, view, constants)
    # Contiguous, as the originals': trainers call .view on the image.
    return Drawn(color.permute(2, 0, 1).contiguous(), image.depth_sum[None], image.alpha[None], radii)


def view_of(settings: Any) -> View:
    """The camera behind Inria's two matrices, which act on row vectors.

    K comes from the projection matrix alone, since that is what places the centres: it may hold principal points that
    the field of view cannot say.
    """
    width, height = int(settings.image_width), int(settings.image_height)
    # Cameras of PanopticSports have a batch of one; the CUDA sources read sixteen numbers.
    world_view, full = (matrix.detach().double().reshape(4, 4) for matrix in (settings.viewmatrix, settings.projmatrix))
    projection = torch.linalg.solve(world_view, full).T
    K = torch.zeros(3, 3, dtype=torch.float64, device=world_view.device)
    K[0, 0], K[1, 1], K[2, 2] = 0.5 * width * projection[0, 0], 0.5 * height * projection[1, 1], 1.0
    K[0, 2], K[1, 2] = 0.5 * width * (1 + projection[0, 2]), 0.5 * height * (1 + projection[1, 2])
    _compare_focal_lengths(settings, float(K[0, 0]), float(K[1, 1]))
    return View("", 0, 0.0, world_view.T.float().contiguous(), K.float(), width, height)


_contradictions: set[tuple[float, float]] = set()


def _compare_focal_lengths(settings: Any, focal_x: float, focal_y: float) -> None:
    said = (0.5 * settings.image_width / settings.tanfovx, 0.5 * settings.image_height / settings.tanfovy)
    if abs(said[0] - focal_x) > 1e-3 * focal_x or abs(said[1] - focal_y) > 1e-3 * focal_y:
        if not _contradictions:
            log.warning(
                "the field of view stands for focal lengths of %.1f and %.1f pixels but the projection matrix has %.1f "
                "and %.1f, which are used for footprints, too",
                *said, focal_x, focal_y,
            )  # fmt: skip
        _contradictions.add(said)


def covariances_of(scales: Tensor, rotations: Tensor, scale_modifier: float) -> Tensor:
    """R S S^T R^T as [N, 6] xx xy xz yy yz zz.

    Quaternions [N, 4], w first, are not normalised, as in the CUDA sources: Deformable-3D-Gaussians adds to them after
    its own normalisation, and their length then scales the Gaussian.
    """
    factors = rotation_matrices_3d(rotations.T) * (scale_modifier * scales.T)
    return covariances_from_factors(factors)


def colors_of(shs: Tensor, degree: int, means: Tensor, camera_centre: Tensor) -> Tensor:
    """RGB [N, 3] >= 0 of spherical harmonics [N, (max degree + 1)^2, 3] seen from `camera_centre` [3]."""
    return torch.relu((harmonics(means, camera_centre, degree)[..., None] * shs[:, : (degree + 1) ** 2]).sum(1) + 0.5)


def harmonics(means: Tensor, camera_centre: Tensor, degree: int) -> Tensor:
    """Y_k [N, (degree + 1)^2] of the directions from the camera to `means` [N, 3]."""
    return basis(torch.nn.functional.normalize(means - camera_centre.to(means), dim=-1), degree)


@torch.no_grad()
def screen_radii(splats: Splats, view: View, constants: RasterSettings = SETTINGS) -> Tensor:
    """Inria's radii [M] int32: three standard deviations along the longer axis, 0 where no tile is touched."""
    forward = view.T_camera_world[2].to(splats.means)
    depths = splats.means @ forward[:3] + forward[3]
    front = (depths > constants.near).nonzero()[:, 0]
    part = Splats(*(field[front] for field in splats))
    screen = project(part, view, constants)
    middle = 0.5 * (screen.variance_x + screen.variance_y)
    determinant = screen.variance_x_given_y * screen.variance_y
    radii = torch.ceil(3 * (middle + (middle.square() - determinant).clamp(min=0.1).sqrt()).sqrt())
    size = torch.tensor([view.width, view.height], device=radii.device)
    tiles = (size + TILE - 1) // TILE
    pixels = screen.centers - 0.5  # Inria's pixel i has its centre at i
    first = ((pixels - radii[:, None]) / TILE).trunc().clamp(min=0).minimum(tiles)
    last = ((pixels + radii[:, None] + TILE - 1) / TILE).trunc().clamp(min=0).minimum(tiles)
    touching = ((last - first).prod(-1) > 0) & radii.isfinite()
    found = torch.zeros(len(splats.means), dtype=torch.int32, device=radii.device)
    found[front] = torch.where(touching, radii, torch.zeros_like(radii)).to(torch.int32)
    return found


@torch.no_grad()
def in_front(positions: Tensor, viewmatrix: Tensor) -> Tensor:
    """bool [N]: the near test of markVisible, which is all that Inria's sources do there."""
    forward = viewmatrix.reshape(4, 4)[:, 2].to(positions)
    return positions @ forward[:3] + forward[3] > SETTINGS.near


def exactly_one(what: str, first: object | None, second: object | None) -> None:
    """Raise `D2Error` unless one of two alternatives is given; `what` names them."""
    if (first is None) == (second is None):
        got = "neither" if first is None else "both"
        raise D2Error(f"the rasterizer takes either {what}, got {got}: give exactly one")


def given(value: Tensor | None, name: str) -> Tensor:
    """The tensor, or a `D2Error` that asks for it."""
    if value is None:
        raise D2Error(f"the rasterizer needs {name} for these Gaussians, got None: pass it")
    return value


def shape_given(scales: Tensor | None, rotations: Tensor | None, cov3D_precomp: Tensor | None) -> None:
    """Raise `D2Error` unless the shape of the Gaussians is given once, as scales with rotations or as covariances."""
    if (scales is None) != (rotations is None):
        raise D2Error("the rasterizer takes scales and rotations together, got one of them: give both")
    exactly_one("scales with rotations or cov3D_precomp", scales, cov3D_precomp)
