"""Differentiable splatting with depth and alpha, and the survey of compositing weights.

    from d2_plugin.rasterizer import RasterSettings, Splats, View, rasterize

    render = rasterize(splats, colors, view)                       # color, depth_sum, alpha: all with gradients
    render = rasterize(splats, colors, view, near_edge=edge)       # and front: the weight in space that must be free
    statistics = survey(splats, view, prior)                       # per Gaussian: what the depth prior says about it

float32 runs in kernels that are compiled at first use: on the CPU (`native`, `d2_plugin.compiler`) or on the GPU
(`cuda`, by NVRTC), wherever the Gaussians are. float64 runs in `reference`.
"""

from __future__ import annotations

import torch
from torch import Tensor

from d2_plugin.errors import D2Error
from d2_plugin.protocol import DepthPrior, RasterSettings, Render, Splats, Survey, View
from d2_plugin.rasterizer import autograd, native, reference

__all__ = ["DepthPrior", "RasterSettings", "Render", "Splats", "Survey", "View", "rasterize", "survey"]


def rasterize(
    splats: Splats,
    colors: Tensor,
    view: View,
    settings: RasterSettings = RasterSettings(),  # noqa: B008  a frozen value
    *,
    background: Tensor | None = None,
    screen_offsets: Tensor | None = None,
    near_edge: Tensor | None = None,
) -> Render:
    """Composite Gaussians front to back into color, accumulated depth and alpha.

    With a near edge D_near also into front(p) = sum_i w_i max(0, 1 - z_i / D_near(p)), which is 0 where no Gaussian
    stands in the space that is known to be free and approaches alpha as they all come to the camera.

    Args:
        splats: M Gaussians in the world, float32 or float64; M may be 0. `splats.rows` is not used.
        colors: [M, C], any C >= 1, e.g. RGB in 0..1 or features.
        view: camera; no gradient flows to it, `K` must have no skew.
        settings: constants, in units named there.
        background: [C] seen through what the Gaussians leave transparent; None is black.
        screen_offsets: [M, 2] pixels added to the projected centres. Pass zeros that require gradients to receive
            dL/d(screen mean) as their gradient, which densification accumulates ("viewspace points").
        near_edge: [H, W] of any floating dtype, in units of depth: D_near, e.g. `DepthPrior.near_edge(k)`. Nothing is
            known, and front is 0, where it is not positive or not finite. No gradient flows to it. None costs nothing.

    Returns:
        `Render` with gradients to means, covariances, opacities, colors, background and screen_offsets; its `front` is
        None without a near edge. The gradient of a covariance's off-diagonal entry is that of the stored number, which
        stands for both places in the matrix. Front has the gradient 0 with respect to a Gaussian exactly at the edge.

    A Gaussian with a NaN or an infinity in any attribute is left out, with zero gradient; the others are not affected.

    Raises:
        D2Error: shapes, dtypes or devices do not fit together.
    """
    _check(splats, view, settings, colors=colors, background=background, screen_offsets=screen_offsets)
    _check_maps(view, None, near_edge)
    path = autograd if _has_kernels(splats.means) else reference
    return path.rasterize(splats, colors, view, settings, background, screen_offsets, near_edge)


@torch.no_grad()
def survey(
    splats: Splats,
    view: View,
    prior: DepthPrior,
    settings: RasterSettings = RasterSettings(),  # noqa: B008  a frozen value
    *,
    eps: float = 1e-8,
    near_edge: Tensor | None = None,
) -> Survey:
    """Gather the compositing weights w_{k,q} of one view per Gaussian k, without gradients.

    A pixel counts with its reliability r: `DepthPrior.reliability`, or 1 where the prior is trusted (Omega^v, and what
    two cameras agree on) and 0 elsewhere. Far pixels never count, nor do those whose depth is not finite and positive.

    Args:
        prior: D*, its labels and its reliability, of the view's size.
        settings: constants; the same as in `rasterize` give the same weights.
        eps: epsilon of |z - D*| / (D* + eps), in units of depth.
        near_edge: [H, W], as in `rasterize`; far pixels count here.

    Raises:
        D2Error: shapes, dtypes or devices do not fit together.
    """
    _check(splats, view, settings)
    _check_maps(view, prior, near_edge)
    path = autograd if _has_kernels(splats.means) else reference
    return path.survey(splats, view, prior, settings, eps, near_edge)


MOST_IN_TORCH = 200_000
"""Gaussians that plain torch draws in float32: it holds every pixel of a row of tiles times every Gaussian there."""


def _has_kernels(means: Tensor) -> bool:
    """Whether kernels run on the device of `means`: on a GPU or the CPU, in float32, where they can be compiled."""
    if means.dtype != torch.float32:
        return False
    if means.device.type == "cuda":
        from d2_plugin.rasterizer import cuda  # a trainer on the CPU loads none of it

        there = cuda.available(means.device)
    else:
        there = means.device.type == "cpu" and native.available()
    if not there and len(means) > MOST_IN_TORCH:
        raise D2Error(
            f"{len(means)} Gaussians on {means.device} and no compiled kernels: plain torch draws at most "
            f"{MOST_IN_TORCH} before memory runs out; the warning before this says what to install"
        )
    return there


def _check(splats: Splats, view: View, settings: RasterSettings, **extra: Tensor | None) -> None:
    """Refuse what the kernels, which trust their pointers, could not survive."""
    count = splats.means.shape[0]
    expected: dict[str, tuple[Tensor, tuple[int, ...]]] = {
        "means": (splats.means, (count, 3)),
        "covariances": (splats.covariances, (count, 6)),
        "opacities": (splats.opacities, (count,)),
    }
    if (colors := extra.get("colors")) is not None:
        channels = colors.shape[-1] if colors.ndim == 2 else 0
        expected["colors"] = (colors, (count, max(channels, 1)))
        if (background := extra["background"]) is not None:
            expected["background"] = (background, (channels,))
        if (screen_offsets := extra["screen_offsets"]) is not None:
            expected["screen_offsets"] = (screen_offsets, (count, 2))
    for name, (tensor, shape) in expected.items():
        if tensor.shape != shape:
            raise D2Error(f"{name} has shape {tuple(tensor.shape)}, expected {shape} for {count} Gaussians")
        if tensor.dtype != splats.means.dtype or tensor.dtype not in (torch.float32, torch.float64):
            raise D2Error(f"{name} is {tensor.dtype}, expected one dtype for all, float32 or float64: convert it")
        if tensor.device != splats.means.device:
            raise D2Error(f"{name} is on {tensor.device} but means is on {splats.means.device}: move it there")
    if not (1 <= view.width <= 65535 and 1 <= view.height <= 65535):
        raise D2Error(f"view is {view.width}x{view.height} pixels, expected 1 to 65535 each way")
    if view.T_camera_world.shape != (4, 4) or view.K.shape != (3, 3):
        pose, K = tuple(view.T_camera_world.shape), tuple(view.K.shape)
        raise D2Error(f"T_camera_world has shape {pose} and K {K}, expected (4, 4) and (3, 3)")
    if not (settings.near > 0 and settings.alpha_min > 0 and 0 < settings.alpha_max < 1):
        raise D2Error(f"{settings} needs near > 0, alpha_min > 0 and 0 < alpha_max < 1: a division by zero otherwise")


def _check_maps(view: View, prior: DepthPrior | None, near_edge: Tensor | None) -> None:
    """Refuse maps of another size than the view's, and a near edge that holds no floating-point numbers."""
    maps = {} if prior is None else {"depth": prior.depth, "labels": prior.labels, "reliability": prior.reliability}
    size = (view.height, view.width)
    for name, part in maps.items():
        if part is not None and part.shape != size:
            raise D2Error(
                f"the prior of camera '{view.camera}' has {name} {tuple(part.shape)} but the view is {size}: "
                "resample it to the view's height and width"
            )
    if near_edge is not None and near_edge.shape != size:
        raise D2Error(f"near_edge has shape {tuple(near_edge.shape)}, expected {size} as the view has pixels")
    if near_edge is not None and not near_edge.is_floating_point():
        raise D2Error(f"near_edge is {near_edge.dtype}, expected floating-point depths: convert it")
