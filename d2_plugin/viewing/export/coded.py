"""The arrays of a page: a moving scene as numbers of 16 bits, or of 8, between the extremes of their block.

Where and when a Gaussian is, and its opacity, have 16 bits; shapes and colours have 8 (`LOOK_BITS`).

Rows are coded in blocks of 256 neighbours in space (`morton_order`), each column with its own range in each block, so
that the step is small. An array is stored as ranges float32 [blocks, columns, 2], then per column the high bytes of all
rows and then the low bytes, which compress better so. player/scene.js decodes.

Every Gaussian has a position, a size and the six entries of its covariance's Cholesky factor relative to the size, an
opacity and a colour. Beside those, straight lines have
    fading    mu_t and ln sigma
    reaches   v min(c sigma, T): how far it goes while it can be seen in a clip of T seconds, F(c sigma) being the cut
and a position is where the Gaussian is at mu_t, or at the end of the clip nearest to it: what lies outside the clip
costs no precision inside. Keys have positions, and shapes and opacities of the first rows, once for each key.
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from d2_plugin.gaussians.moving import Harmonics, MovingGaussians
from d2_plugin.gaussians.slicing import MARGINAL_CUT
from d2_plugin.viewing.export.keys import Keys, State, cholesky, morton_order
from d2_plugin.viewing.export.ply import ALPHA_MIN

BLOCK = 256
"""Rows that share their ranges."""
MARGINAL_REACH = math.sqrt(-2 * math.log(MARGINAL_CUT))
"""Standard deviations from mu_t at which a Gaussian is cut off: F = `MARGINAL_CUT`."""
LOOK_BITS = 8
"""Of shapes and colours: images then differ by about what the bytes of a screen round (docs/evidence.md)."""


class Coded(NamedTuple):
    """One array in its stored form."""

    name: str
    data: bytes
    rows: int
    columns: int
    bits: int
    decoded: Tensor
    """[rows, columns] float64, the values that a reader finds."""


def encode(name: str, values: np.ndarray, bits: int = 16) -> Coded:
    """Code `values` [N, C] (or [N]), all finite, in 16 bits, or in at most 8 of a byte."""
    values = np.asarray(values, np.float64)
    values = values[:, None] if values.ndim == 1 else values
    rows, columns = values.shape
    blocks = -(-rows // BLOCK)
    padded = np.concatenate([values, np.repeat(values[-1:], blocks * BLOCK - rows, axis=0)])
    padded = padded.reshape(blocks, BLOCK, columns)
    ranges = np.stack([padded.min(1), padded.max(1)], -1).astype("<f4") if blocks else np.zeros((0, columns, 2), "<f4")
    low, high = (ranges[..., i].astype(np.float64)[:, None] for i in (0, 1))
    steps = (1 << bits) - 1
    share = (padded - low) / np.where(high > low, high - low, 1)
    codes = np.clip(np.rint(share * steps), 0, steps).astype(np.uint16)
    decoded = (low + codes * ((high - low) / steps)).reshape(-1, columns)[:rows]
    planes = codes.reshape(blocks * BLOCK, columns)[:rows].T
    parts = [planes >> 8, planes & 255] if bits > 8 else [planes]
    body = np.stack(parts, axis=1).astype(np.uint8).tobytes()
    return Coded(name, ranges.tobytes() + body, rows, columns, bits, torch.from_numpy(decoded))


class CodedScene(NamedTuple):
    """Arrays and what a reader must know beside them."""

    arrays: list[Coded]
    gaussians: int
    motion: Literal["none", "lines", "keys"]
    keys: Keys | None = None


def code_lines(gaussians: MovingGaussians, duration: float) -> CodedScene:
    """Gaussians on straight lines, or standing still; those that are never seen in the clip are left out."""
    rows = seen_rows(gaussians, duration)
    rows = rows[torch.from_numpy(morton_order(gaussians.positions[rows].numpy()))]
    chosen = gaussians.select(rows)
    arrays: list[Coded] = []
    positions = chosen.positions
    if chosen.motion is not None:
        velocities, times, sigmas = chosen.motion
        fading = encode("fading", torch.stack([times, sigmas.log()], -1).numpy())
        times, sigmas = fading.decoded[:, 0], fading.decoded[:, 1].exp()  # a reader's, so that their error does no harm
        # When each Gaussian is at its position, and how long it goes at most while it is seen.
        anchors, spans = times.clamp(0, duration), (MARGINAL_REACH * sigmas).clamp(max=duration)
        positions = positions + velocities * (anchors - chosen.motion.times)[:, None]
        arrays += [fading, encode("reaches", (velocities * spans[:, None]).numpy())]
    state = State(positions, cholesky(chosen.covariances), chosen.opacities)
    arrays += _code_state(state)
    arrays += _code_colors(chosen.harmonics)
    return CodedScene(arrays, len(rows), "none" if chosen.motion is None else "lines")


def code_keys(keys: Keys, harmonics: Harmonics) -> CodedScene:
    """Gaussians at key times; `harmonics` are those of the whole model."""
    own = harmonics._replace(coefficients=harmonics.coefficients[keys.rows])
    arrays = [*_code_state(keys.start), *_code_colors(own)]
    for i, state in enumerate(keys.states):
        arrays.append(encode(f"positions_{i}", state.positions.numpy()))
        if keys.changing:
            arrays.append(encode(f"shapes_{i}", _shapes(state.factors), LOOK_BITS))
            arrays.append(encode(f"opacities_{i}", state.opacities.numpy()))
    return CodedScene(arrays, len(keys.rows), "keys", keys)


def _shapes(factors: Tensor) -> np.ndarray:
    """Columns ln size and the six entries relative to it, [M, 7], of factors [M, 6]."""
    size = factors.abs().amax(-1, keepdim=True).clamp(min=1e-30)
    return torch.cat([size.log(), factors / size], -1).numpy()


def seen_rows(gaussians: MovingGaussians, duration: float) -> Tensor:
    """Rows that are finite and reach an opacity of 1/255 at some time of the clip."""
    parts = [gaussians.positions, gaussians.covariances, gaussians.harmonics.coefficients.flatten(1)]
    strongest = gaussians.opacities
    if gaussians.motion is not None:
        velocities, times, sigmas = gaussians.motion
        factor = torch.exp(-0.5 * ((times.clamp(0, duration) - times) / sigmas) ** 2)
        strongest = torch.where(factor > MARGINAL_CUT, strongest * factor, 0)
        parts += [velocities, times[:, None], sigmas.log()[:, None]]
    finite = torch.isfinite(torch.cat(parts, 1)).all(1)
    return (finite & (strongest >= ALPHA_MIN)).nonzero()[:, 0]


def _code_state(state: State) -> list[Coded]:
    return [
        encode("positions", state.positions.numpy()),
        encode("shapes", _shapes(state.factors), LOOK_BITS),
        encode("opacities", state.opacities.numpy()),
    ]


def _code_colors(harmonics: Harmonics) -> list[Coded]:
    coefficients = harmonics.coefficients
    arrays = [encode("colors", coefficients[:, 0].numpy(), LOOK_BITS)]
    if coefficients.shape[1] > 1:
        arrays.append(encode("harmonics", coefficients[:, 1:].flatten(1).numpy(), LOOK_BITS))
    return arrays
