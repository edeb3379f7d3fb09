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
from torch import Tensor

from d2_plugin.durable import write
from d2_plugin.gaussians.moving import MovingGaussians
from d2_plugin.viewing.export.ply import ALPHA_MIN

MAGIC, VERSION = 0x5053474E, 3
MOST_FRACTION_BITS = 12
COMPRESSION = 6
FLIPS = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1])
"""Signs of the harmonics above the constant one when y and z change theirs."""
HEADER = np.dtype([("magic", "<u4"), ("version", "<u4"), ("count", "<u4"), ("rest", "u1", 4)])


def write_spz(path: Path, gaussians: MovingGaussians, shapes: tuple[Tensor, Tensor]) -> None:
    """Write Gaussians that stand still; those below an opacity of 1/255 are left out.

    `shapes` are the scales [M, 3] and quaternions [M, 4] of all of them."""
    kept = (gaussians.opacities >= ALPHA_MIN).nonzero()[:, 0]
    shown = gaussians.select(kept)
    positions = shown.positions.numpy() * (1, -1, -1)
    largest = float(np.abs(positions).max(initial=1e-6))
    bits = int(np.clip(np.floor(np.log2((2**23 - 1) / largest)), 0, MOST_FRACTION_BITS))
    fixed = np.clip(np.rint(positions * 2**bits), -(2**23), 2**23 - 1).astype(np.int64) & 0xFFFFFF
    scales, quaternions = (part[kept] for part in shapes)
    coefficients, degree = shown.harmonics.without_time().numpy(), shown.harmonics.degree
    planes = [
        np.stack([fixed & 255, fixed >> 8 & 255, fixed >> 16], -1),
        np.minimum(shown.opacities.numpy() * 255, 254),  # readers take the logit, which is infinite at 255
        (0.15 * coefficients[:, 0] + 0.5) * 255,
        (scales.log().numpy() + 10) * 16,
    ]
    body = [np.clip(np.rint(plane), 0, 255).astype(np.uint8).tobytes() for plane in planes]
    terms = coefficients.shape[1] - 1  # coarser codes compress better
    step = np.where(np.arange(terms) < 3, 8, 16)[:, None]
    codes = np.rint(coefficients[:, 1:] * FLIPS[:terms, None] * 128) + 128
    codes = np.clip(np.floor((codes + step // 2) / step) * step, 0, 255).astype(np.uint8)
    body += [_rotation_words(quaternions.numpy()).tobytes(), codes.tobytes()]
    header = np.array([(MAGIC, VERSION, len(shown), (degree, bits, 0, 0))], HEADER)
    write(path, gzip.compress(header.tobytes() + b"".join(body), COMPRESSION, mtime=0), synced=False)


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
