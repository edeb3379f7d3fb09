"""Cross-source verification and fusion of the two depths into D* (paper, "Dual-source Depth Consistency Prior")."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from d2_plugin.priors.settings import Variant
from d2_plugin.protocol import Label
from d2_plugin.recordings.images import opencv
from d2_plugin.store.maps import FusedPrior

EPSILON = 1e-9
"""The paper's eps, world units."""
CONFIRMS, NEAR = 2.0, 0.1
"""A map finds a match that no other view does within so many of its sigmas and that relative difference. It confirms
it where its sigma is less than the second: one that is hardly known agrees with anything."""
SURER, SUREST = 0.25, 0.005
"""Sigma of such a match: this share of the map's and of how far the two are apart, and no less than that."""


def cross_source_discrepancy(mono: np.ndarray, geometric: np.ndarray) -> np.ndarray:
    """e = |D-bar^m - D^g| / (D^g + eps), float32 [H, W]; infinite where there is no geometric depth.

    Args:
        mono: aligned monocular depth float [H, W].
        geometric: D^g float [H, W], 0 where unknown.
    """
    known = geometric > 0
    relative = np.abs(mono - geometric) / (np.where(known, geometric, 1) + EPSILON)
    return np.where(known, relative, np.inf).astype(np.float32)


def hanging_pixels(mono: np.ndarray, limit: float) -> np.ndarray:
    """Pixels [H, W] bool of a monocular map that hang between a near and a far surface; an addition to the paper.

    Networks blur depth edges, and a point of the blur lies on neither surface: alone it would propose a floater. Such
    pixels are those around which, within 1 % of the image's width, depth spans more than `limit` in relative terms.
    A limit of 0 drops nothing, which is the paper.
    """
    if limit <= 0:
        return np.zeros(mono.shape, bool)
    cv2 = opencv("the monocular edge test")
    side = 2 * max(1, mono.shape[1] // 200) + 1
    kernel = np.ones((side, side), np.uint8)
    known = mono > 0
    farthest = cv2.dilate(mono, kernel)
    nearest = cv2.erode(np.where(known, mono, np.float32(np.inf)), kernel)
    return known & (farthest * np.float32(np.exp(-limit)) > nearest)


def fuse(
    mono: np.ndarray,
    geometric: np.ndarray,
    *,
    tau_c: float | np.ndarray,
    variant: Variant = "dual",
    hanging: np.ndarray | None = None,
    most_vetoed: float = 1.0,
    sigma_mono: np.ndarray | None = None,
    sigma_geometric: np.ndarray | None = None,
) -> FusedPrior:
    """D* and its labels from aligned monocular depth and filtered geometric depth.

    Verified pixels take D^g, pixels without D^g the aligned monocular depth, and pixels where the two disagree nothing.

    Args:
        mono: D-bar^m float [H, W], 0 where it has none.
        geometric: D^g float [H, W], 0 where it has none.
        tau_c: largest relative discrepancy of a verified pixel, one number or a map [H, W].
        variant: `dual_unaligned` fuses like `dual` and expects the unaligned map as `mono`.
        hanging: bool [H, W], pixels whose monocular depth may verify but is left out where it would stand alone.
        most_vetoed: where more than this share of the geometric depths disagree, the monocular map is wrong, and all of
            them are verified; 1 is the paper.
        sigma_mono, sigma_geometric: relative standard deviations [H, W] of the two. Where they are left out, those of
            the paper: 0 at verified pixels and infinite elsewhere.
    """
    alone = mono if hanging is None else np.where(hanging, np.float32(0), mono)
    if variant == "mono":
        geometric, verified = np.zeros_like(geometric), alone > 0
    elif variant == "mvs":
        alone, verified = np.zeros_like(mono), geometric > 0
    elif variant == "dual_unverified":
        verified = geometric > 0
    else:
        known = geometric > 0
        verified = cross_source_discrepancy(mono, geometric) < tau_c  # Omega^v, within Omega^g
        if np.count_nonzero(known & ~verified) > most_vetoed * np.count_nonzero(known):
            verified = known
    depth, labels = _labelled(alone, geometric, verified)
    if sigma_mono is None or sigma_geometric is None:
        return FusedPrior(depth, labels, np.where(labels == Label.VERIFIED, 0, np.inf).astype(np.float32))
    sigma = np.where(geometric > 0, sigma_geometric, sigma_mono)
    return FusedPrior(depth, labels, np.where(depth > 0, sigma, np.float32(np.inf)).astype(np.float32, copy=False))


def with_matches(maps: FusedPrior, mono: np.ndarray, sigma: np.ndarray, unconfirmed: np.ndarray) -> FusedPrior:
    """D* with the matches that the monocular map finds where no other view does; an addition to the paper.

    A match (all maps are float [H, W], depths 0 where there is none) near `mono` takes the place of the map's depth,
    which is not as exact, or of nothing, at an edge that the map blurs. It is verified, as the paper has it, where the
    map confirms it, and else agreed. Its sigma says that it had one witness: a share of the relative `sigma` of the map
    and of how far the two are apart.
    """
    known = (mono > 0) & (unconfirmed > 0) & (sigma < np.inf)
    apart = np.abs(np.log(np.where(known, unconfirmed, 1) / np.where(known, mono, 1)))
    found = known & (apart < np.fmin(CONFIRMS * sigma, NEAR))
    labels = np.where(sigma < NEAR, np.uint8(Label.VERIFIED), np.uint8(Label.AGREED))
    return replace(
        maps,
        depth=np.where(found, unconfirmed, maps.depth),
        labels=np.where(found, labels, maps.labels),
        sigma=np.where(found, np.fmax(np.float32(SURER) * (sigma + apart), np.float32(SUREST)), maps.sigma),
    )


def _labelled(mono: np.ndarray, geometric: np.ndarray, verified: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(depth float32 [H, W], labels uint8 [H, W])."""
    known = geometric > 0
    labels = np.full(mono.shape, Label.EMPTY, np.uint8)
    labels[~known & (mono > 0)] = Label.MONO
    labels[known] = Label.CONFLICT
    labels[verified] = Label.VERIFIED
    supported = (labels == Label.VERIFIED) | (labels == Label.MONO)
    depth = np.where(supported, np.where(known, geometric, mono), 0)
    return depth.astype(np.float32), labels
