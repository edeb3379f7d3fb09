"""Reading 3DGS PLY files back: what was written is held against what a viewer finds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from d2_plugin.errors import D2Error
from d2_plugin.gaussians.moving import Harmonics, MovingGaussians
from d2_plugin.gaussians.rotation4d import covariances_from_factors, normalized_quaternions, rotation_matrices_3d

END = b"end_header\n"


def read_columns(path: Path) -> dict[str, np.ndarray]:
    """The float columns of a binary little-endian PLY by their names.

    Raises:
        D2Error: another kind of PLY, or none.
    """
    data = path.read_bytes()
    end = data.find(END)
    if not data.startswith(b"ply\nformat binary_little_endian 1.0\n") or end < 0:
        raise D2Error(f"{path} is no binary little-endian PLY: export it anew")
    lines = data[:end].decode("ascii", "replace").splitlines()
    names = [line.split()[2] for line in lines if line.startswith("property float ")]
    rows = np.frombuffer(data[end + len(END) :], [(name, "<f4") for name in names])
    return {name: rows[name] for name in names}


def still_gaussians(columns: dict[str, np.ndarray]) -> MovingGaussians:
    """The Gaussians of such columns."""
    colors = _stacked(columns, ("f_dc_0", "f_dc_1", "f_dc_2"))[:, None]
    rest = _stacked(columns, [name for name in columns if name.startswith("f_rest_")])
    coefficients = torch.cat([colors, rest.unflatten(1, (3, rest.shape[1] // 3)).transpose(1, 2)], 1)
    scales = _stacked(columns, ("scale_0", "scale_1", "scale_2")).exp()
    rotations = _stacked(columns, ("rot_0", "rot_1", "rot_2", "rot_3"))
    opacities = torch.sigmoid(_stacked(columns, ("opacity",))[:, 0])
    harmonics = Harmonics(coefficients, round(coefficients.shape[1] ** 0.5) - 1)
    return MovingGaussians(
        _stacked(columns, ("x", "y", "z")), covariances_from(scales, rotations), opacities, harmonics
    )


def covariances_from(scales: Tensor, rotations: Tensor) -> Tensor:
    """Covariances [M, 6] of standard deviations [M, 3] along the axes of quaternions [M, 4], w first."""
    return covariances_from_factors(rotation_matrices_3d(normalized_quaternions(rotations.T)) * scales.T)


def _stacked(columns: dict[str, np.ndarray], names: list[str] | tuple[str, ...]) -> Tensor:
    count = len(next(iter(columns.values())))
    if not names:
        return torch.zeros(count, 0).double()
    return torch.from_numpy(np.stack([columns[name] for name in names], -1).astype(np.float64))
