"""Aligning a monocular map to geometric depth: one scale and one shift per frame and view, or a reason why not.

The paper fits a D^m + b to D^g. A relative model (Depth Anything V2) however returns affine-invariant *inverse* depth,
so its map is fitted to 1 / D^g. A metric model is fitted to D^g as the paper writes it.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from d2_plugin.priors.monocular.affine import AffineFit, fit_affine
from d2_plugin.priors.monocular.settings import AlignSettings
from d2_plugin.recordings.recording import MonoKind

RANKED = 4000
"""Anchors whose ranks are compared: the standard error is .016, and sorting stays below a millisecond."""
MAX_ANCHORS = 20_000
"""More anchors than this are subsampled."""
MIN_SPREAD = 1e-3
"""Geometric depths whose 5..95 percentile range is below this share of their median are refused."""
MAX_GAP = 1e-8
"""Relative duality gap above which a fit is refused."""
MIN_T = 10.0
"""Scale over its standard error below which a fit needs `MIN_CORRELATION`."""
MIN_CORRELATION = 0.5
"""Rank correlation that speaks for a scale whose standard error does not."""
WRONG_KIND = -0.3
"""Rank correlation of the map with what it is declared to be, below which the declared kind is contradicted."""
INLIER_ERROR = 0.1
"""Relative discrepancy e below which an anchor counts as an inlier of the fit."""
SEED = 0
"""Of the subsampling of anchors."""


class AlignStatus(StrEnum):
    """Outcome of an alignment; the value is the sentence that a person reads."""

    OK = "aligned"
    ACROSS = "aligned by the surfaces that it shares with other cameras' maps: its own anchors span too little"
    EMPTY = "no pixel has both a monocular and a geometric depth"
    TOO_FEW = "too few pixels have both a monocular and a geometric depth"
    FLAT = "the monocular map is constant where geometric depth is known, so scale and shift cannot be told apart"
    ONE_DEPTH = "all geometric depths are the same, so the scale cannot be known"
    WRONG_KIND = "the map falls where its declared kind must rise: relative with inverse depth, metric with depth"
    BOUNDARY = "no positive scale fits: monocular and geometric depth do not rise together"
    UNSTABLE = "the scale is not significant: monocular and geometric depth are nearly unrelated"
    FEW_INLIERS = "too few geometric depths agree with the aligned monocular map"
    PARTED = "the maps of one network do not show the same surfaces from camera to camera"
    NOT_CERTIFIED = "the fit stopped before its optimality could be certified"
    NOT_ALIGNED = "used as it is, without alignment"


@dataclass(frozen=True)
class Alignment:
    """a, b of the paper for one frame and view, with the certificate and the evidence for accepting it.

    `domain` of a and b follows `kind`: relative maps give inverse depth a m + b, metric ones depth a m + b.
    `gap` bounds (F - F*) / F; `inliers` is the share of all anchors with discrepancy e below `INLIER_ERROR`; `t` is the
    scale over its standard error; `rank_correlation` that of the map with 1 / D^g (relative) or D^g (metric).
    """

    status: AlignStatus
    kind: MonoKind
    scale: float = float("nan")
    shift: float = float("nan")
    anchors: int = 0
    gap: float = float("nan")
    iterations: int = 0
    objective: float = float("nan")
    epsilon: float = float("nan")
    inliers: float = 0.0
    t: float = 0.0
    rank_correlation: float = 0.0
    across: float = float("nan")
    """Relative standard deviation of the map from its difference to other cameras' maps (`across`); else NaN."""

    @property
    def accepted(self) -> bool:
        """Whether aligned depth may be used at all."""
        return self.status in (AlignStatus.OK, AlignStatus.ACROSS, AlignStatus.NOT_ALIGNED)

    def as_json(self) -> dict[str, object]:
        """Plain values for the record beside a stored prior; NaN becomes None."""
        values = {name: None if value != value else value for name, value in asdict(self).items()}
        return {**values, "status": self.status.name.lower(), "reason": self.status.value}


def align(mono: np.ndarray, geometric: np.ndarray, *, kind: MonoKind, settings: AlignSettings) -> Alignment:
    """Fit scale > 0 and shift of `mono` to `geometric` over the pixels that have both.

    Args:
        mono: D^m float [H, W]: inverse depth up to scale and shift (`relative`), or depth (`metric`).
        geometric: D^g float [H, W], planar depth, 0 or NaN where unknown.
        settings: residual, smoothing and when a fit is refused.
    """
    fitted = _fitted(mono, geometric, kind, settings)
    if isinstance(fitted, Alignment):
        return fitted
    x, depth, target, fit = fitted.x, fitted.depth, fitted.target, fitted.fit
    t = fit.scale / max(fit.scale_error, np.finfo(float).tiny)
    error = np.abs(_depth(x, fit.scale, fit.shift, kind, np.inf) - depth) / depth
    inliers = float((error < INLIER_ERROR).mean())
    correlation = rank_correlation(x[:: max(1, x.size // RANKED)], target[:: max(1, x.size // RANKED)])
    return Alignment(
        status=_judge(fit, correlation, t, inliers, settings),
        kind=kind,
        scale=fit.scale,
        shift=fit.shift,
        anchors=fitted.anchors,
        gap=fit.gap,
        iterations=fit.iterations,
        objective=fit.objective,
        epsilon=fitted.epsilon,
        inliers=inliers,
        t=float(min(t, 1e12)),
        rank_correlation=correlation,
    )


def unjudged_line(
    mono: np.ndarray, geometric: np.ndarray, *, kind: MonoKind, settings: AlignSettings
) -> tuple[float, float]:
    """Scale and shift of `align` without the tests of whether they may be used; NaN without a line."""
    fitted = _fitted(mono, geometric, kind, settings)
    line = fitted if isinstance(fitted, Alignment) else fitted.fit
    return line.scale, line.shift


def not_aligned(kind: MonoKind) -> Alignment:
    """a = 1, b = 0: the map as the network gave it (the paper's ablation row "Dual w/o align.")."""
    return Alignment(AlignStatus.NOT_ALIGNED, kind, scale=1.0, shift=0.0)


def aligned_depth(mono: np.ndarray, alignment: Alignment, z_far: float) -> np.ndarray:
    """D-bar^m: aligned monocular depth float32 [H, W], 0 where it has none.

    A pixel whose aligned value is not a depth in (0, z_far] (an inverse depth that crosses zero, a saturated network)
    is left empty, never clamped: a clamped one would propose Gaussians at the far plane. A refused alignment gives no
    depth at all.
    """
    if not alignment.accepted:
        return np.zeros(mono.shape, np.float32)
    return _depth(mono.astype(np.float64), alignment.scale, alignment.shift, alignment.kind, z_far).astype(np.float32)


def aligned_inverse(mono: np.ndarray, alignment: Alignment) -> np.ndarray:
    """Aligned inverse depth float64 [H, W], also where it is no depth: 0 and below is infinitely far, NaN is unknown.

    The zero of a saturated ReLU means "farther than can be predicted" and is taken as infinitely far.
    """
    value = alignment.scale * mono.astype(np.float64) + alignment.shift
    if alignment.kind == "metric":
        with np.errstate(divide="ignore"):
            return np.where(value > 0, 1 / np.where(value > 0, value, 1), np.nan)
    return np.where(mono == 0, np.minimum(value, 0), value)


def predicted(mono: np.ndarray) -> np.ndarray:
    """Pixels at which the network said something, bool: finite, and not the zero of a saturated ReLU.

    Depth Anything V2 ends in a ReLU. Its exact zeros mean "farther than can be predicted", which is no value to fit.
    """
    return np.isfinite(mono) & (mono != 0)


def rank_correlation(x: np.ndarray, y: np.ndarray) -> float:
    """Spearman's rank correlation of two vectors; 0 where one is constant. Ties share their mean rank."""
    centred = [rank - rank.mean() for rank in (_twice_the_ranks(x), _twice_the_ranks(y))]
    norm = np.sqrt((centred[0] @ centred[0]) * (centred[1] @ centred[1]))
    return float(centred[0] @ centred[1] / norm) if norm > 0 else 0.0


def _twice_the_ranks(values: np.ndarray) -> np.ndarray:
    """For each value how many are smaller, and how many are not larger: both together."""
    order = np.argsort(values)
    ordered = values[order]
    steps = np.flatnonzero(ordered[1:] != ordered[:-1]) + 1
    first, last = np.append(0, steps), np.append(steps, values.size)
    ranks = np.empty(values.size, np.int64)
    ranks[order] = np.repeat(first + last, last - first)
    return ranks


def _depth(mono: np.ndarray, scale: float, shift: float, kind: MonoKind, z_far: float) -> np.ndarray:
    value: np.ndarray = scale * np.where(predicted(mono), mono, np.nan) + shift
    if kind == "relative":
        near_enough = value > max(1 / z_far, float(np.finfo(np.float32).tiny))
        return np.where(near_enough, 1 / np.where(near_enough, value, 1), 0)
    return np.where((value > 0) & (value <= z_far), value, 0)


class _Fitted(NamedTuple):
    """The anchors of a fit [n] and what it gave."""

    anchors: int
    """How many there were before some were drawn."""
    x: np.ndarray
    depth: np.ndarray
    target: np.ndarray
    fit: AffineFit
    epsilon: float


def _fitted(mono: np.ndarray, geometric: np.ndarray, kind: MonoKind, settings: AlignSettings) -> _Fitted | Alignment:
    anchors = np.flatnonzero(predicted(mono) & np.isfinite(geometric) & (geometric > 0))
    count = int(anchors.size)
    if count == 0:
        return Alignment(AlignStatus.EMPTY, kind)
    if count < settings.min_anchors:
        return Alignment(AlignStatus.TOO_FEW, kind, anchors=count)
    rows = anchors[_subsample(count)]
    x, depth = (values.ravel()[rows].astype(np.float64) for values in (mono, geometric))
    near = np.abs(x - np.median(x)) <= 1e5 * _central_range(x)  # a value beyond is no prediction
    x, depth = x[near], depth[near]
    if _central_range(x) <= 1e-6 * np.abs(x).max():
        return Alignment(AlignStatus.FLAT, kind, anchors=count)
    if _central_range(depth) <= MIN_SPREAD * float(np.median(depth)):
        return Alignment(AlignStatus.ONE_DEPTH, kind, anchors=count)
    target = 1 / depth if kind == "relative" else depth
    relative = settings.residual == "relative"
    epsilon = settings.epsilon if relative else settings.epsilon * float(np.median(target))
    fit = fit_affine(x, target, 1 / target if relative else None, epsilon=epsilon)
    return _Fitted(count, x, depth, target, fit, epsilon)


def _judge(fit: AffineFit, correlation: float, t: float, inliers: float, settings: AlignSettings) -> AlignStatus:
    if correlation < WRONG_KIND:
        return AlignStatus.WRONG_KIND
    if fit.flat or fit.boundary:
        return AlignStatus.FLAT if fit.flat else AlignStatus.BOUNDARY
    if not fit.gap <= MAX_GAP:
        return AlignStatus.NOT_CERTIFIED
    if t < MIN_T and correlation < MIN_CORRELATION:
        return AlignStatus.UNSTABLE
    if inliers < settings.min_inliers:
        return AlignStatus.FEW_INLIERS
    return AlignStatus.OK


def _subsample(count: int) -> np.ndarray | slice:
    """One row from each of `MAX_ANCHORS` equal strata: even over the image, without the aliasing of a fixed stride."""
    if count <= MAX_ANCHORS:
        return slice(None)
    jitter = np.random.default_rng(SEED).random(MAX_ANCHORS)
    return np.minimum(((np.arange(MAX_ANCHORS) + jitter) * (count / MAX_ANCHORS)).astype(np.int64), count - 1)


def _central_range(values: np.ndarray) -> float:
    """Width of the central 90 %: a handful of leverage points must not pass for spread."""
    return float(np.quantile(values, 0.95)) - float(np.quantile(values, 0.05))
