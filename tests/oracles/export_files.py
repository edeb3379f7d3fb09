"""Readers of what `d2 export` writes, as other programs read it: the oracles of its writers."""

import base64
import gzip
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from d2_plugin.gaussians.moving import Harmonics, MovingGaussians
from d2_plugin.gaussians.rotation4d import (
    covariances_from_factors,
    normalized_quaternions,
    rotation_matrices_3d,
    temporal_marginal,
)
from d2_plugin.gaussians.slicing import MARGINAL_CUT
from d2_plugin.protocol import Splats
from d2_plugin.viewing.checkpoints import read_ply
from d2_plugin.viewing.checkpoints.files import columns
from d2_plugin.viewing.export.keys import Keys, Offset, State


def splats_at(moving: MovingGaussians, time: float) -> Splats:
    """The 3D Gaussians of one instant, without those whose temporal factor is not above `MARGINAL_CUT`."""
    rows = torch.arange(len(moving))
    if moving.motion is None:
        return Splats(moving.positions, moving.covariances, moving.opacities, rows)
    offset = time - moving.motion.times
    factor = temporal_marginal(offset, moving.motion.sigmas**2)
    means = moving.positions + moving.motion.velocities * offset[:, None]
    kept = factor > MARGINAL_CUT
    return Splats(means[kept], moving.covariances[kept], (moving.opacities * factor)[kept], rows[kept])


class ReadPage:
    """A model of a page, decoded as player/scene.js does."""

    def __init__(self, path: Path, model: int = 0) -> None:
        header, data = (
            re.search(rf'<script id="{name}" type="[^"]*">(.*?)</script>', path.read_text(), re.DOTALL).group(1)
            for name in ("header", "data")
        )
        self.header: dict[str, Any] = json.loads(header)
        self.raw = gzip.decompress(base64.b64decode(data))
        self.model: dict[str, Any] = self.header["models"][model]
        self.arrays = {entry["name"]: _tensor(self._decoded(self.raw, entry)) for entry in self.model["arrays"]}

    def _decoded(self, raw: bytes, entry: dict[str, Any]) -> np.ndarray:
        rows, columns_, block = entry["rows"], entry["columns"], self.header["block"]
        blocks, bytes_ = -(-rows // block), 2 if entry["bits"] > 8 else 1
        ranges = np.frombuffer(raw, "<f4", blocks * columns_ * 2, entry["offset"]).reshape(blocks, columns_, 2)
        start = entry["offset"] + ranges.nbytes
        planes = np.frombuffer(raw, np.uint8, rows * columns_ * bytes_, start).reshape(columns_, bytes_, rows)
        codes = (planes.astype(np.float64) * (256.0 ** np.arange(bytes_)[::-1])[:, None]).sum(1)
        low, high = ranges[np.arange(rows) // block].astype(np.float64).transpose(2, 0, 1)
        return low + codes.T * (high - low) / (2 ** entry["bits"] - 1)

    @property
    def coefficients(self) -> Tensor:
        parts = [self.arrays[name] for name in ("colors", "harmonics") if name in self.arrays]
        return torch.cat(parts, 1).unflatten(1, (-1, 3))

    def at(self, time: float) -> State:
        """The Gaussians that the player draws at `time`, opacity 0 for those that it does not draw."""
        start, motion, duration = self._state(""), self.model["motion"], self.header["duration"]
        if motion == "keys":
            times = self.model["keys"]
            states = tuple(self._state(f"_{i}") for i in range(len(times)))
            rows, moving = torch.arange(len(start.positions)), len(states[0].positions)
            return Keys(tuple(times), start, rows, moving, len(states[0].factors), states, Offset(0, 0)).at(time)
        if motion == "none":
            return start
        times, sigmas = self.arrays["fading"][:, 0], self.arrays["fading"][:, 1].exp()
        spans = (self.header["marginal_reach"] * sigmas).clamp(max=duration)
        velocities = self.arrays["reaches"] / spans.clamp(min=1e-30)[:, None]
        factor = torch.exp(-0.5 * ((time - times) / sigmas) ** 2)
        opacities = torch.where(factor > MARGINAL_CUT, start.opacities * factor, 0)
        positions = start.positions + velocities * (time - times.clamp(0, duration))[:, None]
        return State(positions, start.factors, opacities)

    def _state(self, suffix: str) -> State:
        positions = self.arrays[f"positions{suffix}"]
        if f"shapes{suffix}" not in self.arrays:
            return State(positions, positions.new_zeros(0, 6), positions.new_zeros(0))
        shapes = self.arrays[f"shapes{suffix}"]
        return State(positions, shapes[:, :1].exp() * shapes[:, 1:], self.arrays[f"opacities{suffix}"][:, 0])


def read_still_ply(path: Path) -> MovingGaussians:
    rows = read_ply(path)
    rest = columns(rows, "f_rest")
    rest = rest.unflatten(1, (3, rest.shape[1] // 3)).transpose(1, 2)
    coefficients = torch.cat([columns(rows, "f_dc")[:, None], rest], 1).double()
    covariances = covariances_from(columns(rows, "scale").double().exp(), columns(rows, "rot").double())
    harmonics = Harmonics(coefficients, round(coefficients.shape[1] ** 0.5) - 1)
    return MovingGaussians(columns(rows, "xyz").double(), covariances, rows["opacity"].double().sigmoid(), harmonics)


def covariances_from(scales: Tensor, rotations: Tensor) -> Tensor:
    """Covariances [M, 6] of standard deviations [M, 3] along the axes of quaternions [M, 4], w first."""
    return covariances_from_factors(rotation_matrices_3d(normalized_quaternions(rotations.T)) * scales.T)


def covariances_of(factors: Tensor) -> Tensor:
    """Covariances [M, 6] xx xy xz yy yz zz of factors [M, 6]."""
    a, b, c, d, e, f = factors.unbind(-1)
    return torch.stack([a * a, a * b, a * c, b * b + d * d, b * c + d * e, c * c + e * e + f * f], -1)


def _tensor(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, np.float64))
