"""The photometric loss with its gradient, in `kernels/ssim.cpp`: one walk over the rows instead of ten convolutions.

Compiled at first use; runs on `torch.get_num_threads()` threads, and results are the same bits for any number of them.
"""

from __future__ import annotations

import ctypes
import functools
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from d2_plugin.compiler.kernels import load_kernel, structure
from d2_plugin.gaussians.native_slice import FLAGS, KERNELS, SHARED_HEADERS

_Call = structure(
    "int height width channels threads",
    "float ssim_weight window[11]",
    "pointer image target bytes gradient differences similarities",
)
"""d2::Photometric of kernels/ssim.cpp; a null gradient is not computed."""


@functools.cache
def library() -> Any:
    """The compiled kernel; None without a compiler."""
    results = {"d2_photometric": ctypes.c_double}
    return load_kernel("ssim", (KERNELS / "ssim.cpp",), SHARED_HEADERS, FLAGS, {"ssim": _Call}, results, optional=True)


def can_compare(image: Tensor, target: Tensor) -> bool:
    """Whether the kernel takes these images: float32 on the CPU, a fixed target, which may be bytes, and there is a
    compiler."""
    fit = image.dtype == torch.float32 and target.dtype in (torch.float32, torch.uint8)
    fit = fit and all(part.device.type == "cpu" for part in (image, target))
    same = image.ndim == 3 and image.shape == target.shape and image.numel() > 0
    return fit and same and not target.requires_grad and library() is not None


def native_photometric_loss(image: Tensor, target: Tensor, window: Tensor, ssim_weight: float) -> Tensor:
    """`photometric.photometric_loss` of float32 images [H, W, C] on the CPU, differentiable once by `image`.

    `window` [11] holds the weights of the blur, symmetric. A target of bytes stands for its numbers over 255.
    """
    if not torch.is_grad_enabled():
        image = image.detach()
    return _Photometric.apply(image, target, window.tolist(), ssim_weight)


class _Photometric(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, window: list[float], ssim_weight: float) -> Tensor:
        height, width, channels = image.shape
        image, target = image.contiguous(), target.contiguous()
        gradient = torch.empty_like(image) if ctx.needs_input_grad[0] else None
        sums = image.new_empty(2, height, dtype=torch.float64)
        call = _Call(height, width, channels, torch.get_num_threads(), ssim_weight, (ctypes.c_float * 11)(*window))
        call.point(image=image, gradient=gradient, differences=sums[0], similarities=sums[1])
        call.point(**{"bytes" if target.dtype == torch.uint8 else "target": target})
        loss = library().d2_photometric(call)
        ctx.save_for_backward(gradient)
        return image.new_full((), loss)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = ctx.saved_tensors
        # Multiplying costs as much as the blurs do, and the loss is usually the last thing computed.
        return gradient if upstream.item() == 1 else gradient * upstream, None, None, None
