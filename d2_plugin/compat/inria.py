"""`diff_gaussian_rasterization` of graphdeco-inria/gaussian-splatting, and what all its variants share."""

from __future__ import annotations

import functools
import logging
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

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


class GaussianRasterizationSettings(NamedTuple):
    """The camera and constants of one image, by name, as all variants know them; matrices act on row vectors."""

    image_height: int
    image_width: int
    tanfovx: float
    tanfovy: float
    bg: Tensor
    scale_modifier: float
    viewmatrix: Tensor
    projmatrix: Tensor
    sh_degree: int
    campos: Tensor
    prefiltered: bool = False
    debug: bool = False
    antialiasing: bool = False
    # 4D (fourd.py)
    sh_degree_t: int = 0
    timestamp: float = 0.0
    time_duration: float = 1.0
    rot_4d: bool = False
    gaussian_dim: int = 3
    force_sh_3d: bool = False
    # Ex4DGS (ex4dgs.py)
    kernel_size: float = 0.1
    subpixel_offset: Tensor | None = None
    min_depth: float = 0.2
    max_depth: float = 100.0


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
        constants: those of the variant's rasterizer, where they are not Inria's.
    """
    view = view_of(settings)
    offsets = None
    if means2D is not None and means2D.requires_grad:
        chosen = means2D[splats.rows, :2]
        offsets = (chosen - chosen.detach()) * chosen.new_tensor([0.5 * view.width, 0.5 * view.height])
    background = background.to(colors)[: colors.shape[1]]  # SpacetimeGaussians gives nine values for three channels
    image = rasterize(splats, colors, view, constants, background=background, screen_offsets=offsets)
    radii = torch.zeros(count, dtype=torch.int32, device=splats.means.device)
    radii[splats.rows] = screen_radii(splats, view, constants)
    # Contiguous, as the originals': trainers call .view on the image.
    return Drawn(image.color.permute(2, 0, 1).contiguous(), image.depth_sum[None], image.alpha[None], radii)


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


def _compare_focal_lengths(settings: Any, focal_x: float, focal_y: float) -> None:
    focal = (0.5 * settings.image_width / settings.tanfovx, 0.5 * settings.image_height / settings.tanfovy)
    if abs(focal[0] - focal_x) > 1e-3 * focal_x or abs(focal[1] - focal_y) > 1e-3 * focal_y:
        warn_once(
            f"the field of view stands for focal lengths of {focal[0]:.1f} and {focal[1]:.1f} pixels but the "
            f"projection matrix has {focal_x:.1f} and {focal_y:.1f}, which are used for footprints, too"
        )


@functools.cache
def warn_once(sentence: str) -> None:
    """Log a warning, the same one only once."""
    log.warning("%s", sentence)


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
def screen_radii(splats: Splats, view: View, constants: RasterSettings) -> Tensor:
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
    all_radii = torch.zeros(len(splats.means), dtype=torch.int32, device=radii.device)
    all_radii[front] = torch.where(touching, radii, torch.zeros_like(radii)).to(torch.int32)
    return all_radii


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


class GaussianRasterizer(nn.Module):
    """The original's module: it is made anew with the settings of every image, and called with the Gaussians."""

    def __init__(self, raster_settings: Any) -> None:
        if raster_settings.antialiasing:
            raise D2Error(
                "antialiasing needs the original rasterizer, this stand-in has none: switch it off or build it"
            )
        super().__init__()
        self.raster_settings = raster_settings

    @torch.no_grad()
    def markVisible(self, positions: Tensor) -> Tensor:
        """bool [N]: which positions [N, 3] lie before the near plane, which is all that Inria's sources test."""
        forward = self.raster_settings.viewmatrix.reshape(4, 4)[:, 2].to(positions)
        return positions @ forward[:3] + forward[3] > SETTINGS.near

    def forward(
        self, means3D: Tensor, means2D: Tensor, opacities: Tensor, **others: Tensor | None
    ) -> tuple[Tensor, ...]:
        """Color [3, H, W] and radii [N] int32, with gradients to every tensor given; for `others` see `_chosen`."""
        drawn = self._draw(means3D, means2D, opacities, **others)
        return drawn.color, drawn.radii

    def _draw(self, means3D: Tensor, means2D: Tensor, opacities: Tensor, **others: Tensor | None) -> Drawn:
        rows = torch.arange(len(means3D), device=means3D.device)
        splats, colors = self._chosen(rows, means3D, opacities, **others)
        return draw(self.raster_settings, splats, colors, self.raster_settings.bg, means2D, len(rows))

    def _chosen(
        self,
        rows: Tensor,
        means3D: Tensor,
        opacities: Tensor,
        shs: Tensor | None = None,
        colors_precomp: Tensor | None = None,
        scales: Tensor | None = None,
        rotations: Tensor | None = None,
        cov3D_precomp: Tensor | None = None,
    ) -> tuple[Splats, Tensor]:
        """The Gaussians of `rows` [M], and their colours [M, C]; arguments as the originals have them."""
        settings = self.raster_settings
        exactly_one("shs or colors_precomp", shs, colors_precomp)
        shape_given(scales, rotations, cov3D_precomp)
        means = means3D[rows]
        if cov3D_precomp is None:
            shape = given(scales, "scales")[rows], given(rotations, "rotations")[rows]
            covariances = covariances_of(*shape, settings.scale_modifier)
        else:
            covariances = cov3D_precomp[rows]
        if colors_precomp is None:
            colors = colors_of(given(shs, "shs")[rows], settings.sh_degree, means, settings.campos)
        else:
            colors = colors_precomp[rows]
        return Splats(means, covariances, opacities.squeeze(-1)[rows], rows), colors
