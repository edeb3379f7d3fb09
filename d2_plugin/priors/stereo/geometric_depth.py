"""Geometric depth of one timestamp: choose a maker, match at the chosen resolution, filter, bring back to full size."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from d2_plugin.captures.capture import Camera
from d2_plugin.errors import D2Error, unknown_name
from d2_plugin.priors.geometry import check_depth_range, check_views, scaled_camera, view_pair, viewing_rays
from d2_plugin.priors.settings import StereoSettings
from d2_plugin.priors.stereo.filter import GeometricDepth, filter_depths
from d2_plugin.priors.stereo.reuse import MatchMemory, widened

RawDepth = tuple[np.ndarray, np.ndarray]
"""Planar depth float32 [H, W] (0 = none) and matching cost 1 - NCC float32 [H, W] in 0..2."""

Maker = Callable[..., list[RawDepth]]
"""(grey uint8 [H, W] per camera, cameras, (near, far), settings, wanted) -> raw depth and cost per camera.

`wanted` is None or bool [H, W] per camera: a maker may leave out all other pixels, and should where that saves time.
"""

LUMA = np.array([0.299, 0.587, 0.114], np.float32)  # ITU-R BT.601, as every codec of the captures uses


class DepthBounds(NamedTuple):
    """Near and far of a rig in world units, and where they come from."""

    near: float
    far: float
    origin: str


def _patchmatch(*arguments: Any) -> list[RawDepth]:
    from d2_plugin.priors.stereo.patchmatch import patchmatch

    return patchmatch(*arguments)


def _sweep(*arguments: Any) -> list[RawDepth]:
    from d2_plugin.priors.stereo.sweep import sweep

    return sweep(*arguments)


def _colmap(*arguments: Any) -> list[RawDepth]:
    from d2_plugin.priors.colmap.mvs import colmap_patch_match

    return colmap_patch_match(*arguments)


MAKERS: dict[str, Maker] = {"patchmatch": _patchmatch, "sweep": _sweep, "colmap": _colmap}

ON_DISK = ("sensor", "workspace")
"""What `maker` may name besides: depth that lies beside a capture (`d2_plugin.priors.depth_on_disk`)."""

WHOLE_PICTURES = ("colmap",)
"""Makers that match every pixel whatever is wanted: carrying matches over would only make them older."""


def geometric_depth(
    images: Sequence[np.ndarray],
    cameras: Sequence[Camera],
    depth_range: tuple[float, float],
    settings: StereoSettings,
    maker: str | None = None,
    memory: MatchMemory | None = None,
) -> list[GeometricDepth]:
    """D^g of every view from the synchronized views of one timestamp, and of no other.

    Args:
        images: RGB uint8 [H, W, 3] per camera.
        cameras: at least two, in the same order.
        depth_range: near and far in world units; ten times too wide does no harm.
        settings: matching and filtering.
        maker: name in `MAKERS` or `auto`; settings.maker where None.
        memory: matches of the frames before, which are carried over where the pictures did not change, and which this
            frame's are added to.

    Returns:
        Per camera the filtered depth; empty everywhere where nothing can be known (no texture, one centre).

    Raises:
        D2Error: fewer than two views, pictures of another size than their camera, an inverted range, an unknown maker.
    """
    check_views(images, cameras)
    depth_range = check_depth_range(depth_range)
    name = choose_maker(maker or settings.maker)
    small = [_shrunk(gray(image), camera, settings.max_pixels) for image, camera in zip(images, cameras)]
    grays, small_cameras = [pair[0] for pair in small], [pair[1] for pair in small]
    wanted = None if memory is None else memory.wanted(grays, settings)
    asked = None if wanted is None else [widened(mask, settings.reuse_margin) for mask in wanted]
    raw = MAKERS[name](grays, small_cameras, depth_range, settings, asked)
    if memory is not None:
        raw = memory.merge(grays, raw, wanted)
    filtered = filter_depths(grays, small_cameras, [depth for depth, _ in raw], [cost for _, cost in raw], settings)
    return [enlarged(result, camera.width, camera.height) for result, camera in zip(filtered, cameras)]


def choose_maker(name: str) -> str:
    """The name of the matcher that `auto` stands for on this machine, or `name` itself if it is known.

    Raises:
        D2Error: an unknown name, or one that stands for depth on disk.
    """
    if name in ON_DISK:
        raise D2Error(f"maker = {name} reads depth that lies beside a capture: build the priors of that capture")
    if name != "auto":
        if name not in MAKERS:
            raise unknown_name("stereo maker", name, [*MAKERS, *ON_DISK, "auto"])
        return name
    from d2_plugin.compiler import NoCompiler, find_compiler
    from d2_plugin.priors.colmap.mvs import why_not_usable

    if not why_not_usable():
        return "colmap"
    try:
        find_compiler()
    except NoCompiler:
        return "sweep"
    return "patchmatch"


def gray(image: np.ndarray) -> np.ndarray:
    """Luma uint8 [H, W] of an RGB uint8 picture [H, W, 3]."""
    return np.rint(image.astype(np.float32) @ LUMA).astype(np.uint8)


def depth_bounds(
    cameras: Sequence[Camera], points: np.ndarray | None = None, max_angle: float = StereoSettings.max_angle
) -> DepthBounds:
    """Depth range of a rig: from triangulated points, else from what the data set declares, else from the cameras.

    Measured on eight rigs of 2 to 4 views (synthetic, studio, Middlebury): of the depths that two views see, the range
    from 250 to 2100 points of one instant holds all, on studio all but .02 %. Makers take a range ten times too wide.

    Args:
        cameras: the cameras that are matched.
        points: world points [N, 3] triangulated with the known poses, or None.
        max_angle: what two cameras see at a wider angle than this cannot be matched, degrees; it bounds the near end
            where nothing else does.

    Raises:
        D2Error: nothing tells a range, because all cameras stand at one point.
    """
    depths = [] if points is None else [_visible_depths(camera, np.asarray(points, np.float64)) for camera in cameras]
    depths = [values for values in depths if values.size >= 10]
    if depths:
        # COLMAP's own margins around the 1st and 99th percentile of the sparse depths (model.cc, ComputeDepthRanges).
        near = min(float(np.percentile(values, 1)) for values in depths) * 0.75
        far = max(float(np.percentile(values, 99)) for values in depths) * 1.25
        return DepthBounds(near, far, f"{sum(values.size for values in depths)} triangulated observations")
    declared = [camera.near_far for camera in cameras if camera.near_far is not None]
    if declared:
        near, far = min(bounds[0] for bounds in declared), max(bounds[1] for bounds in declared)
        return DepthBounds(*check_depth_range((near * 0.8, far * 1.2)), "near and far of the data set")
    return _bounds_from_baselines(cameras, max_angle)


def _bounds_from_baselines(cameras: Sequence[Camera], max_angle: float) -> DepthBounds:
    """From where two cameras begin to see something alike to half a pixel of disparity between the farthest pair."""
    centres = np.stack([camera.centre for camera in cameras])
    distances = np.linalg.norm(centres[:, None] - centres[None], axis=-1)
    if not distances.any():
        names = ", ".join(camera.name for camera in cameras)
        raise D2Error(f"cameras {names} stand at one point, so nothing can be triangulated: use cameras that are apart")
    far = max(float(camera.K[0, 0]) for camera in cameras) * float(distances.max()) / 0.5
    pairs = [(a, b) for i, a in enumerate(cameras) for j, b in enumerate(cameras) if distances[i, j] > 0]
    nearest = np.concatenate([_first_shared_depths(reference, source, far, max_angle) for reference, source in pairs])
    if nearest.size == 0:
        return DepthBounds(far / 1e4, far, "baselines alone, and no two cameras see the same")
    return DepthBounds(float(np.percentile(nearest, 2)), far, "the cameras alone, so it is very wide")


def _first_shared_depths(reference: Camera, source: Camera, far: float, max_angle: float) -> np.ndarray:
    """Depths from which on both see the same at less than `max_angle`, over a grid of pixels; empty where never."""
    depths = np.geomspace(far * 1e-6, far, 400)[:, None]
    grid = scaled_camera(reference, 9, 9)
    pair = view_pair(grid, source)
    u, v = np.meshgrid(np.arange(9.0), np.arange(9.0))
    at = pair.project(u.reshape(1, -1), v.reshape(1, -1), depths)
    seen = (at.z > 0) & (at.x > -0.5) & (at.y > -0.5) & (at.x < source.width - 0.5) & (at.y < source.height - 0.5)
    points = viewing_rays(grid, np.float64).reshape(1, -1, 3) * depths[..., None]
    away = points - pair.direction
    cosine = (points * away).sum(-1) / (np.linalg.norm(points, axis=-1) * np.linalg.norm(away, axis=-1))
    alike = seen & (cosine > np.cos(np.deg2rad(max_angle)))
    return depths[alike.argmax(axis=0), 0][alike.any(axis=0)]


def _visible_depths(camera: Camera, points: np.ndarray) -> np.ndarray:
    local = points @ camera.T_camera_world[:3, :3].T + camera.T_camera_world[:3, 3]
    pixels = local @ camera.K.T
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y = pixels[:, 0] / pixels[:, 2], pixels[:, 1] / pixels[:, 2]
    inside = (local[:, 2] > 0) & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
    return local[inside, 2]


def _shrunk(gray: np.ndarray, camera: Camera, max_pixels: int) -> tuple[np.ndarray, Camera]:
    """Picture and camera at the largest of full, half, a third, ... of the size that has at most `max_pixels`."""
    divisor = math.ceil(math.sqrt(gray.size / max(max_pixels, 1)))
    if divisor <= 1:
        return gray, camera
    from d2_plugin.priors.extras import opencv

    cv2 = opencv("matching at another resolution")
    width, height = max(1, round(camera.width / divisor)), max(1, round(camera.height / divisor))
    small = cv2.resize(gray, (width, height), interpolation=cv2.INTER_AREA)
    return small, scaled_camera(camera, width, height)


def enlarged(result: GeometricDepth, width: int, height: int, tolerance: float = 0.01) -> GeometricDepth:
    """The maps at another size: inverse depth, which is linear over a plane, is interpolated between four neighbours.

    Where they differ by more than twice `tolerance`, or one is missing, nothing is known: an interpolated value would
    hang between two surfaces.
    """
    if result.depth.shape == (height, width):
        return result
    rows, row_share = _neighbours(result.depth.shape[0], height)
    columns, column_share = _neighbours(result.depth.shape[1], width)
    corners = [result.depth[r][:, c] for r in rows for c in columns]
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = [1 / corner for corner in corners]
        top = inverse[0] * (1 - column_share) + inverse[1] * column_share
        bottom = inverse[2] * (1 - column_share) + inverse[3] * column_share
        depth = 1 / (top * (1 - row_share)[:, None] + bottom * row_share[:, None])
    nearest, farthest = np.minimum.reduce(corners), np.maximum.reduce(corners)
    smooth = (nearest > 0) & (farthest - nearest <= 2 * tolerance * nearest)
    row, column = np.where(row_share < 0.5, rows[0], rows[1]), np.where(column_share < 0.5, columns[0], columns[1])
    return replace(
        result,
        depth=np.where(smooth, depth, 0).astype(np.float32),
        cost=result.cost[row][:, column],
        confirmations=result.confirmations[row][:, column],
    )


def _neighbours(small: int, large: int) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Indices of the pixels before and after each enlarged pixel's centre, and the share of the one after."""
    position = (np.arange(large) + 0.5) * (small / large) - 0.5
    before = np.clip(np.floor(position), 0, small - 1).astype(np.int64)
    after = np.clip(before + 1, 0, small - 1)
    share = np.clip(position - before, 0, 1).astype(np.float32)
    return (before, after), share
