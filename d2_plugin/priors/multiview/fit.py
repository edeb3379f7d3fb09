"""The maps of a multi-view network at one instant: their scale there, how sure they are, and the vote with other maps.

Where stereo measured enough, one factor brings all views' maps to it: the affine fit of a monocular map with nothing to
shift, and with all views in one. Elsewhere the recording's own scale stands, and the views must show the same surfaces.
Confidence becomes sigma by the evidence that any map has: how far left-out anchors are missed, or other views' maps.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from d2_plugin.priors.monocular.across import Agreement, shared_scale
from d2_plugin.priors.monocular.align import INLIER_ERROR, Alignment, AlignStatus
from d2_plugin.priors.multiview.scale import AGREES, power_of
from d2_plugin.priors.multiview.source import MultiviewMap, surer_half
from d2_plugin.priors.settings import AlignSettings, PriorSettings
from d2_plugin.recordings.recording import Camera

UNSEEN = 0.03
"""What maps of one network have in common, standard deviation of log depth: it does not show in their differences."""
MEASURED = 0.05
"""Share of the pixels that stereo must know to scale an instant: fewer lie on a thing or two, and the map's bend there
is not its scale."""
WITNESSES = 20
"""So many stereo depths of a view must lie where two maps part, to say which of the two is wrong where they part."""


class Fitted(NamedTuple):
    """One view's map with its scale."""

    depth: np.ndarray
    """As the source has it, NaN where there is none."""
    alignment: Alignment
    sure: np.ndarray
    """By how much errors are smaller than those of the surer half [H, W]: confidence to a power that evidence gives."""


def fitted(
    maps: Mapping[str, MultiviewMap],
    anchors: Mapping[str, np.ndarray],
    cameras: Mapping[str, Camera],
    settings: PriorSettings,
) -> dict[str, Fitted]:
    """The views of one instant with their scale, each accepted or refused.

    Args:
        maps: in the scale of the recording, by camera.
        anchors: D^g [H, W] of the same views, 0 where there is none.
        settings: of the multi-view source, and of what makes a fit acceptable.
    """
    least, groups = settings.align.min_anchors, [[name] for name in maps]
    logs = {name: _logs(map_, anchors[name]) for name, map_ in maps.items()}
    shifts = dict.fromkeys(maps, 0.0)
    for group in groups if settings.multiview_scale == "view" else [list(maps)]:
        together = np.concatenate([logs[name][0] for name in group])
        enough = max(least, MEASURED * sum(anchors[name].size for name in group))
        if together.size >= enough and settings.multiview_scale != "metric":
            shifts |= dict.fromkeys(group, float(np.median(together)))
    scaled = {name: map_._replace(depth=map_.depth * np.float32(np.exp(shifts[name]))) for name, map_ in maps.items()}
    seen, power = _seen(scaled, cameras)
    errors = {name: np.abs(log - shifts[name]) for name, (log, _) in logs.items()}
    if sum(error.size for error in errors.values()) >= least:
        sure = np.concatenate([confidence for _, confidence in logs.values()])
        power = power_of(sure, np.concatenate(list(errors.values())))
    found = {}
    for name, map_ in maps.items():
        known = map_.confidence > 0
        unit = np.quantile(map_.confidence[known], 0.75) if known.any() else np.float32(1)
        sure = np.where(known, (map_.confidence / unit) ** np.float32(power), np.float32(0))
        found[name] = Fitted(map_.depth, _judged(errors[name], shifts[name], seen.get(name), settings.align), sure)
    return found


def _logs(map_: MultiviewMap, anchors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Log of anchor over map, and the map's confidence, [n] each, where both are known."""
    both = (anchors > 0) & (map_.confidence > 0)
    return np.log(anchors[both] / map_.depth[both]), map_.confidence[both]


def _seen(maps: Mapping[str, MultiviewMap], cameras: Mapping[str, Camera]) -> tuple[dict[str, Agreement], float]:
    """How well the surer half of each map fits those of the others, and the power by which surer halves part less."""
    surer = {name: surer_half(*map_) for name, map_ in maps.items()}
    rest = {name: np.where(np.isfinite(surer[name]), np.float32(np.nan), map_.depth) for name, map_ in maps.items()}
    found = [shared_scale(half, cameras, np.ones(1)).agreements for half in (surer, rest)]
    if not all(found):
        return found[0], 0.0
    spread = [float(np.median([fit.spread for fit in fits.values()])) for fits in found]
    sure = [
        float(np.median(np.concatenate([maps[name].confidence[np.isfinite(half[name])] for name in half])))
        for half in (surer, rest)
    ]
    return found[0], power_of(np.array(sure), np.array(spread))


def _judged(error: np.ndarray, shift: float, seen: Agreement | None, settings: AlignSettings) -> Alignment:
    """Whether a view's map may be used: by its anchors, missed by `error` [n], or by what other views show."""
    agreed = seen is not None and seen.matched >= AGREES
    status, inliers = AlignStatus.ACROSS if agreed else AlignStatus.PARTED, 0.0
    if error.size >= settings.min_anchors:
        inliers = float((error < INLIER_ERROR).mean())
        status = AlignStatus.OK if inliers >= settings.min_inliers else AlignStatus.FEW_INLIERS
    across = seen.spread if seen is not None and agreed else np.nan
    return Alignment(status, "metric", float(np.exp(shift)), 0.0, error.size, inliers=inliers, across=across)


class Vote(NamedTuple):
    """Two maps of one view as one, [H, W] each."""

    depth: np.ndarray
    sigma: np.ndarray
    """Where the map stands alone."""
    at_anchors: np.ndarray
    """What verification compares with."""


def voted(mono: Vote, multi: Vote, geometric: np.ndarray, conflict_sigmas: float) -> Vote:
    """A monocular and a multi-view map as one.

    Where they agree within their sigmas the mean, weighted by both, stands. Its sigma is that of the surer one, since
    errors of two maps that the same anchors bent are not independent, and grows as far as they part. Where they
    conflict stereo decides, and beyond it the one that stereo mostly found right in this view; without enough of it the
    surer one.
    """
    apart = np.abs(np.log(np.where(mono.depth > 0, mono.depth, 1) / np.where(multi.depth > 0, multi.depth, 1)))
    both = (mono.depth > 0) & (multi.depth > 0)
    first = mono.sigma <= multi.sigma
    spread = np.hypot(mono.sigma, multi.sigma)
    known = both & (geometric > 0)
    nearer = np.abs(mono.depth - geometric) < np.abs(multi.depth - geometric)
    at_known = known & (apart > conflict_sigmas * np.hypot(mono.at_anchors, multi.at_anchors))
    if np.count_nonzero(at_known) >= WITNESSES:
        first = np.where(apart > conflict_sigmas * spread, nearer[at_known].mean() > 0.5, first)
    first = np.where(at_known, nearer, first)
    first = np.where(both, first, mono.depth > 0)
    chosen = np.where(first, mono.depth, multi.depth)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.nan_to_num(1 / (1 + (mono.sigma / multi.sigma) ** 2), nan=0.5)
        mean = np.exp(share * np.log(mono.depth) + (1 - share) * np.log(multi.depth))
        parted = [apart / np.hypot(a, b) for a, b in ((mono.sigma, multi.sigma), (mono.at_anchors, multi.at_anchors))]
    close = both & (apart <= conflict_sigmas * spread) & np.isfinite(spread) & ~at_known
    sigmas = []
    for one, two, ratio in zip(mono[1:], multi[1:], parted):
        grown = np.fmin(one, two) * np.fmax(ratio, 1)
        sigmas.append(np.where(both, grown, np.where(first, one, two)).astype(np.float32))
    return Vote(np.where(close, mean, chosen).astype(np.float32), *sigmas)
