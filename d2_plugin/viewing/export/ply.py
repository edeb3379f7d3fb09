"""The Gaussians of one instant as a 3DGS PLY; several that are dropped together play as an animation in SuperSplat."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from d2_plugin.durable import write
from d2_plugin.gaussians.moving import MovingGaussians
from d2_plugin.protocol import covariance_matrices
from d2_plugin.recordings.cameras.rotations import quaternion_of_rotation

ALPHA_MIN = 1 / 255
"""Gaussians that stay below this opacity are never drawn, and are left out of every format."""

ALPHA_MAX = 1 - 1e-6
"""Largest opacity that has a finite logit in float32."""

FLATTEST = 1e-12
"""Smallest eigenvalue written, relative to the largest: a flat covariance in float32 may have a negative one."""


def write_ply(path: Path, gaussians: MovingGaussians, shapes: tuple[Tensor, Tensor]) -> None:
    """Write Gaussians that stand still in the order of the Inria code base; all columns float32, little endian.

    Those below an opacity of 1/255 and those that are not finite are left out. `shapes` are the scales [M, 3] and
    quaternions [M, 4] of all of them."""
    coefficients = gaussians.harmonics.without_time()
    columns = {
        "x y z": gaussians.positions,
        "nx ny nz": torch.zeros_like(gaussians.positions),  # which readers expect and ignore
        "f_dc_0 f_dc_1 f_dc_2": coefficients[:, 0],
        # All of red, all of green, all of blue.
        " ".join(f"f_rest_{i}" for i in range(3 * (coefficients.shape[1] - 1))): coefficients[:, 1:].mT.flatten(1),
        "opacity": torch.logit(gaussians.opacities.clamp(max=ALPHA_MAX))[:, None],
        "scale_0 scale_1 scale_2": shapes[0].log(),
        "rot_0 rot_1 rot_2 rot_3": shapes[1],
    }
    rows = torch.cat(list(columns.values()), dim=1)
    rows = rows[torch.isfinite(rows).all(dim=1) & (gaussians.opacities >= ALPHA_MIN)]
    names = " ".join(columns).split()
    header = ["ply", "format binary_little_endian 1.0", "comment SplatRenderMode: default"]
    header += [f"element vertex {len(rows)}", *(f"property float {name}" for name in names), "end_header", ""]
    write(path, "\n".join(header).encode("ascii"), rows.float().numpy().astype("<f4").tobytes(), synced=False)


def scales_and_rotations(covariances: Tensor) -> tuple[Tensor, Tensor]:
    """Standard deviations [M, 3] and unit quaternions [M, 4] (w first) of covariances [M, 6].

    covariance = R diag(scales^2) R^T with R the rotation of the quaternion.
    """
    variances, axes = torch.linalg.eigh(covariance_matrices(covariances))
    floor = (FLATTEST * variances[:, 2:]).clamp(min=torch.finfo(variances.dtype).tiny)
    mirrored = torch.linalg.det(axes) < 0
    axes = torch.cat([torch.where(mirrored[:, None, None], -axes[..., :1], axes[..., :1]), axes[..., 1:]], dim=-1)
    return torch.maximum(variances, floor).sqrt(), torch.from_numpy(quaternion_of_rotation(axes.numpy()))
