"""`gsplat.rendering.rasterization` for pinhole cameras, and a `gsplat.csrc` that has nothing in it.

gsplat looks for its CUDA build when it is imported and starts a build of minutes where it finds a compiler; this module
in the place of `gsplat.csrc` prevents both. Everything of gsplat that is plain torch then works: its strategies, their
operations, its losses and its HexPlane.

    render [C, H, W, D], alpha [C, H, W, 1], meta = rasterization(means, quats, scales, opacities, colors, viewmats, Ks,
                                                                   width, height, ...)

`meta["means2d"]` receives dL/d(pixel) as its gradient, which is what `DefaultStrategy` adds up.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize

from d2_plugin.compat.inria import colors_of, covariances_of, screen_radii
from d2_plugin.errors import D2Error
from d2_plugin.protocol import RasterSettings, Render, Splats, View
from d2_plugin.rasterizer import rasterize

DEPTH_MODES = {"RGB": (True, None), "D": (False, "sum"), "ED": (False, "mean"), "RGB+D": (True, "sum")}
DEPTH_MODES["RGB+ED"] = (True, "mean")
"""By render mode: whether there are colours, and which depth comes behind them."""

NOT_HERE = ("absgrad", "sparse_grad", "distributed", "with_ut", "with_eval3d", "covars", "rays", "viewmats_rs")
"""Arguments that need gsplat's own kernels."""


def rasterization(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    backgrounds: Tensor | None = None,
    render_mode: str = "RGB",
    rasterize_mode: str = "classic",
    camera_model: str = "pinhole",
    **others: Any,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Draw C views of N Gaussians.

    Args:
        means, quats, scales, opacities: [N, 3], [N, 4] w first, [N, 3], [N].
        colors: [N, D] or [C, N, D]; with `sh_degree`, spherical harmonics [N, K, 3].
        viewmats, Ks: [C, 4, 4] world to camera, [C, 3, 3] pixels.
        width, height: of all views, pixels.
        near_plane, far_plane, radius_clip, eps2d: what is left out, and the blur in pixels squared.
        packed: whether `meta` lists the drawn Gaussians one after another, or holds all N of each view.
        backgrounds: [C, D].
        render_mode, rasterize_mode, camera_model: `RGB`, `D`, `ED`, `RGB+D`, `RGB+ED`; `classic` or `antialiased`;
            `pinhole`.
        others: what gsplat's kernels know besides; those of `NOT_HERE` are refused, the rest has no effect here.

    Raises:
        D2Error: something that this stand-in does not do.
    """
    _refuse(render_mode, camera_model, others)
    settings = RasterSettings(near=near_plane, blur=eps2d, antialiased=rasterize_mode == "antialiased")
    covariances = covariances_of(scales, normalize(quats), 1.0)
    views = [View("", 0, 0.0, pose.detach(), K.detach(), width, height) for pose, K in zip(viewmats, Ks)]
    gaussians = means, covariances, opacities, torch.arange(len(means), device=means.device)
    parts = [_drawn(Splats(*gaussians), view, settings, far_plane, radius_clip) for view in views]
    screen = _on_screen(parts, views, settings, len(means), packed)
    images, alphas = [], []
    for number, (splats, view) in enumerate(zip(parts, views)):
        shown = _colors(colors, sh_degree, means, view, number)[splats.rows]
        background = None if backgrounds is None else backgrounds[number]
        offsets = screen["offsets"][number, splats.rows]
        image = rasterize(splats, shown, view, settings, background=background, screen_offsets=offsets)
        images.append(_image(image, render_mode))
        alphas.append(image.alpha[..., None])
    meta = {"width": width, "height": height, "n_cameras": len(views), "n_batches": 1, **screen}
    return torch.stack(images), torch.stack(alphas), meta


def _refuse(render_mode: str, camera_model: str, others: dict[str, Any]) -> None:
    if render_mode not in DEPTH_MODES:
        raise D2Error(f"render_mode '{render_mode}' needs gsplat's kernels: have {', '.join(DEPTH_MODES)} without them")
    if camera_model != "pinhole":
        raise D2Error(f"camera_model '{camera_model}' needs gsplat's kernels: use pinhole cameras, or build gsplat")
    for name in NOT_HERE:
        if others.get(name) not in (None, False):
            raise D2Error(f"{name} of gsplat's rasterization needs its own kernels: leave it out, or build gsplat")


def _drawn(splats: Splats, view: View, settings: RasterSettings, far: float, radius_clip: float) -> Splats:
    forward = view.T_camera_world[2]
    depths = splats.means.detach() @ forward[:3] + forward[3]
    chosen = (depths > settings.near) & (depths < far)
    if radius_clip > 0:
        chosen &= screen_radii(splats, view, settings) > radius_clip
    rows = torch.nonzero(chosen).squeeze(-1)
    return Splats(*(field[rows] for field in splats))


def _colors(colors: Tensor, sh_degree: int | None, means: Tensor, view: View, number: int) -> Tensor:
    """[N, D] of one view."""
    if sh_degree is not None:
        pose = view.T_camera_world
        return colors_of(colors.to(means.dtype), sh_degree, means, -pose[:3, :3].T @ pose[:3, 3])
    return colors if colors.ndim == 2 else colors[number]


def _on_screen(
    parts: list[Splats], views: list[View], settings: RasterSettings, count: int, packed: bool
) -> dict[str, Any]:
    """What gsplat's strategies read: radii and centres, whose gradient is that of the offsets, in pixels."""
    like = parts[0].means
    radii = torch.zeros(len(views), count, 2, dtype=torch.int32, device=like.device)
    centres = like.new_zeros(len(views), count, 2)
    with torch.no_grad():
        for number, (splats, view) in enumerate(zip(parts, views)):
            radii[number, splats.rows] = screen_radii(splats, view, settings)[:, None].expand(-1, 2)
            centres[number, splats.rows] = _centres(splats.means, view)
    cameras = gaussians = None
    if packed:
        cameras, gaussians = torch.nonzero((radii > 0).all(-1), as_tuple=True)
        radii, chosen = radii[cameras, gaussians], centres[cameras, gaussians]
    else:
        chosen = centres
    chosen.requires_grad_(torch.is_grad_enabled())
    offsets = chosen - chosen.detach()
    if packed:
        offsets = torch.zeros_like(centres).index_put((cameras, gaussians), offsets)
    named = {"radii": radii, "means2d": chosen, "gaussian_ids": gaussians, "camera_ids": cameras}
    return named | {"offsets": offsets}


def _image(image: Render, render_mode: str) -> Tensor:
    """[H, W, D]: colours, and the depth that the mode asks for behind them."""
    has_color, depth = DEPTH_MODES[render_mode]
    parts = [image.color] if has_color else []
    if depth is not None:
        divided = image.depth_sum / image.alpha.clamp_min(1e-10)
        parts.append((image.depth_sum if depth == "sum" else divided)[..., None])
    return torch.cat(parts, -1)


def _centres(means: Tensor, view: View) -> Tensor:
    """Pixels [M, 2] of means [M, 3]."""
    camera = means @ view.T_camera_world[:3, :3].T.to(means) + view.T_camera_world[:3, 3].to(means)
    return (camera @ view.K.T.to(means))[:, :2] / camera[:, 2:]
