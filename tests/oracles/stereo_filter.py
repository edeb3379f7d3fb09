"""The filter of geometric depth in NumPy: the bits that `d2_plugin.priors.stereo.filtering.kernel` must return."""

import itertools
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np

from benchmarks.stereo_rigs import sample_nearest
from d2_plugin.priors.geometry import CONTINUOUS, Projection, ViewPair, view_pair, viewing_rays
from d2_plugin.priors.stereo.filtering import precision
from d2_plugin.priors.stereo.filtering.confirm import NUDGE, RELATIVE_DEPTH, REPROJECTION_MAX, Confirmation
from d2_plugin.priors.stereo.settings import StereoSettings
from d2_plugin.recordings.recording import Camera

Map = np.ndarray


def run(name: str, maps: dict[str, Map], **numbers: Any) -> None:
    """What `kernel.run` does, by the functions below."""
    if name == "slopes":
        maps["inverse"][:], maps["slope_x"][:], maps["slope_y"][:] = slopes(maps["depth"], numbers["reach"])
    elif name == "coherence":
        both = maps["slope_x"], maps["slope_y"]
        maps["share"][:] = coherence(maps["gray"], maps["inverse"], both, maps["weights"], **numbers)
    elif name == "scatter":
        maps["scatter"][:] = scatter(maps["depth"], **numbers)
    else:
        given = ("depth", "coherence", "gradient", "parallax", "spread", "scatter")
        maps["sigma"][:] = sigma(*(maps[part] for part in given))


def coherence(
    gray: Map, inverse: Map, slopes: tuple[Map, Map], weights: Map, radius: int, stride: int, relative: float
) -> Map:
    """What `kernel.run("coherence", ...)` writes, bit for bit; its arguments."""
    height, width = inverse.shape
    padded_inverse = np.pad(inverse, radius)
    values = gray.astype(np.int16)
    padded_gray = np.pad(values, radius, constant_values=1000)
    tolerance = np.float32(relative) * inverse
    agreeing, total = np.zeros_like(inverse), np.zeros_like(inverse)
    steps = range(-radius, radius + 1, stride)
    for dy, dx in itertools.product(steps, steps):
        if (dy, dx) == (0, 0):
            continue
        window = np.s_[radius + dy : radius + dy + height, radius + dx : radius + dx + width]
        weight = weights[np.minimum(np.abs(padded_gray[window] - values), 256)]
        distance = padded_inverse[window] - inverse - dx * slopes[0] - dy * slopes[1]
        total += weight
        agreeing += weight * (np.abs(distance) < tolerance)
    return agreeing / np.maximum(total, np.finfo(np.float32).tiny)


def slopes(depth: Map, reach: int) -> tuple[Map, Map, Map]:
    """What `kernel.run("slopes", ...)` writes, bit for bit: (inverse depth, its slopes), per pixel.

    The flatter one-sided difference: at a depth edge one side runs over the edge and is the steeper one.
    """
    valid = depth > 0
    inverse = np.where(valid, 1 / np.where(valid, depth, 1), 0).astype(np.float32)
    return inverse, np.ascontiguousarray(_vertical_slope(inverse.T, reach).T), _vertical_slope(inverse, reach)


def _vertical_slope(inverse: Map, reach: int) -> Map:
    """Slope of inverse depth down the columns."""
    padded = np.pad(inverse, ((reach, reach), (0, 0)))
    above, below = padded[: -2 * reach], padded[2 * reach :]
    rise = np.where(above > 0, inverse - above, np.inf)
    fall = np.where(below > 0, below - inverse, np.inf)
    flatter = np.where(np.abs(rise) < np.abs(fall), rise, fall)
    return (np.where(np.isfinite(flatter) & (inverse > 0), flatter, 0) / np.float32(reach)).astype(np.float32)


def confirm(
    index: int,
    cameras: Sequence[Camera],
    depths: Sequence[Map],
    settings: StereoSettings,
    tolerance: float = RELATIVE_DEPTH,
) -> Confirmation:
    """What the other views say of the depth of view `index`: the bits of the kernel."""
    shape = depths[index].shape
    sums = SimpleNamespace(
        confirming=np.zeros(shape, np.uint16), information=np.zeros(shape), difference=np.zeros(shape)
    )
    for other, source in enumerate(cameras):
        if other != index:
            add_source(sums, depths[index], depths[other], cameras[index], source, settings, tolerance)
    spread = np.sqrt(sums.difference / np.where(sums.information > 0, sums.information, 1))
    return Confirmation(sums.confirming, np.sqrt(sums.information), spread)


def add_source(
    sums: Any, depth: Map, theirs: Map, reference: Camera, source: Camera, settings: StereoSettings, tolerance: float
) -> None:
    """Add what one source says of `depth` [H, W] to the sums."""
    v, u = np.indices(depth.shape, np.float32)
    pair, way_back = view_pair(reference, source), view_pair(source, reference)
    forth = pair.project(u, v, depth)
    seen = (sample_surface if settings.between_pixels else sample_nearest)(theirs, forth)
    back = way_back.project(forth.x, forth.y, seen)
    off_x, off_y = back.x - u, back.y - v
    near = (depth > 0) & (seen > 0) & (np.sqrt(off_x * off_x + off_y * off_y) < np.float32(REPROJECTION_MAX))
    near &= np.abs(back.z - depth) < np.float32(tolerance) * depth
    near &= _meet(viewing_rays(reference), depth, pair, settings)
    nudged = pair.project(u.astype(np.float64), v.astype(np.float64), depth * np.exp(NUDGE))
    moved_x, moved_y = nudged.x - forth.x, nudged.y - forth.y
    squared = (moved_x * moved_x + moved_y * moved_y) / NUDGE**2
    precision, apart = np.where(np.isfinite(squared), squared, 0), back.z / depth - 1
    sums.confirming[:] += near
    sums.information[:] += np.where(near, precision, 0)
    sums.difference[:] += np.where(near, precision * (apart * apart), 0)


def _meet(rays: Map, depth: Map, pair: ViewPair, settings: StereoSettings) -> Map:
    """Whether the rays of both cameras meet at an angle that is allowed, [H, W].

    |a x b| and a.b are its sine and cosine times the same length. In units of the depth, so that no unit of the world
    overflows.
    """
    (x, y, z), direction = np.moveaxis(rays, -1, 0), pair.direction.astype(np.float32)
    u, v, w = x - direction[0] / depth, y - direction[1] / depth, z - direction[2] / depth
    p, q, r = y * w - z * v, z * u - x * w, x * v - y * u
    sine, cosine = np.sqrt(p * p + q * q + r * r), x * u + y * v + z * w
    low, high = np.deg2rad(settings.min_angle), np.deg2rad(settings.max_angle)
    above = sine * np.float32(np.cos(low)) > cosine * np.float32(np.sin(low))
    return above & (sine * np.float32(np.cos(high)) < cosine * np.float32(np.sin(high)))


def sample_surface(depth: Map, at: Projection) -> Map:
    """`depth` between the pixels around `at` where they are one surface, that of the nearest pixel elsewhere.

    On a ground that is seen at a grazing angle, depth changes by more than 1 % from one pixel to the next.
    """
    inside = at.z > 0
    known, between = interpolated_surface(depth, np.where(inside, at.x, -9), np.where(inside, at.y, -9))
    return np.where(known, between, sample_nearest(depth, at)).astype(np.float32)


def interpolated_surface(depth: Map, x: Map, y: Map) -> tuple[Map, Map]:
    """A depth map [H, W] between its pixels: (where four neighbours are one surface, depth there), shaped like x and y.

    Bilinear in inverse depth, which is linear over a plane. x and y are array indices, NaN-free.
    """
    height, width = depth.shape
    if min(height, width) < 2:
        return np.zeros(x.shape, bool), np.ones(x.shape)
    inside = (x >= 0) & (y >= 0) & (x <= width - 1) & (y <= height - 1)
    left = np.clip(np.floor(np.where(inside, x, 0)), 0, width - 2).astype(np.int64)
    top = np.clip(np.floor(np.where(inside, y, 0)), 0, height - 2).astype(np.int64)
    right, down = np.where(inside, x, 0) - left, np.where(inside, y, 0) - top
    first, flat = top * width + left, np.ascontiguousarray(depth).ravel()
    corners = [flat[first + offset] for offset in (0, 1, width, width + 1)]
    nearest, farthest = np.minimum.reduce(corners), np.maximum.reduce(corners)
    known = inside & (nearest > 0) & (farthest < CONTINUOUS * nearest)
    inverse = [1 / np.where(known, corner, 1).astype(np.float64) for corner in corners]
    upper, lower = (inverse[i] * (1 - right) + inverse[i + 1] * right for i in (0, 2))
    return known, 1 / (upper * (1 - down) + lower * down)


def sigma(depth: Map, coherence: Map, gradient: Map, parallax: Map, spread: Map, scatter: Map) -> Map:
    """What `kernel.run("sigma", ...)` writes, bit for bit; its maps."""
    known = (depth > 0) & (parallax > 0) & np.isfinite(depth) & ~np.isnan(coherence)
    known &= np.isfinite(spread) & ~np.isnan(gradient)
    coherence, spread = (np.where(known, map_, 0) for map_ in (coherence, spread))
    pixels = precision.MATCHING + precision.GRAY_NOISE / np.where(known, np.maximum(gradient, precision.FLATTEST), 1)
    pixels = pixels + precision.PER_INCOHERENCE * (1 - np.clip(coherence, 0, 1))
    matching = pixels / np.where(known, parallax, 1)
    variance = (
        matching**2 + (precision.OF_SCATTER * scatter) ** 2 + (precision.OF_SPREAD * spread) ** 2 + precision.FLOOR**2
    )
    return np.where(known, np.sqrt(variance), np.inf).astype(np.float32)


def scatter(depth: Map, reach: int, slack: float) -> Map:
    """What `kernel.run("scatter", ...)` writes, bit for bit; its arguments.

    Moments are about the window's own pixel: those about another one would differ by little from their products.
    """
    known = (depth > 0) & np.isfinite(depth)
    weight, inverse = known.astype(np.float64), np.where(known, 1 / np.where(known, depth, 1).astype(np.float64), 0)

    def down(values: Map, power: int) -> Map:
        return _moment(values, reach, power)

    def across(values: Map, power: int) -> Map:
        return _moment(values.T, reach, power).T

    rows, rising = down(weight, 0), down(inverse, 0)
    share = 1 / np.maximum(across(rows, 0), 1)
    u, uu = across(rows, 1) * share, across(rows, 2) * share
    v, uv = (across(down(weight, 1), power) * share for power in (0, 1))
    vv, y, uy = across(down(weight, 2), 0) * share, across(rising, 0) * share, across(rising, 1) * share
    vy, yy = across(down(inverse, 1), 0) * share, across(down(inverse * inverse, 0), 0) * share
    uu, vv, uv = uu - u * u + slack, vv - v * v + slack, uv - u * v
    uy, vy, yy = uy - u * y, vy - v * y, yy - y * y
    determinant = uu * vv - uv * uv
    explained = (vv * uy * uy - 2 * uv * uy * vy + uu * vy * vy) / determinant
    return np.where(known, np.sqrt(np.maximum(yy - explained, 0)) / np.where(known, inverse, 1), 0)


def _moment(values: Map, reach: int, power: int) -> Map:
    """Sum over the rows of a window around each pixel, [H, W], of values times a power of the row's offset."""
    padded, total = np.pad(values, ((reach, reach), (0, 0))), np.zeros_like(values)
    for offset in range(-reach, reach + 1):
        total += float(offset**power) * padded[reach + offset : reach + offset + len(values)]
    return total
