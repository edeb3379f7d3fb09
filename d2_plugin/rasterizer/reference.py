"""Splatting in plain torch: the oracle of the kernels (float64, gradcheck) and the fallback without a compiler.

The image is the compositing sum of 3D Gaussian Splatting (Kerbl et al. 2023) with the constants of `RasterSettings`:
a Gaussian with screen mean m, blurred screen covariance S and opacity o has at pixel centre p

    alpha = min(alpha_max, o exp(-1/2 (p - m)^T S^-1 (p - m))),    skipped where o exp(..) < alpha_min
    w_i = alpha_i prod_{j < i} (1 - alpha_j),                      0 from where the product reaches transmittance_min

in order of view depth, ties by index. There are no other cut-offs: no 3-sigma radius, no influence of tiles. Everything
is differentiable by autograd; indices (who is visible, in which order, until when) are chosen without gradients.
With a near edge D_near(p) of what a depth prior allows, front(p) = sum_i w_i max(0, 1 - z_i / D_near(p)).
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from d2_plugin.errors import D2Error
from d2_plugin.protocol import DepthPrior, RasterSettings, Render, Splats, Survey, View, covariance_matrices

TILE = 16
"""Side of the squares of pixels that are composited at once; limits memory, changes nothing else."""

VARIANCE_FLOOR = 1e-8
"""Least variance on the screen where `RasterSettings.blur` is smaller; pixels squared."""

LEAST_EDGE = 1e-30
"""A near edge that is not beyond this counts as unknown; its inverse would not be finite in float32."""

LEAST_AREA = 2.5e-5
"""Least share of its own area in its blurred area that a Gaussian is taken to have, as Mip-Splatting's code does: an
edge-on Gaussian has none, and the logarithm no derivative there."""


class Projection(NamedTuple):
    """Gaussians on the screen. S^-1 = L L^T is evaluated as a sum of squares, (x - slope y)^2 / variance_x_given_y +
    y^2 / variance_y, which cannot turn negative by rounding however long and thin a Gaussian is."""

    centers: Tensor  # [M, 2] pixels
    variance_x: Tensor  # [M] blurred variance along x, pixels squared
    variance_y: Tensor  # [M] blurred variance along y
    slope: Tensor  # [M] covariance / variance_y: how x shifts with y
    variance_x_given_y: Tensor  # [M] Schur complement, at least the blur
    depths: Tensor  # [M] view z
    opacities: Tensor  # [M]

    def reach(self, alpha_min: float) -> Tensor:
        """Half extents [M, 2] of the box outside of which alpha < alpha_min; pixels."""
        squared = 2 * torch.log(self.opacities / alpha_min).clamp(min=0)
        return torch.sqrt(squared[:, None] * torch.stack([self.variance_x, self.variance_y], -1))


def rasterize(
    splats: Splats,
    colors: Tensor,
    view: View,
    settings: RasterSettings,
    background: Tensor | None = None,
    screen_offsets: Tensor | None = None,
    near_edge: Tensor | None = None,
) -> Render:
    """See `d2_plugin.rasterizer.rasterize`; any floating dtype, any device."""
    kept = visible(splats, colors, view, settings, screen_offsets)
    screen = project(_take(splats, kept), view, settings, None if screen_offsets is None else screen_offsets[kept])
    values = torch.cat([colors[kept], screen.depths[:, None], torch.ones_like(screen.depths)[:, None]], 1)
    edge = None if near_edge is None else _known(near_edge, screen.depths)
    # The backward pass computes a row of tiles again, which bounds memory by that row instead of the image.
    again = functools.partial(checkpoint, _tile_row, use_reentrant=False)
    row = again if torch.is_grad_enabled() else _tile_row
    image = torch.cat([row(screen, values, view, settings, edge, y) for y in range(0, view.height, TILE)], 0)
    # A loss that divides by alpha sends NaN where nobody contributes, which 0 times a weight would not silence.
    image = torch.where(image[..., -1:].detach() > 0, image, 0)
    color, depth_sum, alpha = image[..., : colors.shape[1]], image[..., colors.shape[1]], image[..., -1]
    if background is not None:
        color = color + (1 - alpha)[..., None] * background
    return Render(color, depth_sum, alpha, None if edge is None else torch.where(edge > 0, image[..., -2], 0))


def _tile_row(
    screen: Projection, values: Tensor, view: View, settings: RasterSettings, edge: Tensor | None, y: int
) -> Tensor:
    """Composited `values` [K, V] of a row of tiles, [h, W, V]; with `edge` the weight in front of it is inserted before
    the last."""
    height, row = min(TILE, view.height - y), []
    for x in range(0, view.width, TILE):
        weights, front_to_back = _tile_weights(screen, view, settings, x, y)
        image = weights @ values[front_to_back]
        if edge is not None:
            front = (weights * in_front(edge[y : y + TILE, x : x + TILE], screen.depths[front_to_back])).sum(1)
            image = torch.cat([image[:, :-1], front[:, None], image[:, -1:]], 1)
        row.append(image.reshape(height, min(TILE, view.width - x), -1))
    return torch.cat(row, 1)


def in_front(edge: Tensor, depths: Tensor) -> Tensor:
    """max(0, 1 - z / D_near) [P, K] of depths [K] at the P pixels of `edge`, which is 0 where nothing is known."""
    edge = edge.reshape(-1, 1)
    return torch.relu(edge - depths) / torch.where(edge > 0, edge, 1)


def _known(near_edge: Tensor, like: Tensor) -> Tensor:
    """The near edge in the dtype of `like`, 0 where nothing is known."""
    edge = near_edge.detach().to(like)
    return torch.where(edge.isfinite() & (edge > LEAST_EDGE), edge, 0)


def reliability(prior: DepthPrior) -> Tensor:
    """r(p) [H, W]: how much D* counts at each pixel.

    A prior without such a map has 1 where it is trusted and 0 elsewhere. Far pixels always have 0, since their depth is
    a lower bound and judges nothing.
    """
    if prior.reliability is None:
        return prior.trusted.to(torch.float32)
    return torch.where(prior.far, 0.0, prior.reliability)


@torch.no_grad()
def survey(
    splats: Splats,
    view: View,
    prior: DepthPrior,
    settings: RasterSettings,
    eps: float,
    near_edge: Tensor | None = None,
) -> Survey:
    """See `d2_plugin.rasterizer.survey`."""
    kept = visible(splats, None, view, settings)
    screen = project(_take(splats, kept), view, settings)
    empty = screen.depths.new_zeros
    weight, error, max_weight, front = (empty(len(splats.means)) for _ in range(4))
    hits = torch.zeros(len(splats.means), dtype=torch.int32, device=kept.device)
    depth_sum, alpha = empty(view.height, view.width), empty(view.height, view.width)
    r = reliability(prior).to(screen.depths)
    counts = r.isfinite() & (r > 0) & prior.depth.isfinite() & (prior.depth > 0)
    truth = torch.where(counts, prior.depth, 1).to(screen.depths)
    edge = None if near_edge is None else _known(near_edge, screen.depths)
    for y in range(0, view.height, TILE):
        for x in range(0, view.width, TILE):
            tile = (slice(y, y + TILE), slice(x, x + TILE))
            w, front_to_back = _tile_weights(screen, view, settings, x, y)
            depths, rows = screen.depths[front_to_back], kept[front_to_back]
            depth_sum[tile] = (w @ depths).reshape(depth_sum[tile].shape)
            alpha[tile] = w.sum(1).reshape(alpha[tile].shape)
            if not len(rows):
                continue
            max_weight[rows] = torch.maximum(max_weight[rows], w.amax(0))
            if edge is not None:
                front[rows] += (w * in_front(edge[tile], depths)).sum(0)
            here = counts[tile].flatten()
            hits[rows] += (w[here] > 0).sum(0, dtype=torch.int32)
            w, true = w[here] * r[tile].flatten()[here, None], truth[tile].flatten()[here, None]
            weight[rows] += w.sum(0)
            error[rows] += (w * (depths - true).abs() / (true + eps)).sum(0)
    return Survey(weight, error, max_weight, hits, depth_sum, alpha, front)


@torch.no_grad()
def visible(
    splats: Splats, colors: Tensor | None, view: View, settings: RasterSettings, screen_offsets: Tensor | None = None
) -> Tensor:
    """Indices [K] of the Gaussians that may touch the image, ascending.

    A Gaussian with a NaN or an infinity in any attribute, or in its projection, is left out; its neighbours are not
    affected. Chosen before any differentiable arithmetic, since 0 * inf would poison the gradients of the others.
    """
    attributes = [splats.means, splats.covariances, splats.opacities[:, None], colors, screen_offsets]
    finite = torch.cat([part for part in attributes if part is not None], 1).isfinite().all(1)
    depths = splats.means @ view.T_camera_world[2, :3].to(splats.means) + view.T_camera_world[2, 3].to(splats.means)
    kept = (finite & (depths > settings.near) & (splats.opacities >= settings.alpha_min)).nonzero()[:, 0]
    screen = project(_take(splats, kept), view, settings, None if screen_offsets is None else screen_offsets[kept])
    reach = screen.reach(settings.alpha_min)
    size = torch.tensor([view.width, view.height]).to(reach)
    touches = (screen.centers + reach > 0) & (screen.centers - reach < size) & reach.isfinite()
    return kept[touches.all(1)]


def project(splats: Splats, view: View, settings: RasterSettings, screen_offsets: Tensor | None = None) -> Projection:
    """Elliptical weighted average projection (Zwicker et al. 2001) of Gaussians in front of the camera.

    The Jacobian is taken at x/z and y/z clamped to `fov_clamp` half fields of view around the image centre, since the
    linearisation explodes beside the camera. Gradients are those of this very formula, outside the clamp too.
    """
    rotation, translation = view.T_camera_world[:3, :3].to(splats.means), view.T_camera_world[:3, 3].to(splats.means)
    K = view.K.to(splats.means)
    refuse_skew(float(view.K[0, 1]))
    focal, principal = torch.stack([K[0, 0], K[1, 1]]), K[:2, 2]
    size = torch.tensor([view.width, view.height]).to(K)
    points = splats.means @ rotation.T + translation
    depths = points[:, 2]
    slopes = points[:, :2] / depths[:, None]
    middle, half = (size / 2 - principal) / focal, settings.fov_clamp * size / (2 * focal)
    slopes_clamped = torch.minimum(torch.maximum(slopes, middle - half), middle + half)

    # Rows of J W: the gradient of the screen coordinate with respect to the world point.
    jacobian = (focal / depths[:, None])[..., None] * (rotation[:2] - slopes_clamped[..., None] * rotation[2])
    screen = jacobian @ covariance_matrices(splats.covariances) @ jacobian.mT
    floor = max(settings.blur, VARIANCE_FLOOR)
    own_x, own_y = screen[:, 0, 0].clamp(min=0), screen[:, 1, 1].clamp(min=0)
    variance_x, variance_y = own_x + floor, own_y + floor
    slope = screen[:, 0, 1] / variance_y
    given_y = (variance_x - slope * screen[:, 0, 1]).clamp(min=floor)
    centers = slopes * focal + principal
    if screen_offsets is not None:
        centers = centers + screen_offsets
    opacities = splats.opacities
    if settings.antialiased:
        opacities = opacities * _compensation(own_x, own_y, screen[:, 0, 1], floor)
    return Projection(centers, variance_x, variance_y, slope, given_y, depths, opacities)


def _compensation(own_x: Tensor, own_y: Tensor, covariance: Tensor, floor: float) -> Tensor:
    """sqrt(det S / det(S + floor I)) [K], the 2D filter of Mip-Splatting (Yu et al. 2024), of S without the blur: a
    Gaussian smaller than a pixel, which the blur makes larger, gets fainter by as much."""
    own = own_x * own_y - covariance.square()
    blurred = own.clamp(min=0) + floor * (own_x + own_y + floor)
    return (own / blurred).clamp(min=LEAST_AREA).sqrt()


def refuse_skew(skew: float) -> None:
    """Raise D2Error where K[0, 1] is not 0: the projection's Jacobian knows no skew, nor does any backbone's."""
    if skew != 0:
        raise D2Error(f"K has skew {skew}, expected 0: undistort the images to a pinhole camera without skew")


def _take(splats: Splats, index: Tensor) -> Splats:
    return Splats(splats.means[index], splats.covariances[index], splats.opacities[index], index)


def _tile_weights(screen: Projection, view: View, settings: RasterSettings, x: int, y: int) -> tuple[Tensor, Tensor]:
    """Compositing weights [P, K] at the pixels of the tile whose corner is (x, y), and who the K columns are."""
    columns = torch.arange(x, min(x + TILE, view.width)).to(screen.depths) + 0.5
    lines = torch.arange(y, min(y + TILE, view.height)).to(screen.depths) + 0.5
    front_to_back = _front_to_back(screen, settings, columns, lines)
    part = Projection(*(field[front_to_back] for field in screen))
    pixel_y, pixel_x = torch.meshgrid(lines, columns, indexing="ij")
    dx = pixel_x.reshape(-1, 1) - part.centers[:, 0]
    dy = pixel_y.reshape(-1, 1) - part.centers[:, 1]
    squared = (dx - part.slope * dy).square() / part.variance_x_given_y + dy.square() / part.variance_y
    unclamped = part.opacities * torch.exp(-0.5 * squared)
    return _composite(unclamped, settings), front_to_back


def _composite(unclamped: Tensor, settings: RasterSettings) -> Tensor:
    """Weights w [P, K] from o G [P, K], columns front to back."""
    alpha = torch.where(unclamped < settings.alpha_min, 0, unclamped)
    alpha = torch.where(alpha > settings.alpha_max, settings.alpha_max, alpha)
    finished = torch.cumprod(1 - alpha.detach(), 1) <= settings.transmittance_min
    # Hidden layers become transparent, so that no transmittance underflows to the 0 that cumprod cannot divide by.
    alpha = torch.where(finished, 0, alpha)
    after = torch.cumprod(1 - alpha, 1)
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], 1) if after.shape[1] else after
    return alpha * before


@torch.no_grad()
def _front_to_back(screen: Projection, settings: RasterSettings, columns: Tensor, lines: Tensor) -> Tensor:
    low = torch.stack([columns[0], lines[0]])
    high = torch.stack([columns[-1], lines[-1]])
    reach = screen.reach(settings.alpha_min) * (1 + 1e-6) + 1e-3
    touching = ((screen.centers + reach >= low) & (screen.centers - reach <= high)).all(1).nonzero()[:, 0]
    return touching[torch.sort(screen.depths[touching], stable=True).indices]
