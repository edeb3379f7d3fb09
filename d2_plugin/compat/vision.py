"""What trainers call of torchvision on their way through a training, of `fused_ssim`, and of packages for LPIPS.

torchvision has to match torch to the last digit of its build, which is why it is so often missing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from d2_plugin.errors import D2Error
from d2_plugin.gaussians.photometric import ssim


def make_grid(tensor: Tensor | Sequence[Tensor], nrow: int = 8, padding: int = 2, **_: Any) -> Tensor:
    """Images [B, C, H, W], or a list, side by side on black, `nrow` to a row; [C, H', W']. One stays as it is."""
    images = tensor if isinstance(tensor, Tensor) else torch.stack(list(tensor))
    if images.ndim < 4:
        images = images.reshape(1, -1, *images.shape[-2:])
    if len(images) == 1:
        return images[0]
    count, channels, height, width = images.shape
    columns = min(nrow, count)
    rows = math.ceil(count / columns)
    grid = images.new_zeros(channels, rows * (height + padding) + padding, columns * (width + padding) + padding)
    for index, image in enumerate(images):
        top, left = (padding + place * (size + padding) for place, size in zip(divmod(index, columns), (height, width)))
        grid[:, top : top + height, left : left + width] = image
    return grid


def save_image(tensor: Tensor, fp: str | Path, **options: Any) -> None:
    """One image in 0..1, or a grid of several, as a file."""
    from PIL import Image

    values = (make_grid(tensor, **options).detach().cpu().clamp(0, 1) * 255 + 0.5).byte().permute(1, 2, 0).numpy()
    Image.fromarray(values[..., 0] if values.shape[-1] == 1 else np.ascontiguousarray(values)).save(fp)


def resize(img: Tensor, size: Sequence[int], interpolation: Any = None, antialias: bool = True, **_: Any) -> Tensor:
    """Images [..., C, H, W] at `size` (height, width), bilinear."""
    batch = img.reshape(-1, *img.shape[-3:])
    return interpolate(batch, tuple(size), mode="bilinear", antialias=antialias).reshape(*img.shape[:-2], *size)


class ToTensor:
    """A PIL image or an array [H, W, C] uint8 as float [C, H, W] in 0..1."""

    def __call__(self, pic: Any) -> Tensor:
        """The tensor."""
        values = np.array(pic)
        values = values[..., None] if values.ndim == 2 else values
        tensor = torch.from_numpy(np.ascontiguousarray(values)).permute(2, 0, 1).contiguous()
        return tensor.float() / 255 if tensor.dtype == torch.uint8 else tensor


class ToPILImage:
    """4DGaussians makes one (scene/dataset_readers.py:403) and calls it nowhere."""


class NoLpips(torch.nn.Module):
    """In the place of torchmetrics' LPIPS, whose networks come with torchvision: NaN for any pair."""

    def __init__(self, *_: Any, **__: Any) -> None:
        super().__init__()

    def forward(self, drawn: Tensor, true: Tensor) -> Tensor:
        """NaN: it was not measured."""
        return drawn.new_tensor(math.nan)


def lpips(x: Tensor, y: Tensor, net_type: str = "alex", version: str = "0.1") -> Tensor:
    """In the place of the module `lpipsPyTorch` of a repository, whose networks are downloaded: NaN for any pair."""
    return x.new_tensor(math.nan)


def fused_ssim(img1: Tensor, img2: Tensor, padding: str = "same", train: bool = True) -> Tensor:
    """Mean SSIM of images [B, C, H, W] in 0..1, a scalar with gradients to both (rahul-goel/fused-ssim, for 4C4D).

    Only `padding="same"`, zeros around the image, which is 3D Gaussian Splatting's. `train` changes nothing here.
    """
    if padding != "same":
        raise D2Error(f"fused_ssim with padding '{padding}' needs the original, this stand-in has 'same' only")
    return torch.stack([ssim(one.permute(1, 2, 0), other.permute(1, 2, 0)) for one, other in zip(img1, img2)]).mean()
