"""For the tests of the GPU kernels: scenes, what kernels and reference say about them, and the shim's launcher."""

from __future__ import annotations

import ctypes
import functools
from pathlib import Path
from typing import NamedTuple

import torch
from splat_scenes import near_edge_of
from torch import Tensor

from d2_plugin.compiler import load_library
from d2_plugin.protocol import DepthPrior, Label, RasterSettings, Render, Splats, Survey, View
from d2_plugin.rasterizer import autograd, cuda, reference

HERE = Path(__file__).parent / "rasterizer"
FORWARD_TOLERANCE, GRADIENT_TOLERANCE = 1e-4, 1e-3
THRESHOLD_MARGIN = 1e-4
"""Relative distance to alpha_min within which float32 may decide otherwise; 100 times that for transmittance_min."""


class ShimLauncher:
    """Runs the kernels on the CPU, with blocks, warps and lanes in an order of `cuda_shim.h`."""

    def __init__(self, order: int = 0) -> None:
        self.order = order
        self.launched: list[str] = []

    def launch(self, kernel: str, blocks: int, frame: cuda.Frame, rows: int = 1) -> None:
        self.launched.append(kernel)
        run = shim_library(frame.channels or 3).d2_shim_launch
        error = run(kernel.encode(), blocks, rows, self.order, ctypes.byref(frame))
        assert error is None, error.decode()


@functools.cache
def shim_library(channels: int) -> ctypes.CDLL:
    flags = (f"-DD2_CHANNELS={channels}", f"-DD2_FRAME_SIZE={ctypes.sizeof(cuda.Frame)}", "-ffp-contract=off")
    headers = (HERE / "cuda_shim.h", cuda.PROGRAM.source, *cuda.PROGRAM.headers)
    library = load_library("cuda-shim", (HERE / "cuda_shim.cpp",), headers, flags)
    library.d2_shim_launch.restype = ctypes.c_char_p
    library.d2_shim_stream.restype = ctypes.c_void_p
    return library


class Scene(NamedTuple):
    splats: Splats
    colors: Tensor
    view: View
    background: Tensor
    screen_offsets: Tensor
    settings: RasterSettings = RasterSettings()
    near_edge: Tensor | None = None

    def to(self, device: torch.device, dtype: torch.dtype) -> Scene:
        move = functools.partial(torch.Tensor.to, device=device, dtype=dtype)
        splats = Splats(*(move(part) for part in self.splats[:3]), self.splats.rows.to(device))
        view = View("0", 0, 0.0, move(self.view.T_camera_world), move(self.view.K), self.view.width, self.view.height)
        rest = map(move, (self.background, self.screen_offsets))
        edge = None if self.near_edge is None else move(self.near_edge)
        return Scene(splats, move(self.colors), view, *rest, self.settings, edge)


def make_scene(
    count: int = 300,
    width: int = 64,
    height: int = 48,
    channels: int = 3,
    seed: int = 0,
    scale: float = 0.06,
    opaque: bool = False,
    settings: RasterSettings = RasterSettings(),  # noqa: B008  a frozen value
) -> Scene:
    """Random anisotropic Gaussians before a slightly turned camera; some behind it and some beside the image."""
    generator = torch.Generator().manual_seed(seed)
    uniform = functools.partial(torch.rand, generator=generator)
    normal = functools.partial(torch.randn, generator=generator)
    depths = 1.0 + 5 * uniform(count)
    if not opaque:
        depths[::20] -= 6
    means = torch.stack([(uniform(count) - 0.5) * 1.5 * depths, (uniform(count) - 0.5) * 1.2 * depths, depths], 1)
    factors = normal(count, 3, 3) * (scale * torch.exp(0.5 * normal(count)))[:, None, None]
    full = factors @ factors.mT
    covariances = torch.stack([full[:, a, b] for a, b in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))], 1)
    opacities = torch.full((count,), 0.97) if opaque else 0.02 + 0.97 * uniform(count)
    angle = torch.tensor(0.1)
    T_camera_world = torch.eye(4)
    T_camera_world[0, 0] = T_camera_world[2, 2] = angle.cos()
    T_camera_world[0, 2], T_camera_world[2, 0] = angle.sin(), -angle.sin()
    T_camera_world[:3, 3] = torch.tensor([0.05, -0.1, 0.2])
    K = torch.tensor([[0.9 * width, 0, 0.52 * width], [0, 0.95 * width, 0.47 * height], [0, 0, 1]])
    splats = Splats(means, covariances, opacities, torch.arange(count))
    view = View("0", 0, 0.0, T_camera_world, K, width, height)
    offsets = 0.3 * normal(count, 2)
    return Scene(splats, uniform(count, channels), view, uniform(channels), offsets, settings)


def with_edge(scene: Scene, seed: int = 7) -> Scene:
    """The scene with a near edge, in front of some Gaussians and behind others."""
    return scene._replace(near_edge=near_edge_of(scene.view, seed))


def camera_of(scene: Scene) -> tuple:
    return scene.view.T_camera_world, scene.view.K, scene.near_edge


def inputs_of(scene: Scene) -> tuple:
    means, covariances, opacities, _ = scene.splats
    return means, covariances, opacities, scene.colors, scene.background, scene.screen_offsets


def render_kernels(scene: Scene, device: torch.device) -> tuple[Scene, tuple[Tensor, ...]]:
    """The scene in float32 on `device`, and what `cuda.rasterize` says."""
    scene = scene.to(device, torch.float32)
    size = (scene.view.width, scene.view.height)
    return scene, cuda.rasterize(*inputs_of(scene), *camera_of(scene), *size, autograd.constants_of(scene.settings))


def gradients_of_kernels(scene: Scene, device: torch.device, upstream: tuple[Tensor | None, ...]) -> tuple[Tensor, ...]:
    """Those of `cuda.backward`; upstream gradients that are not given, at the end, are absent."""
    scene, outputs = render_kernels(scene, device)
    given = [None if part is None else part.to(device, torch.float32) for part in upstream]
    given += [None] * (len(Render._fields) - len(given))
    return cuda.backward(*given, *inputs_of(scene), *camera_of(scene), autograd.constants_of(scene.settings), *outputs)


def reference_with_gradients(scene: Scene) -> tuple[Render, tuple[Tensor, ...], tuple]:
    """float64 outputs, random gradients of a loss with respect to them (0 near a cut-off), and those of the inputs."""
    scene = scene.to(torch.device("cpu"), torch.float64)
    inputs = [part.requires_grad_() for part in inputs_of(scene)]
    splats = Splats(*inputs[:3], scene.splats.rows)
    render = reference.rasterize(splats, inputs[3], scene.view, scene.settings, *inputs[4:], scene.near_edge)
    upstream = random_upstream(scene)
    return render, upstream, torch.autograd.grad(render[: len(upstream)], inputs, upstream)


def random_upstream(scene: Scene, seed: int = 5) -> tuple[Tensor, ...]:
    """Gradients of color, depth_sum, alpha and, with a near edge, front; 0 where float32 may decide otherwise."""
    generator = torch.Generator().manual_seed(seed)
    calm = ~near_a_cut_off(scene)
    color, depth_sum, alpha = (
        torch.randn(scene.colors.shape[1] + 2, *calm.shape, generator=generator)
        .double()
        .split((scene.colors.shape[1], 1, 1))
    )
    upstream = ((color * calm).permute(1, 2, 0).contiguous(), depth_sum[0] * calm, alpha[0] * calm)
    if scene.near_edge is None:
        return upstream
    return (*upstream, torch.randn(calm.shape, generator=generator).double() * calm)


@torch.no_grad()
def near_a_cut_off(scene: Scene) -> Tensor:
    """Pixels [H, W] where some alpha or transmittance is so near to its threshold that float32 may decide otherwise.

    Moving both thresholds by the margin changes the float64 image there.
    """
    scene = scene.to(torch.device("cpu"), torch.float64)
    seen, rest = [], (scene.colors[:, :1], scene.background[:1], scene.screen_offsets)
    for sign in (-1, 1):
        factor = 1 + sign * THRESHOLD_MARGIN
        alpha_min = scene.settings.alpha_min * factor
        least = scene.settings.transmittance_min * (1 + 100 * sign * THRESHOLD_MARGIN)
        for settings in (
            RasterSettings(**{**vars(scene.settings), "alpha_min": alpha_min}),
            RasterSettings(**{**vars(scene.settings), "transmittance_min": least}),
        ):
            seen.append(reference.rasterize(scene.splats, *rest[:1], scene.view, settings, *rest[1:]).alpha)
    return (torch.stack(seen) - seen[0]).abs().amax(0) > 1e-9


def relative_error(value: Tensor, expected: Tensor) -> float:
    return float((value.cpu().double() - expected).norm() / expected.norm().clamp(min=1e-30))


def assert_same_image(scene: Scene, outputs: tuple[Tensor, ...], render: Render) -> None:
    calm = ~near_a_cut_off(scene)
    assert calm.float().mean() > 0.8, "too few pixels away from the cut-offs to compare"
    assert (render.front is None) == (len(outputs[3]) == 0)
    for name, value, expected in zip(Render._fields, outputs, render):
        if expected is None:
            continue
        worst = (value.cpu().double() - expected.detach())[calm].abs().amax()
        assert worst < FORWARD_TOLERANCE, f"{name} is off by {worst:.2e}"


NAMES = ("means", "covariances", "opacities", "colors", "background", "screen_offsets")


def assert_same_gradients(found: tuple[Tensor, ...], expected: tuple[Tensor, ...]) -> None:
    for name, value, true in zip(NAMES, found, expected):
        assert torch.isfinite(value).all(), name
        error = relative_error(value, true)
        assert error < GRADIENT_TOLERANCE, f"gradient of {name} is off by {error:.2e}"


def make_prior(scene: Scene, seed: int = 3) -> DepthPrior:
    generator = torch.Generator().manual_seed(seed)
    size = (scene.view.height, scene.view.width)
    depth = 0.5 + 5 * torch.rand(size, generator=generator)
    labels = torch.randint(0, len(Label), size, generator=generator, dtype=torch.uint8)
    depth.view(-1)[:21:7] = torch.tensor([0.0, torch.nan, torch.inf])
    return DepthPrior(depth, labels)


def make_reliable(prior: DepthPrior, seed: int = 4) -> DepthPrior:
    """The prior with a reliability between 0 and 1, and numbers among them that say nothing."""
    r = torch.rand(prior.depth.shape, generator=torch.Generator().manual_seed(seed))
    r.view(-1)[1:28:9] = torch.tensor([0.0, torch.nan, torch.inf])
    return prior._replace(reliability=r)


def survey_kernels(scene: Scene, prior: DepthPrior, device: torch.device, eps: float = 1e-8) -> Survey:
    scene = scene.to(device, torch.float32)
    means, covariances, opacities, _ = scene.splats
    maps = (prior.depth.to(device), reference.reliability(prior).to(device), scene.near_edge)
    camera = (scene.view.T_camera_world, scene.view.K, autograd.constants_of(scene.settings))
    return cuda.survey(means, covariances, opacities, *maps, *camera, eps)
