"""Sweeps over Gaussians: their lives and motion in the 4D backbone, and their images in the rasterizer.

The truth is a closed form, or an image that must be the same: that of the scene in other units, turned or moved.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from benchmarks.raster_scenes import Scene
from benchmarks.stability.definition import decades, sweep
from d2_plugin import registry
from d2_plugin.gaussians.rotation4d import covariances_from_factors
from d2_plugin.rasterizer import RasterSettings, Render, Splats, View, rasterize

WIDTH, HEIGHT, FOCAL = 64, 48, 54.0
THRESHOLDS = RasterSettings(alpha_min=1e-12, transmittance_min=1e-12)
"""Sweeps that compare two images leave the thresholds out: a pixel at one of them may fall to either side."""


def render(scene: Scene, dtype: torch.dtype, near: float = 0.2) -> Render:
    """The image in a precision; covariances were made in float64 and are rounded once."""
    settings = RasterSettings(near, alpha_min=THRESHOLDS.alpha_min, transmittance_min=THRESHOLDS.transmittance_min)
    rounded = Scene._make([*(part.to(dtype) for part in scene[:4]), scene.view])
    return rasterize(rounded.splats(), rounded.colors, scene.view, settings)


def turned(scene: Scene, rotation: Tensor) -> Scene:
    """The same scene in a world turned by `rotation` [3, 3]."""
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3] = rotation.T
    full = scene.covariances[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].view(-1, 3, 3)
    packed = (rotation @ full @ rotation.T)[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    view = camera(scene.view.T_camera_world @ turn)
    return scene._replace(means=scene.means @ rotation.T, covariances=packed, view=view)


def moved(scene: Scene, offset: Tensor) -> Scene:
    """The same scene elsewhere in the world; `offset` [3]."""
    pose = scene.view.T_camera_world.clone()
    pose[:3, 3] -= pose[:3, :3] @ offset
    return scene._replace(means=scene.means + offset, view=camera(pose))


def camera(pose: Tensor) -> View:
    """The camera of all sweeps at a pose."""
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64)
    return View("camera", 0, 0.0, pose, K, WIDTH, HEIGHT)


def random_rotation(seed: int) -> Tensor:
    """A proper rotation [3, 3]."""
    drawn = torch.randn(3, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    axes = torch.linalg.qr(drawn)[0]
    return axes * torch.linalg.det(axes).sign()


def random_scene(count: int = 60, ratio: float = 1.0, seed: int = 0) -> Scene:
    """Gaussians between 2 and 5 units ahead; axes s, s / sqrt(ratio), s / ratio in random directions."""
    g = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.rand(*shape, generator=g, dtype=torch.float64)  # noqa: E731
    depth = 2 + 3 * draw(count, 1)
    across = (draw(count, 2) - 0.5) * torch.tensor([WIDTH, HEIGHT], dtype=torch.float64) / FOCAL
    axes = torch.stack([random_rotation(seed * count + i) for i in range(count)])
    sizes = (0.1 + 0.2 * draw(count, 1)) * torch.tensor([1.0, ratio**-0.5, 1 / ratio], dtype=torch.float64)
    covariances = covariances_from_factors((axes * sizes[:, None]).permute(1, 2, 0))
    means = torch.cat([across * depth, depth], 1)
    return Scene(means, covariances, 0.9 * draw(count), draw(count, 3), camera(torch.eye(4, dtype=torch.float64)))


def difference(found: Render, expected: Render, unit: float = 1.0) -> float:
    """Largest deviation of colour, alpha and depth over alpha (in `unit`); not finite where any of them is not."""
    seen = expected.alpha > 0.05
    depths = (found.depth_sum / found.alpha)[seen] / unit - (expected.depth_sum / expected.alpha)[seen]
    parts = (found.color - expected.color, found.alpha - expected.alpha, depths)
    return largest(*(part.abs().max().item() for part in parts))


def largest(*errors: float) -> float:
    """The largest error, or NaN where any of them is NaN, which `max` would lose."""
    return math.nan if any(map(math.isnan, errors)) else max(errors)


@sweep(
    *("longest over shortest axis", decades(0, 9), "largest deviation of colour, alpha, depth"),
    "the projected covariance is widened by .3 px², as in the Inria rasterizer",
)
def anisotropy(ratio: float, dtype: torch.dtype) -> float:
    """A scene of needles in a turned world against the same scene in float64."""
    scene = random_scene(ratio=ratio)
    return difference(render(turned(scene, random_rotation(1)), dtype), render(scene, torch.float64))


@sweep(
    *("unit of length", decades(-3, 6), "largest deviation of colour, alpha, depth in that unit"),
    "Gaussians nearer than the near plane are culled; it is a setting, scaled here with the scene",
)
def depth(unit: float, dtype: torch.dtype) -> float:
    """A scene whose depths are `unit` times as large, near plane included, against the same scene in float64."""
    scene = random_scene()
    other = turned(scene, random_rotation(1))
    other = other._replace(means=other.means * unit, covariances=other.covariances * unit**2)
    return difference(render(other, dtype, near=0.2 * unit), render(scene, torch.float64), unit)


@sweep(
    *("distance from the origin", decades(0, 6), "largest deviation of colour, alpha, depth"),
    "nothing: float32 has 7 digits; a recording far from its origin must be recentred before it is trained",
)
def world_offset(offset: float, dtype: torch.dtype) -> float:
    """A scene and its camera, both moved `offset` away from the origin, against the same at the origin."""
    direction = torch.tensor([2.0, -1.0, 2.0], dtype=torch.float64) / 3
    scene = random_scene()
    return difference(render(moved(scene, offset * direction), dtype), render(scene, torch.float64))


@sweep(
    *("logit", tuple(float(v) for v in range(-50, 51, 5)), "error of alpha and its gradient"),
    "alpha is clamped at .99 with zero gradient beyond, and skipped below alpha_min (1e-12 here)",
)
def opacity_logit(logit: float, dtype: torch.dtype) -> float:
    """Alpha and its gradient at the middle of one Gaussian against min(.99, sigmoid) and its derivative."""
    value = torch.tensor([logit], dtype=dtype, requires_grad=True)
    mean = torch.tensor([[0.5 * 4 / FOCAL, 0.5 * 4 / FOCAL, 4.0]], dtype=dtype)  # at a pixel's centre
    packed = torch.tensor([[0.5, 0, 0, 0.5, 0, 0.5]], dtype=dtype)
    view = camera(torch.eye(4, dtype=torch.float64))
    splats = Splats(mean, packed, value.sigmoid(), torch.arange(1))
    image = rasterize(splats, torch.ones(1, 1, dtype=dtype), view, THRESHOLDS)
    middle = image.alpha[HEIGHT // 2, WIDTH // 2]
    (gradient,) = torch.autograd.grad(middle, value)
    exact = 1 / (1 + math.exp(-logit))
    drawn, clamped = exact > THRESHOLDS.alpha_min, exact > THRESHOLDS.alpha_max
    alpha = min(exact, THRESHOLDS.alpha_max) if drawn else 0.0
    slope = exact * (1 - exact) if drawn and not clamped else 0.0
    return largest(abs(middle.item() - alpha), abs(gradient.item() - slope))


@sweep(
    *("farthest depth beside one at .01", decades(0, 9), "deviation of colour and relative depth"),
    "nothing: depths are sorted as floating-point numbers, there is no far plane",
)
def far_plane(far: float, dtype: torch.dtype) -> float:
    """A Gaussian just ahead of the camera and two that nearly touch at distance `far`: order, colour and depth."""
    depths = torch.tensor([far, 0.01, far * (1 + 1e-5)], dtype=torch.float64)
    means = torch.cat([torch.zeros(3, 2, dtype=torch.float64), depths[:, None]], 1)
    means[:, :2] = 0.5 * depths[:, None] / FOCAL
    packed = (depths[:, None] * 0.5) ** 2 * torch.tensor([1.0, 0, 0, 1, 0, 1], dtype=torch.float64)
    view = camera(torch.eye(4, dtype=torch.float64))
    splats = Splats(means.to(dtype), packed.to(dtype), torch.full((3,), 0.5, dtype=dtype), torch.arange(3))
    image = rasterize(splats, torch.eye(3, dtype=dtype), view, RasterSettings(near=0.005))
    row, column = HEIGHT // 2, WIDTH // 2
    expected = torch.tensor([0.25, 0.5, 0.125], dtype=dtype)
    distance = (expected.double() * depths).sum().item()
    colors = (image.color[row, column] - expected).abs().max().item()
    return largest(colors, abs(image.depth_sum[row, column].item() / distance - 1))


def one_gaussian(dtype: torch.dtype, **rows: list[float]) -> Any:
    """A model of the 4D backbone with a single Gaussian whose raw parameters are given by name."""
    backbone: Any = registry.load(registry.BACKBONES, "yang4d")
    zeros = torch.zeros(1, 3, dtype=dtype)
    model = backbone.create(zeros, zeros, zeros[:, 0], extent=1.0, duration=1.0, temporal=True)
    with torch.no_grad():
        for name, values in rows.items():
            parameter = model.gaussians[name]
            parameter.copy_(torch.tensor(values, dtype=dtype).view_as(parameter))
    return model


@sweep(
    *("variance of a life", decades(-20, 20, 2), "relative error of opacity and slope"),
    "log-scales saturate at ±30 (a standard deviation of 1e-13..1e13)",
)
def temporal_variance(variance: float, dtype: torch.dtype) -> float:
    """Opacity one standard deviation from the middle of a life, and its slope in time, against the closed form."""
    sigma = math.sqrt(variance)
    model = one_gaussian(dtype, opacity_logits=[0.0], times=[-sigma], log_time_scales=[math.log(sigma)])
    opacity = model.slice_at(camera(torch.eye(4))).opacities
    if len(opacity) == 0:
        return math.inf
    (slope,) = torch.autograd.grad(opacity.sum(), model.gaussians["times"])
    expected = 0.5 * math.exp(-0.5)
    return largest(abs(opacity.item() / expected - 1), abs(slope.item() * sigma / expected - 1))


@sweep(
    *("velocity, lengths per frame", decades(0, 12), "relative error of the displacement"),
    *("nothing: the factor is reflected, no difference is taken", {"float32": 1e-3, "float64": 1e-6}),
)
def fast_motion(speed: float, dtype: torch.dtype) -> float:
    """Where a Gaussian is a hundredth of a unit of time after the middle of its life, against the closed form.

    It is long in x and turned into time by the angle at which its velocity Sigma_xt / Sigma_tt is about `speed`.
    """
    length, life, later = 1.0, 0.1 / speed, 0.01 / speed
    half = math.atan2(1.0, speed) / 2  # of the rotation in the plane of x and t
    rows = {"left": [math.cos(half), 0, 0, math.sin(half)], "right": [math.cos(half), 0, 0, -math.sin(half)]}
    scales = [math.log(length), math.log(0.01), math.log(0.01)]
    model = one_gaussian(dtype, **rows, log_scales=scales, log_time_scales=[math.log(life)], times=[-later])
    found = model.slice_at(camera(torch.eye(4))).means
    if len(found) == 0:
        return math.inf
    s, c = math.sin(2 * half), math.cos(2 * half)
    along = (length**2 - life**2) * s * c / (length**2 * s**2 + life**2 * c**2) * later
    return abs(found[0, 0].abs().item() / along - 1)


GAUSSIANS = (temporal_variance, fast_motion, anisotropy, depth, far_plane, opacity_logit, world_offset)
"""The sweeps of this file."""
