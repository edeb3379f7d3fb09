"""The arrays of a page: a moving scene in 16-bit codes, and the same read back as a player reads it.

Every Gaussian has a position, a size and the six entries of its covariance's Cholesky factor relative to the size, an
opacity and a colour. Beside those, straight lines have
    fading    mu_t and ln sigma
    reaches   v min(c sigma, T): how far it goes while it can be seen in a clip of T seconds, F(c sigma) being the cut
and a position is where the Gaussian is at mu_t, or at the end of the clip nearest to it: what lies outside the clip
costs no precision inside. Keys have positions, and shapes and opacities of the first rows, once for each key.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from d2_plugin.gaussians.moving import Harmonics, MovingGaussians
from d2_plugin.gaussians.slicing import MARGINAL_CUT
from d2_plugin.viewing.export.codes import BLOCK, COMPRESSION, Coded, decode, encode, morton_order
from d2_plugin.viewing.export.keys import ALPHA_MIN, Keys, Offset, State, cholesky

MARGINAL_REACH = math.sqrt(-2 * math.log(MARGINAL_CUT))
"""Standard deviations from mu_t at which a Gaussian is cut off: F = `MARGINAL_CUT`."""
HARMONIC_BITS = (8, 6, 5, 4, 3)
"""Of all coefficients of a colour but the constant one: the first that fits."""
SAMPLED = 16
"""One block in so many tells how far harmonics can be compressed."""


@dataclass(frozen=True, eq=False)
class CodedScene:
    """Arrays and what a reader must know beside them."""

    arrays: tuple[Coded, ...]
    facts: dict[str, Any]
    """count, motion ("none", "lines" or "keys"), keys, degree, time_degree."""
    rows: Tensor
    """Which of the model's Gaussians each one is."""


def code_lines(gaussians: MovingGaussians, duration: float, most_bytes: float = math.inf) -> CodedScene:
    """Gaussians on straight lines, or standing still; those that are never seen in the clip are left out.

    Harmonics are coded as coarsely as keeps all arrays, compressed, below `most_bytes`."""
    rows = seen_rows(gaussians, duration)
    rows = rows[torch.from_numpy(morton_order(gaussians.positions[rows].numpy()))]
    chosen = gaussians.select(rows)
    arrays, positions = [], chosen.positions
    if chosen.motion is not None:
        velocities, times, sigmas = chosen.motion
        arrays = [encode("fading", torch.stack([times, sigmas.log()], -1).numpy())]
        times, sigmas = _fading(decode(arrays[0]))  # as a reader finds them, so that their error does no harm
        anchors, spans = _anchors(times, sigmas, duration)
        positions = positions + velocities * (anchors - chosen.motion.times)[:, None]
        arrays.append(encode("reaches", (velocities * spans[:, None]).numpy()))
    state = State(positions, cholesky(chosen.covariances), chosen.opacities)
    arrays += _code_state(state)
    left = most_bytes - sum(len(array.data) for array in arrays) - 6 * len(chosen)
    arrays += _code_colors(chosen.harmonics, left)
    motion = "none" if chosen.motion is None else "lines"
    return CodedScene(tuple(arrays), _facts(len(chosen), motion, chosen.harmonics, None), rows)


def code_keys(keys: Keys, harmonics: Harmonics) -> CodedScene:
    """Gaussians at key times; `harmonics` are those of the whole model."""
    own = harmonics._replace(coefficients=harmonics.coefficients[keys.rows])
    arrays = [*_code_state(keys.start), *_code_colors(own)]
    for i, state in enumerate(keys.states):
        arrays.append(encode(f"positions_{i}", state.positions.numpy()))
        if keys.changing:
            arrays.append(encode(f"shapes_{i}", shapes_of(state.factors)))
            arrays.append(encode(f"opacities_{i}", state.opacities.numpy()))
    told = {"times": list(keys.times), "moving": keys.moving, "changing": keys.changing}
    return CodedScene(tuple(arrays), _facts(len(keys.rows), "keys", own, told), keys.rows)


def read_state(arrays: Mapping[str, np.ndarray], facts: Mapping[str, Any], duration: float, time: float) -> State:
    """The Gaussians at `time`, from decoded arrays: what the player draws, opacity 0 for those that it does not."""
    start = State(_tensor(arrays["positions"]), factors_of(arrays["shapes"]), _tensor(arrays["opacities"])[:, 0])
    if facts["motion"] == "none":
        return start
    if facts["motion"] == "keys":
        told = facts["keys"]
        states = tuple(_read_key(arrays, i, start) for i in range(len(told["times"])))
        rows = torch.arange(len(start.positions))
        keys = Keys(tuple(told["times"]), start, rows, told["moving"], told["changing"], states, Offset(0, 0, 0))
        return keys.at(time)
    times, sigmas = _fading(arrays["fading"])
    anchors, spans = _anchors(times, sigmas, duration)
    velocities = _tensor(arrays["reaches"]) / spans.clamp(min=1e-30)[:, None]
    factor = torch.exp(-0.5 * ((time - times) / sigmas) ** 2)
    opacities = torch.where(factor > MARGINAL_CUT, start.opacities * factor, 0)
    return State(start.positions + velocities * (time - anchors)[:, None], start.factors, opacities)


def read_harmonics(arrays: Mapping[str, np.ndarray], facts: Mapping[str, Any]) -> Harmonics:
    """Colours, from decoded arrays."""
    parts = [arrays["colors"]] + ([arrays["harmonics"]] if "harmonics" in arrays else [])
    coefficients = _tensor(np.concatenate(parts, axis=1)).unflatten(1, (-1, 3))
    return Harmonics(coefficients, facts["degree"], facts["time_degree"])


def shapes_of(factors: Tensor) -> np.ndarray:
    """Columns ln size and the six entries relative to it, [M, 7], of factors [M, 6]."""
    size = factors.abs().amax(-1, keepdim=True).clamp(min=1e-30)
    return torch.cat([size.log(), factors / size], -1).numpy()


def factors_of(shapes: np.ndarray) -> Tensor:
    """Factors [M, 6] of what `shapes_of` made."""
    return _tensor(np.exp(shapes[:, :1]) * shapes[:, 1:])


def _read_key(arrays: Mapping[str, np.ndarray], i: int, start: State) -> State:
    if f"shapes_{i}" not in arrays:
        return State(_tensor(arrays[f"positions_{i}"]), start.factors[:0], start.opacities[:0])
    opacities = _tensor(arrays[f"opacities_{i}"])[:, 0]
    return State(_tensor(arrays[f"positions_{i}"]), factors_of(arrays[f"shapes_{i}"]), opacities)


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


def _fading(decoded: np.ndarray) -> tuple[Tensor, Tensor]:
    columns = _tensor(decoded)
    return columns[:, 0], columns[:, 1].exp()


def _anchors(times: Tensor, sigmas: Tensor, duration: float) -> tuple[Tensor, Tensor]:
    """When each Gaussian is at its position, and how long it goes at most while it is seen."""
    return times.clamp(0, duration), (MARGINAL_REACH * sigmas).clamp(max=duration)


def _code_state(state: State) -> list[Coded]:
    return [
        encode("positions", state.positions.numpy()),
        encode("shapes", shapes_of(state.factors)),
        encode("opacities", state.opacities.numpy()),
    ]


def _code_colors(harmonics: Harmonics, most_bytes: float = math.inf) -> list[Coded]:
    """The constant colours, and the harmonics above them in at most `most_bytes` if need be."""
    coefficients = harmonics.coefficients
    arrays = [encode("colors", coefficients[:, 0].numpy())]
    if coefficients.shape[1] > 1:
        more = coefficients[:, 1:].flatten(1).numpy()
        arrays.append(encode("harmonics", more, _bits_that_fit(more, most_bytes)))
    return arrays


def _bits_that_fit(values: np.ndarray, most_bytes: float) -> int:
    """By a sample of the blocks, compressed."""
    blocks = np.arange(len(values)) // BLOCK
    rows = blocks % SAMPLED == 0 if len(values) > 4 * SAMPLED * BLOCK else blocks >= 0
    for bits in HARMONIC_BITS[:-1]:
        if values.nbytes // 8 <= most_bytes:
            return bits
        size = len(zlib.compress(encode("sample", values[rows], bits).data, COMPRESSION))
        if size * len(values) / rows.sum() <= most_bytes:
            return bits
    return HARMONIC_BITS[-1]


def _facts(count: int, motion: str, harmonics: Harmonics, keys: dict[str, Any] | None) -> dict[str, Any]:
    return {
        "count": count,
        "motion": motion,
        "keys": keys,
        "degree": harmonics.degree,
        "time_degree": harmonics.time_degree,
    }


def _tensor(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, np.float64))
