"""Scenes with which rasterizers are timed: N synthetic Gaussians, or the points of a real garden.

Both are seeded and independent of the image size up to the camera, so that times at different sizes compare.
"""

from functools import partial
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
import torch
from torch import Tensor

from d2_plugin.arrays import read_array
from d2_plugin.errors import D2Error
from d2_plugin.gaussians.rotation4d import covariances_from_factors, rotation_matrices_3d
from d2_plugin.rasterizer import Splats, View

FOCAL = 0.85
"""Focal length of the synthetic camera in image widths."""

RADIUS = 4.0
"""Mean 3-sigma radius along the major axis of the synthetic Gaussians at 640x360; pixels."""

GARDEN_CROP = 2.0
"""Half side of the cube that is kept of the garden; world units."""

GARDEN_SCALES = (1e-4, 0.02)
"""Range of the garden's random standard deviations; world units. gsplat's own test data uses the same."""


class Scene(NamedTuple):
    """What a rasterizer gets: Gaussians, their colors, and a camera."""

    means: Tensor  # [M, 3]
    covariances: Tensor  # [M, 6]
    opacities: Tensor  # [M]
    colors: Tensor  # [M, 3]
    view: View

    def splats(self) -> Splats:
        """The Gaussians without their colors."""
        return Splats(*self[:3], torch.arange(len(self.means), device=self.means.device))

    def leaves(self, dtype: torch.dtype, device: torch.device | str = "cpu") -> Self:
        """The same in a precision on a device, with tensors that require gradients."""
        return type(self)._make([*(part.to(device, dtype).detach().requires_grad_() for part in self[:4]), self.view])


def load_scene(name: str, width: int, height: int, garden: Path | None = None) -> Scene:
    """`synth:N` for N synthetic Gaussians, `garden` for the points in the file `garden` (test_garden.npz); float32.

    Raises:
        D2Error: the name is neither, or the garden's file is not given or absent.
    """
    if name == "garden":
        if garden is None or not garden.is_file():
            raise D2Error(f"scene 'garden' needs gsplat's test_garden.npz, got {garden}: give its path with --garden")
        return garden_scene(garden, width, height)
    kind, _, number = name.partition(":")
    if kind != "synth" or not number.isdigit():
        raise D2Error(f"unknown scene '{name}': have garden and synth:N with N the number of Gaussians")
    return synthetic_scene(int(number), width, height)


def synthetic_scene(count: int, width: int, height: int) -> Scene:
    """Gaussians at log-uniform depth 2..20, a tenth of them beside the view, with log-normal anisotropic scales."""
    random = np.random.default_rng(0)
    reference_width, reference_height = 640, 360
    focal = FOCAL * reference_width
    depth = np.exp(random.uniform(np.log(2.0), np.log(20.0), count))
    across = random.uniform(-0.55, 0.55, count) * reference_width / focal
    down = random.uniform(-0.55, 0.55, count) * reference_height / focal
    means = np.stack([across * depth, down * depth, depth], 1)
    quaternions = random.normal(size=(count, 4))
    scales = np.exp(random.normal(0, 0.7, (count, 1)) + random.normal(0, 0.5, (count, 3))) * depth[:, None] / focal
    factors = _factors(quaternions, scales)
    factors *= _scale_for_radius(means, factors, focal)
    opacities = np.clip(random.beta(0.8, 1.2, count), 0.005, 0.995)
    colors = random.uniform(0, 1, (count, 3))
    view = _view(np.eye(4), FOCAL * width, FOCAL * width, width, height)
    return _scene(view, means, factors, opacities, colors)


def garden_scene(path: Path, width: int, height: int) -> Scene:
    """The garden's structure-from-motion points, with random shapes and opacities (seed 0), from its first camera."""
    read = partial(read_array, path, "give gsplat's test_garden.npz")
    means, colors = read(key="means3d").astype(np.float64), read(key="colors") / 255.0
    T_camera_world, K = read(key="viewmats")[0], read(key="Ks")[0]
    original_width, original_height = int(read(key="width")), int(read(key="height"))
    inside = (np.abs(means) <= GARDEN_CROP).all(1)
    means, colors = means[inside], colors[inside]
    random = np.random.default_rng(0)
    scales = random.uniform(*GARDEN_SCALES, (len(means), 3))
    factors = _factors(random.normal(size=(len(means), 4)), scales)
    opacities = np.clip(random.uniform(0, 1, len(means)), 0.005, 0.995)
    focal_x, focal_y = K[0, 0] * width / original_width, K[1, 1] * height / original_height
    view = _view(T_camera_world, focal_x, focal_y, width, height)
    return _scene(view, means, factors, opacities, colors)


def _scale_for_radius(means: np.ndarray, factors: np.ndarray, focal: float) -> float:
    """Factor on all scales that makes the mean 3-sigma radius on the screen, blur included, `RADIUS`."""
    x, y, z = means.T
    jacobian = np.zeros((len(z), 2, 3))
    jacobian[:, 0, 0] = jacobian[:, 1, 1] = focal / z
    jacobian[:, 0, 2], jacobian[:, 1, 2] = -focal * x / z**2, -focal * y / z**2
    screen = jacobian @ factors
    covariance = screen @ screen.transpose(0, 2, 1)
    low, high = 1e-3, 10.0
    for _ in range(40):
        middle = np.sqrt(low * high)
        radius = 3 * np.sqrt(np.linalg.eigvalsh(middle**2 * covariance + 0.3 * np.eye(2))[:, 1])
        low, high = (middle, high) if radius.mean() < RADIUS else (low, middle)
    return middle


def _factors(quaternions: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """Factors L [M, 3, 3] of Sigma = L L^T, from quaternions [M, 4] of any length, w first, and deviations [M, 3]."""
    unit = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
    return rotation_matrices_3d(torch.from_numpy(unit.T)).permute(2, 0, 1).numpy() * scales[:, None, :]


def _view(T_camera_world: np.ndarray, focal_x: float, focal_y: float, width: int, height: int) -> View:
    K = torch.tensor([[focal_x, 0, width / 2], [0, focal_y, height / 2], [0, 0, 1]], dtype=torch.float32)
    return View("bench", 0, 0.0, torch.from_numpy(np.asarray(T_camera_world, np.float32)), K, width, height)


def _scene(view: View, means: np.ndarray, factors: np.ndarray, *more: np.ndarray) -> Scene:
    covariances = covariances_from_factors(torch.from_numpy(factors).permute(1, 2, 0)).numpy()
    parts = (torch.from_numpy(np.asarray(part, np.float32)) for part in (means, covariances, *more))
    return Scene._make([*parts, view])
