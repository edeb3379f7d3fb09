"""The photometric loss that all backbones share: 0.8 L1 + 0.2 D-SSIM."""

from __future__ import annotations

from functools import lru_cache

import torch
import torch.nn.functional as F
from torch import Tensor

from d2_plugin.gaussians.native_ssim import can_compare, native_photometric_loss


@lru_cache(maxsize=8)
def _window(device: torch.device, dtype: torch.dtype) -> Tensor:
    """Gaussian window of 11 taps, sigma 1.5 pixels, summing to one."""
    x = torch.arange(11, dtype=torch.float64) - 5
    weights = torch.exp(-(x**2) / (2 * 1.5**2))
    return (weights / weights.sum()).to(device=device, dtype=dtype)


def _blur(maps: Tensor) -> Tensor:
    """Separable Gaussian blur of [K, H, W] with zero padding (depthwise: twenty times faster on a CPU than a batch)."""
    count = len(maps)
    window = _window(maps.device, maps.dtype)
    rows = F.conv2d(maps[None], window.expand(count, 1, 1, 11), padding=(0, 5), groups=count)
    return F.conv2d(rows, window[:, None].expand(count, 1, 11, 1), padding=(5, 0), groups=count)[0]


def ssim(a: Tensor, b: Tensor) -> Tensor:
    """Structural similarity of images [H, W, 3] in 0..1 as 3D Gaussian Splatting defines it (11x11 Gaussian window)."""
    return ssim_map(a, b).mean()


def ssim_map(a: Tensor, b: Tensor) -> Tensor:
    """The same pixel by pixel, [3, H, W]."""
    a, b = a.permute(2, 0, 1), b.permute(2, 0, 1)
    k = len(a)
    mean_a, mean_b, aa, bb, ab = _blur(torch.cat([a, b, a * a, b * b, a * b])).split(k)
    variance_a, variance_b, covariance = aa - mean_a**2, bb - mean_b**2, ab - mean_a * mean_b
    c1, c2 = 0.01**2, 0.03**2
    similarity = (2 * mean_a * mean_b + c1) * (2 * covariance + c2)
    return similarity / ((mean_a**2 + mean_b**2 + c1) * (variance_a + variance_b + c2))


def photometric_loss(image: Tensor, target: Tensor, ssim_weight: float = 0.2, weights: Tensor | None = None) -> Tensor:
    """(1 - w) mean |image - target| + w (1 - SSIM) for images [H, W, 3] in 0..1.

    The target may be uint8, 0..255: an image as it is kept.

    `weights` [H, W] in 0..1 multiply both terms pixel by pixel before the mean over all pixels; where they are 0 the
    target counts for nothing, nor does it in a window of SSIM that reaches over. What a pixel of weight 1 pulls does
    not depend on how many others there are, so that densification keeps its thresholds.

    float32 on the CPU with a fixed target runs in a kernel, where there is a compiler and there are no weights.
    """
    if weights is not None:
        return weighted_photometric_loss(image, as_numbers(target).to(image.dtype), ssim_weight, weights)
    if ssim_weight and can_compare(image, target):
        return native_photometric_loss(image, target, _window(image.device, image.dtype), ssim_weight)
    return reference_photometric_loss(image, as_numbers(target).to(image.dtype), ssim_weight)


def as_numbers(image: Tensor) -> Tensor:
    """An image in 0..1: bytes divided by 255, in float32; what is numbers already stays as it is."""
    return image.float() / 255 if image.dtype == torch.uint8 else image


def reference_photometric_loss(image: Tensor, target: Tensor, ssim_weight: float = 0.2) -> Tensor:
    """The same in torch: any dtype and device, and the oracle of the kernel."""
    loss = (1 - ssim_weight) * torch.abs(image - target).mean()
    return loss + ssim_weight * (1 - ssim(image, target)) if ssim_weight else loss


def weighted_photometric_loss(image: Tensor, target: Tensor, ssim_weight: float, weights: Tensor) -> Tensor:
    """`photometric_loss` with `weights` [H, W]."""
    target = torch.where((weights > 0)[..., None], target, image.detach())
    loss = (1 - ssim_weight) * (torch.abs(image - target) * weights[..., None]).mean()
    return loss + ssim_weight * ((1 - ssim_map(image, target)) * weights).mean() if ssim_weight else loss
