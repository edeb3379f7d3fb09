"""The Gaussians of one instant as a 3DGS PLY file, which viewers such as SuperSplat, Brush and SIBR open.

Files named `frame_00000.ply`, `frame_00001.ply`, ... that are dropped together play as an animation in SuperSplat; a
zip of them does in Brush.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from d2_plugin.durable import write
from d2_plugin.errors import D2Error
from d2_plugin.gaussians.spherical_harmonics import SH_C0
from d2_plugin.protocol import View

ALPHA_MIN = 1 / 255
"""Gaussians that never reach this opacity are not drawn by any rasterizer and are left out."""

ALPHA_MAX = 1 - 1e-6
"""Largest opacity that has a finite logit in float32."""

FLATTEST = 1e-12
"""Smallest eigenvalue written, relative to the largest: a flat covariance in float32 may have a negative one."""

ATTRIBUTES = (
    *("x", "y", "z", "nx", "ny", "nz"),
    *("f_dc_0", "f_dc_1", "f_dc_2"),
    "opacity",
    *("scale_0", "scale_1", "scale_2"),
    *("rot_0", "rot_1", "rot_2", "rot_3"),
)
"""Order of the Inria code base; all float32, little endian."""


def write_ply(
    path: Path,
    means: Tensor,
    covariances: Tensor,
    colors: Tensor,
    opacities: Tensor,
    harmonics: Tensor | None = None,
    moving: Mapping[str, Tensor] | None = None,
    comments: Sequence[str] = ("SplatRenderMode: default",),
    shapes: tuple[Tensor, Tensor] | None = None,
) -> int:
    """Write Gaussians as one row of float32 each; returns how many were written.

    Args:
        path: the file, which is replaced if it exists.
        means: [M, 3] world.
        covariances: [M, 6] xx xy xz yy yz zz, world.
        colors: [M, 3] in 0..1, as seen at this instant.
        opacities: [M] in 0..1 with the temporal factor F(t) included: it belongs inside the logit, not on top of it.
        harmonics: [M, C, 3] coefficients of the view-dependent colour without the constant one, C = 3, 8 or 15.
        moving: further columns [M] by name, for formats that are a PLY with more.
        comments: of the header.
        shapes: what `scales_and_rotations(covariances)` returns, where it is known already: it is what takes long.

    Gaussians below an opacity of 1/255 and those that are not finite are left out.
    """
    count = len(means)
    expected_shapes = {
        "covariances": (covariances, (count, 6)),
        "colors": (colors, (count, 3)),
        "opacities": (opacities, (count,)),
    }
    for name, (values, expected) in expected_shapes.items():
        if tuple(values.shape) != expected:
            raise D2Error(f"{name} of a PLY have shape {tuple(values.shape)}, expected {expected}: one row per mean")
    means, covariances, colors, opacities = (
        values.detach().double().cpu() for values in (means, covariances, colors, opacities)
    )
    rest = means.new_zeros(count, 0, 3) if harmonics is None else harmonics.detach().double().cpu()
    more = dict(moving or {})
    added = [rest.transpose(1, 2).flatten(1), *(values.detach().double().cpu()[:, None] for values in more.values())]
    finite = torch.isfinite(torch.cat([means, covariances, colors, opacities[:, None], *added], dim=1)).all(dim=1)
    kept = finite & (opacities >= ALPHA_MIN)
    if shapes is None:
        scales, quaternions = scales_and_rotations(covariances[kept])
    else:
        scales, quaternions = shapes[0][kept], shapes[1][kept]
    columns = [
        means[kept],
        torch.zeros_like(means[kept]),  # normals, which readers expect and ignore
        (colors[kept] - 0.5) / SH_C0,
        added[0][kept],  # all of red, all of green, all of blue
        torch.logit(opacities[kept].clamp(max=ALPHA_MAX))[:, None],
        scales.log(),
        quaternions,
        *(values[kept] for values in added[1:]),
    ]
    names = [*ATTRIBUTES[:9], *(f"f_rest_{i}" for i in range(3 * rest.shape[1])), *ATTRIBUTES[9:], *more]
    rows = torch.cat(columns, dim=1).float().numpy().astype("<f4")
    write(path, _header(len(rows), names, comments), np.ascontiguousarray(rows).tobytes(), synced=False)
    return len(rows)


def scales_and_rotations(covariances: Tensor) -> tuple[Tensor, Tensor]:
    """Standard deviations [M, 3] and unit quaternions [M, 4] (w first) of covariances [M, 6].

    covariance = R diag(scales^2) R^T with R the rotation of the quaternion.
    """
    xx, xy, xz, yy, yz, zz = covariances.unbind(-1)
    matrices = torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], dim=-1).reshape(-1, 3, 3)
    variances, axes = torch.linalg.eigh(matrices)
    floor = (FLATTEST * variances[:, 2:]).clamp(min=torch.finfo(variances.dtype).tiny)
    mirrored = torch.linalg.det(axes) < 0
    axes = torch.cat([torch.where(mirrored[:, None, None], -axes[..., :1], axes[..., :1]), axes[..., 1:]], dim=-1)
    return torch.maximum(variances, floor).sqrt(), _quaternions(axes)


def _quaternions(rotations: Tensor) -> Tensor:
    """Unit quaternions [M, 4], w first, of rotation matrices [M, 3, 3].

    The four products of a component with the whole quaternion are linear in the matrix; the one with the largest
    component loses no digits.
    """
    (a, b, c), (d, e, f), (g, h, i) = (row.unbind(-1) for row in rotations.unbind(-2))
    products = torch.stack(
        [
            torch.stack([1 + a + e + i, h - f, c - g, d - b], dim=-1),
            torch.stack([h - f, 1 + a - e - i, b + d, c + g], dim=-1),
            torch.stack([c - g, b + d, 1 - a + e - i, f + h], dim=-1),
            torch.stack([d - b, c + g, f + h, 1 - a - e + i], dim=-1),
        ],
        dim=-2,
    )
    largest = products.diagonal(dim1=-2, dim2=-1).argmax(dim=-1)
    chosen = products[torch.arange(len(products)), largest]
    return chosen / chosen.norm(dim=-1, keepdim=True)


def _header(count: int, names: Sequence[str], comments: Sequence[str]) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments)]
    lines += [f"element vertex {count}", *(f"property float {name}" for name in names)]
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii")


def write_frames(model: Any, views: Sequence[View], folder: Path) -> list[Path]:
    """One file per view, frame_00000.ply and so on: the Gaussians of a bundled backbone at that instant."""
    paths = []
    for view in views:
        with torch.no_grad():
            splats = model.slice_at(view)
            colors = model.colors(view, splats)
        paths.append(folder / f"frame_{view.frame:05d}.ply")
        write_ply(paths[-1], splats.means, splats.covariances, colors, splats.opacities)
    return paths
