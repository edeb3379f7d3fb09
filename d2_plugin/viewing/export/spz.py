"""Gaussians of one instant as SPZ (nianticlabs/spz, version 3): about a tenth of a PLY, gzip of quantised planes.

    position   24-bit fixed point, as many fractional bits as the scene leaves
    scale      u8 = 16 (ln s + 10)
    rotation   smallest three of (x, y, z, w): 2 bits name the largest, then sign and 9 bits of each other / sqrt(1/2)
    opacity    u8, linear;  colour u8 = 255 (0.15 f_dc + 0.5);  harmonics u8 = 128 c + 128, to 5 bits, above degree 1 4
Axes are right, up, back, so y and z of ours (right, down, forward) change their signs, and with them some harmonics.
"""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from d2_plugin.durable import write
from d2_plugin.errors import D2Error
from d2_plugin.gaussians.moving import Harmonics, MovingGaussians
from d2_plugin.runs.gaussian_ply import scales_and_rotations
from d2_plugin.viewing.export.ply_files import covariances_from

MAGIC, VERSION = 0x5053474E, 3
MOST_FRACTION_BITS = 12
COMPRESSION = 6
"""The default of 9 takes three times as long and saves one byte in a hundred."""
FLIPS = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1])
"""Signs of the harmonics above the constant one when y and z change theirs."""
HEADER = np.dtype([("magic", "<u4"), ("version", "<u4"), ("count", "<u4"), ("rest", "u1", 4)])


def write_spz(path: Path, gaussians: MovingGaussians, shapes: tuple[Tensor, Tensor] | None = None) -> int:
    """Write what does not move of the Gaussians; returns how many were written. Those below 1/255 are left out.

    `shapes` are scales and quaternions of all of them, where they are known already."""
    kept = (gaussians.opacities >= 1 / 255).nonzero()[:, 0]
    shown = gaussians.select(kept)
    positions = shown.positions.numpy() * (1, -1, -1)
    largest = float(np.abs(positions).max(initial=1e-6))
    bits = int(np.clip(np.floor(np.log2((2**23 - 1) / largest)), 0, MOST_FRACTION_BITS))
    fixed = np.clip(np.rint(positions * 2**bits), -(2**23), 2**23 - 1).astype(np.int64) & 0xFFFFFF
    found = scales_and_rotations(shown.covariances) if shapes is None else (shapes[0][kept], shapes[1][kept])
    scales, quaternions = found
    coefficients, degree = shown.harmonics.without_time().numpy(), shown.harmonics.degree
    planes = [
        np.stack([fixed & 255, fixed >> 8 & 255, fixed >> 16], -1),
        shown.opacities.numpy() * 255,
        (0.15 * coefficients[:, 0] + 0.5) * 255,
        (scales.log().numpy() + 10) * 16,
    ]
    body = [np.clip(np.rint(plane), 0, 255).astype(np.uint8).tobytes() for plane in planes]
    body += [_rotation_words(quaternions.numpy()).tobytes(), _harmonic_bytes(coefficients[:, 1:]).tobytes()]
    header = np.array([(MAGIC, VERSION, len(shown), (degree, bits, 0, 0))], HEADER)
    write(path, gzip.compress(header.tobytes() + b"".join(body), COMPRESSION, mtime=0), synced=False)
    return len(shown)


def read_spz(path: Path) -> MovingGaussians:
    """Read what `write_spz` wrote.

    Raises:
        D2Error: the file is no SPZ of version 3.
    """
    data = path.read_bytes()
    raw = gzip.decompress(data) if data[:2] == b"\x1f\x8b" else b""
    header = np.frombuffer(raw[: HEADER.itemsize], HEADER)
    if not len(header) or header["magic"][0] != MAGIC or header["version"][0] != VERSION:
        raise D2Error(f"{path} is no SPZ file of version {VERSION}: export it anew")
    count, (degree, bits, _, _) = int(header["count"][0]), header["rest"][0].tolist()
    terms = (degree + 1) ** 2 - 1
    sizes = {"position": 9, "opacity": 1, "color": 3, "scale": 3, "rotation": 4, "harmonics": 3 * terms}
    columns, offset = {}, HEADER.itemsize
    for name, size in sizes.items():
        columns[name] = (
            np.frombuffer(raw[offset : offset + size * count], np.uint8).reshape(count, size).astype(np.int64)
        )
        offset += size * count
    low, middle, high = columns["position"].reshape(count, 3, 3).transpose(2, 0, 1)
    fixed = low | middle << 8 | high << 16
    positions = (fixed - ((fixed >> 23) << 24)) / 2**bits * (1, -1, -1)
    rotations = _quaternions(columns["rotation"].astype(np.uint8).reshape(-1).view("<u4"))
    more = (columns["harmonics"].reshape(count, terms, 3) - 128) / 128 * FLIPS[:terms, None]
    coefficients = np.concatenate([((columns["color"] / 255 - 0.5) / 0.15)[:, None], more], 1)
    covariances = covariances_from(_wide(np.exp(columns["scale"] / 16 - 10)), _wide(rotations))
    opacities = _wide(columns["opacity"][:, 0] / 255)
    return MovingGaussians(_wide(positions), covariances, opacities, Harmonics(_wide(coefficients), degree))


def _rotation_words(quaternions: np.ndarray) -> np.ndarray:
    """uint32 [M] of unit quaternions [M, 4], w first, in our axes."""
    xyzw = quaternions[:, [1, 2, 3, 0]] * (1, -1, -1, 1)
    largest = np.abs(xyzw).argmax(1)
    xyzw = xyzw * np.where(xyzw[np.arange(len(xyzw)), largest] < 0, -1, 1)[:, None]
    words = largest.astype(np.uint32)
    for axis in range(4):
        value = xyzw[:, axis]
        size = np.minimum(np.rint(np.abs(value) * np.sqrt(2) * 511), 511).astype(np.uint32)
        words = np.where(largest == axis, words, words << 10 | (value < 0).astype(np.uint32) << 9 | size)
    return words.astype("<u4")


def _quaternions(words: np.ndarray) -> np.ndarray:
    """Unit quaternions [M, 4], w first, in our axes."""
    words, xyzw = words.copy(), np.zeros((len(words), 4))
    largest = words >> 30
    for axis in range(3, -1, -1):
        other = largest != axis
        size = (words & 511) / 511 / np.sqrt(2) * np.where(words >> 9 & 1, -1, 1)
        xyzw[:, axis] = np.where(other, size, 0)
        words = np.where(other, words >> 10, words)
    xyzw[np.arange(len(xyzw)), largest] = np.sqrt(np.maximum(1 - (xyzw**2).sum(1), 0))
    return (xyzw * (1, -1, -1, 1))[:, [3, 0, 1, 2]]


def _harmonic_bytes(coefficients: np.ndarray) -> np.ndarray:
    """Bytes [M, C, 3] of the coefficients above the constant one; coarser codes compress better."""
    terms = coefficients.shape[1]
    codes = np.rint(coefficients * FLIPS[:terms, None] * 128) + 128
    step = np.where(np.arange(terms) < 3, 8, 16)[:, None]
    return np.clip(np.floor((codes + step // 2) / step) * step, 0, 255).astype(np.uint8)


def _wide(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, np.float64))
