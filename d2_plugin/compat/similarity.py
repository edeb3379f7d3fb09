"""`fused_ssim` (rahul-goel/fused-ssim), which 4C4D's loss imports."""

from __future__ import annotations

import torch
from torch import Tensor

from d2_plugin.errors import D2Error
from d2_plugin.gaussians.photometric import ssim


def fused_ssim(img1: Tensor, img2: Tensor, padding: str = "same", train: bool = True) -> Tensor:
    """Mean structural similarity of images [B, C, H, W] in 0..1, a scalar with gradients to both.

    Only `padding="same"`, zeros around the image, which is 3D Gaussian Splatting's. `train` changes nothing here.
    """
    if padding != "same":
        raise D2Error(f"fused_ssim with padding '{padding}' needs the original, this stand-in has 'same' only")
    return torch.stack([ssim(one.permute(1, 2, 0), other.permute(1, 2, 0)) for one, other in zip(img1, img2)]).mean()
