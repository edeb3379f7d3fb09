"""For the rasterizer's tests: random Gaussians and cameras, the paths that draw them, the definition in NumPy."""

from __future__ import annotations

import ctypes
import functools
import math
from pathlib import Path as File
from typing import NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor

from d2_plugin.compiler import NoCompiler, find_compiler, load_library
from d2_plugin.protocol import DepthPrior, Label
from d2_plugin.rasterizer import RasterSettings, Render, Splats, View, autograd, cuda, rasterize, reference

HERE = File(__file__).parent / "rasterizer"
CPU = torch.device("cpu")


class Path(NamedTuple):
    """Who draws: torch in float64, the CPU's kernels, or the GPU's, in the fibre shim or on a device."""

    dtype: torch.dtype
    device: torch.device = CPU


def path_of(name: str, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The path `torch`, `cpu`, `shim` or `cuda`; skips the test where this machine lacks it."""
    if name == "torch":
        return Path(torch.float64)
    if name == "cuda":
        if not torch.cuda.is_available():
            pytest.skip("no CUDA device (torch.cuda.is_available() is False)")
        return Path(torch.float32, torch.device("cuda", 0))
    try:
        find_compiler()
    except NoCompiler as error:
        pytest.skip(str(error))
    if name == "shim":
        use_shim(monkeypatch, ShimLauncher())
    return Path(torch.float32)


def use_shim(monkeypatch: pytest.MonkeyPatch, launcher: cuda.Launcher) -> None:
    """Let float32 on the CPU run the GPU's kernels, by this launcher."""
    monkeypatch.setattr(autograd, "_kernels", lambda part: cuda)
    monkeypatch.setattr(cuda, "launcher", lambda device: launcher)


class ShimLauncher:
    """Runs the kernels on the CPU, with blocks, warps and lanes in an order of `cuda_shim.h`."""

    def __init__(self, order: int = 0) -> None:
        self.order = order
        self.launched: set[str] = set()

    def launch(self, kernel: str, blocks: int, frame: cuda.Frame, rows: int = 1) -> None:
        self.launched.add(kernel)
        run = shim_library(frame.channels or 3).d2_shim_launch
        error = run(kernel.encode(), blocks, rows, self.order, ctypes.byref(frame))
        assert error is None, error.decode()


@functools.cache
def shim_library(channels: int) -> ctypes.CDLL:
    flags = (f"-DD2_CHANNELS={channels}", f"-DD2_FRAME_SIZE={ctypes.sizeof(cuda.Frame)}", "-ffp-contract=off", "-O1")
    headers = (HERE / "cuda_shim.h", cuda.PROGRAM.source, *cuda.PROGRAM.headers)
    library = load_library("cuda-shim", (HERE / "cuda_shim.cpp",), headers, flags)
    library.d2_shim_launch.restype = ctypes.c_char_p
    library.d2_shim_stream.restype = ctypes.c_void_p
    return library


class Scene(NamedTuple):
    means: Tensor
    covariances: Tensor
    opacities: Tensor
    colors: Tensor
    view: View

    @property
    def splats(self) -> Splats:
        return Splats(*self[:3], torch.arange(len(self.means)))

    @property
    def size(self) -> tuple[int, int]:
        return self.view.height, self.view.width

    def on(self, path: Path) -> Scene:
        view = self.view
        pose, K = (part.to(path.device) for part in (view.T_camera_world, view.K))
        view = View(view.camera, view.frame, view.time, pose, K, view.width, view.height)
        return Scene(*(part.to(path.device, path.dtype) for part in self[:4]), view)

    def requires_grad(self) -> Scene:
        return Scene(*(part.detach().clone().requires_grad_() for part in self[:4]), self.view)

    def render(self, settings: RasterSettings = RasterSettings(), **options: Tensor | None) -> Render:  # noqa: B008
        return rasterize(self.splats, self.colors, self.view, settings, **options)

    def turned(self) -> Scene:
        """The same scene in another world frame, so that the camera is neither at the origin nor straight."""
        cos, sin = math.cos(0.7), math.sin(0.7)
        R = torch.tensor([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]], dtype=self.means.dtype)
        t = torch.tensor([0.3, -2.0, 5.0], dtype=self.means.dtype)
        full = R.T @ self.covariances[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].view(-1, 3, 3) @ R
        pose = torch.eye(4, dtype=self.means.dtype)
        pose[:3, :3], pose[:3, 3] = R, t
        view = View("cam", 0, 0.0, pose, self.view.K, self.view.width, self.view.height)
        return Scene((self.means - t) @ R, packed(full), self.opacities, self.colors, view)


def packed(full: Tensor) -> Tensor:
    """Matrices [M, 3, 3] as their six numbers."""
    return full[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]


def make_view(width: int, height: int, focal: float | None = None) -> View:
    """A camera at the origin that looks along z."""
    focal = 0.85 * width if focal is None else focal
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return View("cam", 0, 0.0, torch.eye(4), K, width, height)


def covariance(scales: Tensor, generator: torch.Generator) -> Tensor:
    """Covariances [M, 6] with standard deviations `scales` [M, 3] in random directions."""
    axes = torch.linalg.qr(torch.randn(len(scales), 3, 3, dtype=scales.dtype, generator=generator))[0]
    return packed((axes * scales[:, None] ** 2) @ axes.mT)


def random_scene(seed: int, count: int, width: int, height: int, channels: int = 3, radius: float = 3.0) -> Scene:
    """Gaussians of about `radius` pixels in and around the view, float64 numbers that float32 holds exactly."""
    g = torch.Generator().manual_seed(seed)
    view = make_view(width, height)
    focal = float(view.K[0, 0])
    depth = 1 + 4 * torch.rand(count, generator=g, dtype=torch.float64)
    across = (torch.rand(count, 2, generator=g, dtype=torch.float64) - 0.5) * 1.2
    means = torch.cat([across * torch.tensor([width, height]) / focal * depth[:, None], depth[:, None]], 1)
    spread = torch.exp(0.5 * torch.randn(count, 3, generator=g, dtype=torch.float64)) * radius / focal / 2
    parts = (
        means,
        covariance(spread * depth[:, None], g),
        torch.rand(count, generator=g, dtype=torch.float64) * 0.98 + 0.01,
        torch.rand(count, channels, generator=g, dtype=torch.float64),
    )
    return Scene(*(part.float().double() for part in parts), view)


def single(depth: float = 4.0, opacity: float = 0.5, variance: float = 0.01, size: int = 15) -> Scene:
    """One round Gaussian in front of the middle pixel of a square image."""
    numbers = ([[0.0, 0, depth]], [[variance, 0, 0, variance, 0, variance]], [opacity], [[1.0, 0.5, 0.25]])
    return Scene(*(torch.tensor(part, dtype=torch.float64) for part in numbers), make_view(size, size))


def near_edge_of(view: View, seed: int = 3) -> Tensor:
    """Near edges [H, W] of a prior, float32, among the Gaussians of `random_scene`; one in three is unknown or odd."""
    g = torch.Generator().manual_seed(seed)
    edge = 0.5 + 6 * torch.rand(view.height, view.width, generator=g)
    odd = torch.tensor([math.nan, math.inf, -math.inf, -1.0, 1e-3, 1e6, 1e-35])
    flat = edge.view(-1)
    flat[::3] = 0
    places = flat[1::5][: len(odd)]
    places.copy_(odd[: len(places)])
    return edge.to(view.K.device)


def prior_of(view: View, reliable: bool = False, seed: int = 1) -> DepthPrior:
    """A prior of random depths and labels, with a reliability where asked, and numbers among them that say nothing."""
    g = torch.Generator().manual_seed(seed)
    depth, r = 1 + 4 * torch.rand(2, view.height, view.width, generator=g)
    odd = torch.tensor([math.nan, math.inf, 0.0])
    for part, step in ((depth, 7), (r, 9)):
        places = part.view(-1)[::step][: len(odd)]
        places.copy_(odd[: len(places)])
    labels = torch.randint(0, len(Label), depth.shape, generator=g, dtype=torch.uint8)
    return DepthPrior(depth, labels, reliability=(r - 1) / 4 if reliable else None)


class Fragments(NamedTuple):
    """Everything that Gaussian i (in front-to-back order, `order`) does at every pixel, by the definition."""

    weights: np.ndarray  # [M, H, W] in the order of the scene
    unclamped: np.ndarray  # [M, H, W] o G; 0 where the pixel was finished before
    after: np.ndarray  # [M, H, W] transmittance that it would leave behind it; 1 where it is skipped or comes too late
    depths: np.ndarray  # [M]

    def front(self, near_edge: Tensor) -> np.ndarray:
        """w max(0, 1 - z / D_near) [M, H, W], 0 where nothing is known."""
        edge = near_edge.double().numpy()
        known = np.isfinite(edge) & (edge > 1e-30)
        return self.weights * np.maximum(0, 1 - self.depths[:, None, None] / np.where(known, edge, 1)) * known

    def away(self, settings: RasterSettings = RasterSettings()) -> Tensor:  # noqa: B008
        """Pixels [H, W] where rounding decides nothing: no alpha and no transmittance is at its threshold."""
        at_alpha = np.abs(self.unclamped / settings.alpha_min - 1) < 1e-4
        at_end = np.abs(self.after / settings.transmittance_min - 1) < 1e-3
        return torch.from_numpy(~(at_alpha | at_end).any(0))


def brute_force(scene: Scene, settings: RasterSettings = RasterSettings()) -> Fragments:  # noqa: B008
    """The image formation model with explicit matrices, in numpy float64, one Gaussian at a time."""
    means, covariances, opacities = (part.detach().double().numpy() for part in scene[:3])
    view = scene.view
    pose, K = view.T_camera_world.double().numpy(), view.K.double().numpy()
    points = means @ pose[:3, :3].T + pose[:3, 3]
    shape = (len(means), view.height, view.width)
    weights, unclamped, after = np.zeros(shape), np.zeros(shape), np.ones(shape)
    rows, columns = np.mgrid[: view.height, : view.width] + 0.5
    transmittance, finished = np.ones(shape[1:]), np.zeros(shape[1:], bool)
    for i in np.argsort(points[:, 2], kind="stable"):
        x, y, z = points[i]
        if z <= settings.near:
            continue
        screen = _screen_covariance(covariances[i], pose[:3, :3], points[i], view, settings)
        inverse, share = np.linalg.inv(screen), 1.0
        if settings.antialiased:
            own = np.linalg.det(screen - settings.blur * np.eye(2)) / np.linalg.det(screen)
            share = math.sqrt(max(own, reference.LEAST_AREA))
        dx, dy = columns - (K[0, 0] * x / z + K[0, 2]), rows - (K[1, 1] * y / z + K[1, 2])
        power = inverse[0, 0] * dx**2 + 2 * inverse[0, 1] * dx * dy + inverse[1, 1] * dy**2
        unclamped[i] = np.where(finished, 0, share * opacities[i] * np.exp(-power / 2))
        alpha = np.where(unclamped[i] < settings.alpha_min, 0, np.minimum(unclamped[i], settings.alpha_max))
        after[i] = np.where(alpha > 0, transmittance * (1 - alpha), 1)
        finished |= after[i] <= settings.transmittance_min
        weights[i] = np.where(finished, 0, alpha * transmittance)
        transmittance = np.where(finished | (alpha == 0), transmittance, after[i])
    return Fragments(weights, unclamped, after, points[:, 2])


def _screen_covariance(
    covariances: np.ndarray, R: np.ndarray, point: np.ndarray, view: View, settings: RasterSettings
) -> np.ndarray:
    xx, xy, xz, yy, yz, zz = covariances
    world, K = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]), view.K.double().numpy()
    limits = []
    for slope, size, focal, middle in zip(point[:2] / point[2], (view.width, view.height), K.diagonal(), K[:, 2]):
        centre, half = (size / 2 - middle) / focal, settings.fov_clamp * size / 2 / focal
        limits.append(np.clip(slope, centre - half, centre + half))
    jacobian = np.array([[K[0, 0], 0, -K[0, 0] * limits[0]], [0, K[1, 1], -K[1, 1] * limits[1]]]) / point[2]
    return jacobian @ R @ world @ R.T @ jacobian.T + settings.blur * np.eye(2)
