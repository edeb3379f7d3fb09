"""Features moved to where their surroundings match best: from a fifth of a pixel to less than a tenth.

SIFT places a feature where its own image is extreme, and a surface that is seen askew is extreme elsewhere. So of
each track one camera keeps its place, and each other one is moved until the image around it, warped by an affine map
with a gain and an offset of brightness, is that of the first one (least squares matching, Gruen 1985; the inverse
compositional form of Baker and Matthews 2004).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from itertools import permutations

import numpy as np

from d2_plugin.recordings.cameras.calibrating.bundle import Tracks
from d2_plugin.recordings.cameras.calibrating.features import Features, pixel_error
from d2_plugin.recordings.images import opencv
from d2_plugin.recordings.recording import Camera

RADIUS = 5  # pixels from the middle of a patch to its edge: larger ones reach over edges of things
WIDTH = 3.5  # standard deviation, pixels, of the weight of a patch's pixels

ROUNDS = 10

ALIKE = 0.9  # correlation of two patches below which they show different things
STILL = 0.03  # pixels of the last round's move beyond which there is no result
LARGEST_MOVE = 2.0  # farther from where the feature was found, in `pixel_error`, it is another thing

FINER, FINEST = 4, 4096
"""Images are enlarged this often before they are sampled, up to so many pixels along a side: OpenCV places samples at
thirty-seconds of a pixel."""

Fine = tuple[np.ndarray, int]  # a smooth image some times as large, how many times


def sharpened(
    features: Mapping[str, Features], tracks: Tracks, cameras: Mapping[str, Camera]
) -> tuple[dict[str, Features], Tracks]:
    """(the features with the tracks' ones in better places, the tracks without those that found none).

    Features without images stay as they are.
    """
    greys = {name: features[name].greys or () for name in tracks.names}
    if not all(greys.values()):
        return dict(features), tracks
    moved = {name: features[name].pixels.copy() for name in tracks.names}
    seen = tracks.seen.copy()
    order = np.argsort(-(seen >= 0).sum(axis=0), kind="stable")  # the camera that sees most keeps its places
    first = order[(seen[:, order] >= 0).argmax(axis=1)]
    moments = np.array([features[tracks.names[one]].moments[own[one]] for one, own in zip(first, seen)], int)
    for moment in np.unique(moments):
        fine = cache(lambda name, moment=moment: _enlarged(greys[name][moment]))
        for one, other in permutations(range(len(tracks.names)), 2):
            rows = np.flatnonzero((moments == moment) & (first == one) & (seen[:, other] >= 0))
            if len(rows):
                staying, moving = tracks.names[one], tracks.names[other]
                limit = LARGEST_MOVE * pixel_error(cameras[moving])
                pairs = seen[rows][:, [one, other]]
                places, good = _moved(features[staying], features[moving], pairs, fine(staying), fine(moving), limit)
                moved[moving][seen[rows, other]] = places
                seen[rows[~good], other] = -1
    better = {name: replace(features[name], pixels=moved[name]) for name in tracks.names}
    return {**features, **better}, Tracks(tracks.names, seen[(seen >= 0).sum(axis=1) >= 2])


def _moved(
    one: Features, other: Features, pairs: np.ndarray, fine: Fine, other_fine: Fine, limit: float
) -> tuple[np.ndarray, np.ndarray]:
    """(places [n, 2] in `other` of the pairs [n, 2] of one moment, whether each of them can be believed)."""
    places, good = other.pixels[pairs[:, 1]].copy(), one.shapes[pairs[:, 0], 0] == 0  # corners of a board stay
    rows = np.flatnonzero(~good)
    if len(rows):
        start, begin = one.pixels[pairs[rows, 0]], places[rows]
        warp = _similarity(one.shapes[pairs[rows, 0]], other.shapes[pairs[rows, 1]])
        ends, alike, step = _matched(fine, other_fine, start, begin, warp)
        good[rows] = (np.linalg.norm(ends - begin, axis=1) < limit) & (alike > ALIKE) & (step < STILL)
        places[rows] = np.where(good[rows, None], ends, begin)
    return places, good


def _similarity(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Warps [n, 2, 2] between features of shapes [n, 2], (size, angle in radians)."""
    scale, angle = (other[:, 0] / one[:, 0])[:, None, None], other[:, 1] - one[:, 1]
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.asarray(scale * np.stack([np.stack([cosine, -sine], -1), np.stack([sine, cosine], -1)], -2))


def _matched(
    fine: Fine, other: Fine, p: np.ndarray, q: np.ndarray, warp: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(places [n, 2] in `other`, correlations [n], last steps [n]) for places p, starting at q."""
    grid = np.arange(-RADIUS, RADIUS + 1.0)
    u = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
    weight = np.exp(-(u**2).sum(axis=1) / (2 * WIDTH**2))
    patch = _sampled(fine, p[:, None] + u)
    inverse = _normal(patch, u, weight)
    step = np.full(len(p), np.inf)
    for _ in range(ROUNDS):
        there = _sampled(other, q[:, None] + u @ warp.transpose(0, 2, 1))
        change = np.einsum("nij,nj->ni", inverse, there)
        affine = np.linalg.inv(np.eye(2) + np.clip(change[:, 2:6], -0.2, 0.2).reshape(-1, 2, 2))
        warp = warp @ affine
        move = -(warp @ np.clip(change[:, :2], -1, 1)[..., None])[..., 0]
        q, step = q + move, np.linalg.norm(move, axis=1)
    there = _sampled(other, q[:, None] + u @ warp.transpose(0, 2, 1))
    return q, _correlation(patch, there, weight), step


def _normal(patch: np.ndarray, u: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Pseudo-inverses [n, 8, m]: of x, y, four of the affine map, brightness as it is and an offset to it."""
    side = round(len(u) ** 0.5)
    down, across = np.gradient(patch.reshape(-1, side, side), axis=(1, 2))
    gx, gy = across.reshape(len(patch), -1), down.reshape(len(patch), -1)
    columns = [gx, gy, gx * u[:, 0], gx * u[:, 1], gy * u[:, 0], gy * u[:, 1], patch, np.ones_like(patch)]
    J = np.stack(columns, axis=-1)
    weighted = (J * weight[:, None]).transpose(0, 2, 1)
    normal = weighted @ J
    size = np.sqrt(np.maximum(np.diagonal(normal, axis1=1, axis2=2), 1e-9))
    conditioned = normal / size[:, :, None] / size[:, None, :] + 1e-6 * np.eye(8)
    return np.asarray(np.linalg.solve(conditioned, weighted / size[:, :, None]) / size[:, :, None])


def _enlarged(grey: np.ndarray) -> Fine:
    cv2 = opencv("calibrating from images", "calibration")
    times = max(min(FINER, FINEST // max(grey.shape)), 1)
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 0.7)
    return cv2.resize(smooth, None, fx=times, fy=times, interpolation=cv2.INTER_CUBIC), times


def _sampled(fine: Fine, places: np.ndarray) -> np.ndarray:
    """Brightness [n, m] at pixels [n, m, 2] of the image before it was enlarged, centres at i + 0.5."""
    cv2 = opencv("calibrating from images", "calibration")
    image, times = fine
    where = (places * times - 0.5).astype(np.float32)
    rows = [  # OpenCV takes at most 32767 rows at once
        cv2.remap(image, where[start : start + 30_000], None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        for start in range(0, len(where), 30_000)
    ]
    return np.concatenate(rows).astype(np.float64)


def _correlation(one: np.ndarray, other: np.ndarray, weight: np.ndarray) -> np.ndarray:
    a, b = (patch - (patch * weight).sum(axis=1, keepdims=True) / weight.sum() for patch in (one, other))
    squares = (a**2 * weight).sum(axis=1) * (b**2 * weight).sum(axis=1)
    return np.asarray((a * b * weight).sum(axis=1) / np.sqrt(np.maximum(squares, 1e-9)))
