"""Readers of what `d2 export` writes, as other programs read it: the oracles of its writers."""

from __future__ import annotations

import base64
import gzip
import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from d2_plugin.gaussians.moving import Harmonics, LinearMotion, MovingGaussians
from d2_plugin.gaussians.rotation4d import covariances_from_factors, normalized_quaternions, rotation_matrices_3d
from d2_plugin.gaussians.slicing import MARGINAL_CUT
from d2_plugin.gaussians.spherical_harmonics import SH_C0
from d2_plugin.viewing.checkpoints import read_ply
from d2_plugin.viewing.checkpoints.files import columns
from d2_plugin.viewing.export.keys import ALPHA_MIN, Keys, Offset, State, cholesky, distance
from d2_plugin.viewing.export.scene import ExportScene
from d2_plugin.viewing.export.splatv import MAGIC, ROW
from d2_plugin.viewing.export.spz import FLIPS, HEADER


class ReadPage:
    """The scene of a page, decoded as player/scene.js does."""

    def __init__(self, path: Path) -> None:
        header, data = (
            re.search(rf'<script id="{name}" type="[^"]*">(.*?)</script>', path.read_text(), re.DOTALL).group(1)
            for name in ("header", "data")
        )
        self.header: dict[str, Any] = json.loads(header)
        raw = gzip.decompress(base64.b64decode(data))
        self.arrays = {entry["name"]: _tensor(self._decoded(raw, entry)) for entry in self.header["arrays"]}
        self.bits = {entry["name"]: entry["bits"] for entry in self.header["arrays"]}

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
        """Of the colours, [N, C, 3]."""
        parts = [self.arrays[name] for name in ("colors", "harmonics") if name in self.arrays]
        return torch.cat(parts, 1).unflatten(1, (-1, 3))

    def at(self, time: float) -> State:
        """The Gaussians that the player draws at `time`, opacity 0 for those that it does not draw."""
        start, motion, duration = self._state(""), self.header["motion"], self.header["duration"]
        if motion == "keys":
            keys = self.header["keys"]
            states = tuple(self._state(f"_{i}") for i in range(len(keys["times"])))
            rows = torch.arange(len(start.positions))
            parts = keys["moving"], keys["changing"], states, Offset(0, 0, 0)
            return Keys(tuple(keys["times"]), start, rows, *parts).at(time)
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
    """The Gaussians of a 3DGS PLY."""
    rows = read_ply(path)
    rest = columns(rows, "f_rest")
    rest = rest.unflatten(1, (3, rest.shape[1] // 3)).transpose(1, 2)
    coefficients = torch.cat([columns(rows, "f_dc")[:, None], rest], 1).double()
    covariances = covariances_from(columns(rows, "scale").double().exp(), columns(rows, "rot").double())
    harmonics = Harmonics(coefficients, round(coefficients.shape[1] ** 0.5) - 1)
    return MovingGaussians(columns(rows, "xyz").double(), covariances, rows["opacity"].double().sigmoid(), harmonics)


def read_splatv(path: Path, duration: float) -> MovingGaussians:
    """The Gaussians of a .splatv on straight lines, without the rows of padding, which have no opacity."""
    data = path.read_bytes()
    magic, length = np.frombuffer(data[:8], "<u4")
    assert magic == MAGIC
    rows = np.frombuffer(data[8 + int(length) :], ROW)
    rows = rows[rows["color"][:, 3] > 0]
    parts = {name: _tensor(rows[name]) for name in rows.dtype.names or ()}
    times, widths = parts["fading"].unbind(-1)
    motion = LinearMotion(parts["motion"][:, :3] / duration, times * duration, widths * duration / math.sqrt(2))
    coefficients = ((parts["color"][:, None, :3] / 255) - 0.5) / SH_C0
    covariances = covariances_from(parts["scale"], parts["rotation"])
    return MovingGaussians(
        parts["position"], covariances, parts["color"][:, 3] / 255, Harmonics(coefficients, 0), motion
    )


def read_spz(path: Path) -> MovingGaussians:
    """The Gaussians of an SPZ of version 3."""
    raw = gzip.decompress(path.read_bytes())
    header = np.frombuffer(raw[: HEADER.itemsize], HEADER)
    count, (degree, bits, _, _) = int(header["count"][0]), header["rest"][0].tolist()
    terms = (degree + 1) ** 2 - 1
    sizes = {"position": 9, "opacity": 1, "color": 3, "scale": 3, "rotation": 4, "harmonics": 3 * terms}
    planes, offset = {}, HEADER.itemsize
    for name, size in sizes.items():
        planes[name] = np.frombuffer(raw, np.uint8, size * count, offset).reshape(count, size).astype(np.int64)
        offset += size * count
    fixed = (planes["position"].reshape(count, 3, 3) << np.array([0, 8, 16])).sum(2)
    positions = (fixed - ((fixed >> 23) << 24)) / 2**bits * (1, -1, -1)
    rotations = _quaternions(planes["rotation"].astype(np.uint8).reshape(-1).view("<u4"))
    more = (planes["harmonics"].reshape(count, terms, 3) - 128) / 128 * FLIPS[:terms, None]
    coefficients = np.concatenate([((planes["color"] / 255 - 0.5) / 0.15)[:, None], more], 1)
    covariances = covariances_from(_tensor(np.exp(planes["scale"] / 16 - 10)), _tensor(rotations))
    opacities = _tensor(planes["opacity"][:, 0] / 255)
    return MovingGaussians(_tensor(positions), covariances, opacities, Harmonics(_tensor(coefficients), degree))


def _quaternions(words: np.ndarray) -> np.ndarray:
    """Unit quaternions [M, 4], w first, in our axes, of SPZ's smallest three."""
    words, xyzw = words.copy(), np.zeros((len(words), 4))
    largest = words >> 30
    for axis in range(3, -1, -1):
        other = largest != axis
        size = (words & 511) / 511 / np.sqrt(2) * np.where(words >> 9 & 1, -1, 1)
        xyzw[:, axis] = np.where(other, size, 0)
        words = np.where(other, words >> 10, words)
    xyzw[np.arange(len(xyzw)), largest] = np.sqrt(np.maximum(1 - (xyzw**2).sum(1), 0))
    return (xyzw * (1, -1, -1, 1))[:, [3, 0, 1, 2]]


def pixels_apart(scene: ExportScene, true: MovingGaussians, read: MovingGaussians) -> Offset:
    """How far off what was read is, in pixels of the nearest training camera, the most over the clip."""
    worst = torch.zeros(len(true)).double()
    for time in scene.seconds[:: max(len(scene.seconds) // 4, 1)]:
        here, there = state_of(true, time), state_of(read, time)
        off = distance(torch.cat(here[:2], 1), torch.cat(there[:2], 1)) * scene.pixels_per_unit(here.positions)
        worst = torch.maximum(worst, torch.where(here.opacities >= ALPHA_MIN, off, 0))
    return Offset.of(worst)


def state_of(gaussians: MovingGaussians, time: float) -> State:
    """All of moving Gaussians at an instant; one that is not drawn has opacity 0 and no place."""
    splats, count = gaussians.at(time), len(gaussians)
    positions, factors, opacities = (torch.zeros(count, *size).double() for size in ((3,), (6,), ()))
    positions[splats.rows], opacities[splats.rows] = splats.means, splats.opacities
    factors[splats.rows] = cholesky(splats.covariances)
    return State(positions, factors, opacities)


def covariances_from(scales: Tensor, rotations: Tensor) -> Tensor:
    """Covariances [M, 6] of standard deviations [M, 3] along the axes of quaternions [M, 4], w first."""
    return covariances_from_factors(rotation_matrices_3d(normalized_quaternions(rotations.T)) * scales.T)


def _tensor(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, np.float64))
