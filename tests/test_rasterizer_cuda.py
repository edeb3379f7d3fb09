"""GPU kernels against the reference: the same .cu source on the CPU (fibre shim) and, where there is one, on a GPU.

`backend` runs every check twice: "shim" executes kernels and host code of `d2_plugin.rasterizer.cuda` on CPU tensors;
"cuda" (marker `cuda`) on the device. NVRTC, where it is installed, compiles the source for real architectures.
"""

from __future__ import annotations

import ctypes
import functools
import warnings
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from d2_plugin import D2Error
from d2_plugin.compiler import NoCompiler, load_library
from d2_plugin.protocol import DepthPrior, Label, RasterSettings, Render, Splats, Survey, View
from d2_plugin.rasterizer import cuda, native, ops, rasterize, reference, survey
from d2_plugin.rasterizer import cuda_runtime as runtime

HERE = Path(__file__).parent
FORWARD_TOLERANCE, GRADIENT_TOLERANCE = 1e-4, 1e-3
THRESHOLD_MARGIN = 1e-4
"""Relative distance to a cut-off (alpha_min, transmittance_min) within which float32 may decide otherwise."""


class ShimLauncher:
    """Runs the kernels on the CPU; `descending` runs warps and blocks in the opposite order."""

    def __init__(self, descending: bool = False) -> None:
        self.descending = descending
        self.launched: list[str] = []

    def launch(self, kernel: str, blocks: int, frame: cuda.Frame, rows: int = 1) -> None:
        self.launched.append(kernel)
        run = shim_library(frame.channels or 3).d2_shim_launch
        error = run(kernel.encode(), blocks, rows, self.descending, ctypes.byref(frame))
        assert error is None, error.decode()


@functools.cache
def shim_library(channels: int) -> ctypes.CDLL:
    flags = (f"-DD2_CHANNELS={channels}", f"-DD2_FRAME_SIZE={ctypes.sizeof(cuda.Frame)}", "-ffp-contract=off")
    headers = (HERE / "cuda_shim.h", cuda.SOURCE, *cuda.HEADERS)
    library = load_library("cuda-shim", (HERE / "cuda_shim.cpp",), headers, flags)
    library.d2_shim_launch.restype = ctypes.c_char_p
    library.d2_shim_stream.restype = ctypes.c_void_p
    return library


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """The pictures are too small for two: the reference would mostly wait."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(params=["shim", pytest.param("cuda", marks=pytest.mark.cuda)])
def backend(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> torch.device:
    """Where the tensors go; `cuda.launcher` is the shim's on the CPU."""
    if request.param == "cuda":
        if not torch.cuda.is_available():
            pytest.skip("no CUDA device (torch.cuda.is_available() is False)")
        return torch.device("cuda", 0)
    try:
        shim_library(3)
    except NoCompiler as error:
        pytest.skip(str(error))
    launcher = ShimLauncher()
    monkeypatch.setattr(cuda, "launcher", lambda device: launcher)
    return torch.device("cpu")


class Scene(NamedTuple):
    splats: Splats
    colors: Tensor
    view: View
    background: Tensor
    screen_offsets: Tensor
    settings: RasterSettings = RasterSettings()

    def to(self, device: torch.device, dtype: torch.dtype) -> Scene:
        move = functools.partial(torch.Tensor.to, device=device, dtype=dtype)
        splats = Splats(*(move(part) for part in self.splats[:3]), self.splats.rows.to(device))
        view = View("0", 0, 0.0, move(self.view.T_camera_world), move(self.view.K), self.view.width, self.view.height)
        rest = map(move, (self.background, self.screen_offsets))
        return Scene(splats, move(self.colors), view, *rest, self.settings)


def make_scene(
    count: int = 300,
    width: int = 64,
    height: int = 48,
    channels: int = 3,
    seed: int = 0,
    scale: float = 0.12,
    opaque: bool = False,
    settings: RasterSettings = RasterSettings(),  # noqa: B008  a frozen value
) -> Scene:
    """Random anisotropic Gaussians before a slightly turned camera; some behind it and some beside the image."""
    generator = torch.Generator().manual_seed(seed)
    uniform = functools.partial(torch.rand, generator=generator)
    normal = functools.partial(torch.randn, generator=generator)
    depths = 1.0 + 5 * uniform(count) if opaque else -0.5 + 6 * uniform(count)
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


def inputs_of(scene: Scene) -> tuple:
    means, covariances, opacities, _ = scene.splats
    return means, covariances, opacities, scene.colors, scene.background, scene.screen_offsets


def render_kernels(scene: Scene, device: torch.device) -> tuple[Scene, tuple[Tensor, ...]]:
    """The scene in float32 on `device`, and what `cuda.rasterize` says."""
    scene = scene.to(device, torch.float32)
    camera = (scene.view.T_camera_world, scene.view.K)
    size = (scene.view.width, scene.view.height)
    return scene, cuda.rasterize(*inputs_of(scene), *camera, *size, ops._constants(scene.settings))


def gradients_of_kernels(scene: Scene, device: torch.device, upstream: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    scene, outputs = render_kernels(scene, device)
    upstream = tuple(part.to(device, torch.float32) for part in upstream)
    camera = (scene.view.T_camera_world, scene.view.K, ops._constants(scene.settings))
    return cuda.backward(*upstream, *inputs_of(scene), *camera, *outputs)


def reference_with_gradients(scene: Scene) -> tuple[Render, tuple[Tensor, ...], tuple]:
    """float64 outputs, random gradients of a loss with respect to them (0 near a cut-off), and those of the inputs."""
    scene = scene.to(torch.device("cpu"), torch.float64)
    inputs = [part.requires_grad_() for part in inputs_of(scene)]
    splats = Splats(*inputs[:3], scene.splats.rows)
    render = reference.rasterize(splats, inputs[3], scene.view, scene.settings, *inputs[4:])
    upstream = random_upstream(scene)
    return render, upstream, torch.autograd.grad(render, inputs, upstream)


def random_upstream(scene: Scene, seed: int = 5) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients of color, depth_sum and alpha; 0 where float32 may decide otherwise."""
    generator = torch.Generator().manual_seed(seed)
    calm = ~near_a_cut_off(scene)
    color, depth_sum, alpha = torch.randn(scene.colors.shape[1] + 2, *calm.shape, generator=generator).double().split(
        (scene.colors.shape[1], 1, 1)
    )
    return (color * calm).permute(1, 2, 0).contiguous(), depth_sum[0] * calm, alpha[0] * calm


@torch.no_grad()
def near_a_cut_off(scene: Scene) -> Tensor:
    """Pixels [H, W] where some alpha or transmittance is so near to its threshold that float32 may decide otherwise.

    Moving both thresholds by the margin changes the float64 image there.
    """
    scene = scene.to(torch.device("cpu"), torch.float64)
    seen, rest = [], (scene.colors[:, :1], scene.background[:1], scene.screen_offsets)
    for sign in (-1, 1):
        factor = 1 + sign * THRESHOLD_MARGIN
        alpha_min, least = scene.settings.alpha_min * factor, scene.settings.transmittance_min * (1 + sign * 0.01)
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
    for name, value, expected in zip(Render._fields, outputs, render):
        worst = (value.cpu().double() - expected.detach())[calm].abs().amax()
        assert worst < FORWARD_TOLERANCE, f"{name} is off by {worst:.2e}"


NAMES = ("means", "covariances", "opacities", "colors", "background", "screen_offsets")


def assert_same_gradients(found: tuple[Tensor, ...], expected: tuple[Tensor, ...]) -> None:
    for name, value, true in zip(NAMES, found, expected):
        assert torch.isfinite(value).all(), name
        error = relative_error(value, true)
        assert error < GRADIENT_TOLERANCE, f"gradient of {name} is off by {error:.2e}"


@pytest.mark.parametrize("size", [(64, 48), (67, 41), (1, 1), (15, 33)], ids=lambda size: "{}x{}".format(*size))
def test_image_and_gradients_are_the_references_at_any_size(backend: torch.device, size: tuple[int, int]) -> None:
    scene = make_scene(300, *size)
    render, upstream, expected = reference_with_gradients(scene)
    _, outputs = render_kernels(scene, backend)
    assert_same_image(scene, outputs, render)
    assert_same_gradients(gradients_of_kernels(scene, backend, upstream), expected)


@pytest.mark.parametrize("channels", [1, 40])
def test_any_number_of_color_channels(backend: torch.device, channels: int) -> None:
    scene = make_scene(120, 40, 24, channels=channels)
    render, upstream, expected = reference_with_gradients(scene)
    _, outputs = render_kernels(scene, backend)
    assert_same_image(scene, outputs, render)
    assert_same_gradients(gradients_of_kernels(scene, backend, upstream), expected)


def test_many_opaque_layers_and_many_batches(backend: torch.device) -> None:
    """700 layers over a tile: three batches of the forward pass, eleven of the backward, most of them hidden."""
    scene = make_scene(700, 33, 17, scale=0.3, opaque=True)
    render, upstream, expected = reference_with_gradients(scene)
    assert render.alpha.min() > 0.99
    _, outputs = render_kernels(scene, backend)
    assert_same_image(scene, outputs, render)
    assert_same_gradients(gradients_of_kernels(scene, backend, upstream), expected)


def test_faint_layers_in_many_batches_all_count(backend: torch.device) -> None:
    scene = make_scene(600, 20, 20, scale=0.4, opaque=True)
    scene = scene._replace(splats=scene.splats._replace(opacities=torch.full((600,), 0.006)))
    render, upstream, expected = reference_with_gradients(scene)
    assert render.alpha.max() < 0.99
    _, (*outputs, _, lists) = render_kernels(scene, backend)
    assert len(lists) > 2 * 2 * cuda.THREADS
    assert_same_image(scene, tuple(outputs), render)
    assert_same_gradients(gradients_of_kernels(scene, backend, upstream), expected)


def test_without_gaussians_the_image_is_the_background(backend: torch.device) -> None:
    scene, (color, depth_sum, alpha, *_) = render_kernels(make_scene(0), backend)
    assert torch.equal(color, scene.background.expand_as(color))
    assert not depth_sum.any()
    assert not alpha.any()
    upstream = (torch.ones_like(color), torch.ones_like(alpha), torch.ones_like(alpha))
    *_, grad_background, grad_offsets = gradients_of_kernels(make_scene(0), backend, upstream)
    assert torch.equal(grad_background.cpu(), torch.full((3,), 64.0 * 48))
    assert grad_offsets.shape == (0, 2)


def test_gaussians_that_are_not_finite_are_left_out_with_zero_gradient(backend: torch.device) -> None:
    scene = make_scene(200)
    broken = torch.tensor([3, 50, 77, 120, 150])
    scene.splats.means[3, 1] = torch.nan
    scene.splats.covariances[50, 4] = torch.inf
    scene.splats.opacities[77] = torch.nan
    scene.colors[120, 2] = torch.nan
    scene.screen_offsets[150, 0] = -torch.inf
    render, upstream, expected = reference_with_gradients(scene)
    _, outputs = render_kernels(scene, backend)
    assert_same_image(scene, outputs, render)
    found = gradients_of_kernels(scene, backend, upstream)
    assert_same_gradients(found, expected)
    for value in (*found[:4], found[5]):
        assert not value[broken.to(backend)].any()


def test_gradients_outside_of_the_fov_clamp(backend: torch.device) -> None:
    """Long Gaussians whose centres lie far beside the image, where the Jacobian stands still."""
    scene = make_scene(60, settings=RasterSettings(fov_clamp=0.6), scale=0.3)
    render, upstream, expected = reference_with_gradients(scene)
    _, outputs = render_kernels(scene, backend)
    assert_same_image(scene, outputs, render)
    assert_same_gradients(gradients_of_kernels(scene, backend, upstream), expected)


@pytest.mark.parametrize("seed", range(3))
def test_extreme_gaussians_leave_everything_finite(backend: torch.device, seed: int) -> None:
    """Sizes, distances and elongations over thirty decades, opacities at both ends."""
    generator = torch.Generator().manual_seed(seed)
    draw = functools.partial(torch.rand, generator=generator)
    scene = make_scene(2000, 37, 21, seed=seed)
    sizes = 10 ** (-12 + 30 * draw(2000, 3))
    turns = torch.linalg.qr(torch.randn(2000, 3, 3, generator=generator)).Q * sizes[:, None]
    full = turns @ turns.mT
    covariances = torch.stack([full[:, a, b] for a, b in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))], 1)
    means = scene.splats.means * 10 ** (-3 + 9 * draw(2000, 1))
    opacities = torch.where(draw(2000) < 0.5, scene.splats.opacities, (draw(2000) < 0.5).float())
    scene = scene._replace(splats=Splats(means, covariances, opacities, scene.splats.rows))
    _, outputs = render_kernels(scene, backend)
    upstream = tuple(torch.ones_like(part) for part in outputs[:3])
    survey_of_it = survey_kernels(scene, make_prior(scene), backend)
    for value in (*outputs[:3], *gradients_of_kernels(scene, backend, upstream), *survey_of_it):
        assert torch.isfinite(value).all()


@pytest.mark.parametrize("given", range(3), ids=Render._fields)
def test_outputs_without_an_upstream_gradient_count_as_zero(backend: torch.device, given: int) -> None:
    scene = make_scene(100, 32, 32)
    upstream = random_upstream(scene)
    zeros = tuple(part * (i == given) for i, part in enumerate(upstream))
    expected = gradients_of_kernels(scene, backend, zeros)
    scene, outputs = render_kernels(scene, backend)
    absent = [part.to(backend, torch.float32) if i == given else None for i, part in enumerate(upstream)]
    camera = (scene.view.T_camera_world, scene.view.K, ops._constants(scene.settings))
    found = cuda.backward(*absent, *inputs_of(scene), *camera, *outputs)
    assert all(torch.equal(a, b) for a, b in zip(found, expected))


def test_equal_depths_are_drawn_in_the_order_of_indices(backend: torch.device) -> None:
    scene = make_scene(0, 16, 16)
    view = scene.view
    view.T_camera_world.copy_(torch.eye(4))
    covariance = torch.tensor([0.5, 0, 0, 0.5, 0, 0.5])
    means, opacities = torch.tensor([[0.0, 0, 2]]).repeat(3, 1), torch.full((3,), 0.5)
    splats = Splats(means, covariance.repeat(3, 1), opacities, torch.arange(3))
    scene = Scene(splats, torch.eye(3), view, torch.zeros(3), torch.zeros(3, 2))
    _, (color, *_) = render_kernels(scene, backend)
    first, second, third = color[8, 8]
    assert first > second > third > 0


def make_prior(scene: Scene, seed: int = 3) -> DepthPrior:
    generator = torch.Generator().manual_seed(seed)
    size = (scene.view.height, scene.view.width)
    depth = 0.5 + 5 * torch.rand(size, generator=generator)
    labels = torch.randint(0, 4, size, generator=generator, dtype=torch.uint8)
    depth.view(-1)[:21:7] = torch.tensor([0.0, torch.nan, torch.inf])
    return DepthPrior(depth, labels)


def survey_kernels(scene: Scene, prior: DepthPrior, device: torch.device, eps: float = 1e-8) -> Survey:
    scene = scene.to(device, torch.float32)
    means, covariances, opacities, _ = scene.splats
    maps = (prior.depth.to(device), prior.verified.to(device))
    camera = (scene.view.T_camera_world, scene.view.K, ops._constants(scene.settings))
    return cuda.survey(means, covariances, opacities, *maps, *camera, eps)


@pytest.mark.parametrize(
    "scene",
    [make_scene(300), make_scene(500, 37, 29, scale=0.3, opaque=True), make_scene(0)],
    ids=["random", "opaque", "empty"],
)
def test_survey_is_the_references(backend: torch.device, scene: Scene) -> None:
    scene = scene._replace(screen_offsets=torch.zeros_like(scene.screen_offsets))
    calm = ~near_a_cut_off(scene)
    prior = make_prior(scene)
    prior.labels[~calm] = Label.MONO
    prior.labels[calm] = torch.where(prior.labels[calm] == Label.MONO, Label.VERIFIED, prior.labels[calm])
    double = scene.to(torch.device("cpu"), torch.float64)
    expected = reference.survey(double.splats, double.view, prior, double.settings, 1e-8)
    found = survey_kernels(scene, prior, backend)
    assert torch.equal(found.hits.cpu(), expected.hits)
    for name in ("depth_sum", "alpha"):
        worst = (getattr(found, name).cpu() - getattr(expected, name))[calm].abs()
        assert not len(worst) or worst.amax() < FORWARD_TOLERANCE
    for name in ("weight", "error"):
        assert relative_error(getattr(found, name), getattr(expected, name)) < GRADIENT_TOLERANCE
    off = (found.max_weight.cpu() - expected.max_weight).abs() > FORWARD_TOLERANCE
    assert off.sum() <= 0.02 * len(off), "more than those whose maximum may lie at a cut-off"


def test_no_result_depends_on_the_order_of_warps_and_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = make_scene(400, 45, 37, scale=0.25)
    upstream = random_upstream(scene)
    results = []
    for descending in (False, True):
        launcher = ShimLauncher(descending)
        monkeypatch.setattr(cuda, "launcher", lambda device, launcher=launcher: launcher)
        cpu = torch.device("cpu")
        results.append((*gradients_of_kernels(scene, cpu, upstream), *survey_kernels(scene, make_prior(scene), cpu)))
        assert {"d2_project", "d2_list", "d2_render", "d2_backward", "d2_survey"} <= set(launcher.launched)
    assert all(torch.equal(a, b) for a, b in zip(*results))


def test_two_runs_give_the_same_bits(backend: torch.device) -> None:
    scene = make_scene(300)
    upstream = random_upstream(scene)
    runs = [gradients_of_kernels(scene, backend, upstream) for _ in range(2)]
    assert all(torch.equal(a, b) for a, b in zip(*runs))


def test_cpu_and_gpu_kernels_agree(backend: torch.device) -> None:
    if not native.available():
        pytest.skip("no C++ compiler for the CPU kernels")
    scene = make_scene(300)
    upstream = random_upstream(scene)
    single = scene.to(torch.device("cpu"), torch.float32)
    camera = (single.view.T_camera_world, single.view.K)
    constants = ops._constants(scene.settings)
    outputs = native.rasterize(*inputs_of(single), *camera, 64, 48, constants)
    assert_same_image(scene, render_kernels(scene, backend)[1], Render(*(part.double() for part in outputs[:3])))
    gradients = native.backward(*(part.float() for part in upstream), *inputs_of(single), *camera, constants, *outputs)
    found = gradients_of_kernels(scene, backend, upstream)
    assert_same_gradients(found, tuple(part.double() for part in gradients))


def test_a_skewed_camera_is_refused(backend: torch.device) -> None:
    scene = make_scene(10)
    scene.view.K[0, 1] = 0.5
    with pytest.raises(D2Error, match=r"K has skew 0\.5, expected 0"):
        render_kernels(scene, backend)


def test_more_pairs_than_slots_can_number_are_refused() -> None:
    ends = torch.tensor([5, 2**31])
    with pytest.raises(D2Error, match="2147483648 pairs of Gaussian and tile"):
        cuda._count_pairs(ends, torch.eye(3))


# ---------------------------------------------------------------------------------------------------- NVRTC


@pytest.fixture
def compiler() -> Iterator[runtime.Nvrtc]:
    try:
        yield runtime.nvrtc()
    except runtime.NoCuda as error:
        pytest.skip(str(error))


@pytest.mark.parametrize(("capability", "channels"), [(80, 3), (90, 3), (120, 3), (90, 1), (90, 40)])
def test_nvrtc_compiles_the_kernels_without_a_toolkit(
    compiler: runtime.Nvrtc, capability: int, channels: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("D2_CACHE", str(tmp_path))
    code, architecture = runtime.build(capability, channels)
    assert architecture == f"sm_{capability}"
    assert code.startswith(b"\x7fELF")
    for kernel in ("project", "list", "render", "backward", "gather", "project_backward", "survey", "gather_survey"):
        assert f"d2_{kernel}".encode() in code


def test_the_cache_serves_what_it_has_and_rebuilds_what_is_damaged(
    compiler: runtime.Nvrtc, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("D2_CACHE", str(tmp_path))
    first = runtime.build(90, 3)
    (entry,) = tmp_path.iterdir()
    compiled = []
    compile_kernels = runtime.Nvrtc.compile
    monkeypatch.setattr(runtime.Nvrtc, "compile", lambda *a: compiled.append(1) or compile_kernels(*a))
    assert runtime.build(90, 3) == first
    assert not compiled
    entry.write_bytes(entry.read_bytes()[:1000])
    assert runtime.build(90, 3) == first
    assert compiled
    runtime.build(90, 2)
    runtime.build(80, 3)
    assert len(list(tmp_path.iterdir())) == 3


def test_a_cache_that_cannot_be_written_only_costs_time(
    compiler: runtime.Nvrtc, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("D2_CACHE", str(tmp_path / "file" / "below"))
    assert runtime.build(90, 3).code.startswith(b"\x7fELF")
    assert "cannot use the cache" in caplog.text


def test_a_gpu_newer_than_nvrtc_gets_ptx_and_an_older_one_a_sentence(compiler: runtime.Nvrtc) -> None:
    known = compiler.architectures()
    assert compiler.architecture_for(999) == f"compute_{known[-1]}"
    assert b".target" in compiler.compile("compute_80", (*runtime.FLAGS, "-DD2_CHANNELS=3", frame_size()))
    with pytest.raises(runtime.NoCuda, match=rf"the GPU is sm_35, but NVRTC \d+\.\d+ compiles for sm_{known[0]}"):
        compiler.architecture_for(35)


def test_nvrtcs_own_words_are_in_the_error(compiler: runtime.Nvrtc) -> None:
    with pytest.raises(D2Error, match="Frame differs between"):
        compiler.compile("sm_90", (*runtime.FLAGS, "-DD2_CHANNELS=3", "-DD2_FRAME_SIZE=1"))


def frame_size() -> str:
    return f"-DD2_FRAME_SIZE={ctypes.sizeof(cuda.Frame)}"


def test_without_nvrtc_the_message_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runtime, "_nvrtc_files", lambda: iter(()))
    monkeypatch.setattr(runtime.ctypes, "CDLL", no_library)
    with pytest.raises(runtime.NoCuda, match=r"NVRTC.*not found: run `pip install 'd2-4dgs\[cuda\]'`"):
        runtime.Nvrtc()


def test_without_a_driver_splatting_falls_back_with_one_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runtime.ctypes, "CDLL", no_library)
    cuda.launcher.cache_clear()
    cuda.available.cache_clear()
    with pytest.warns(UserWarning, match=r"NVIDIA driver .* not found.* plain torch"):
        assert not cuda.available(torch.device("cuda", 7))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not cuda.available(torch.device("cuda", 7))
    cuda.available.cache_clear()


def no_library(*_: object, **__: object) -> None:
    raise OSError("no such library")


@pytest.fixture
def driver(compiler: runtime.Nvrtc, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> ctypes.CDLL:
    """The shim's CUDA driver in place of the real one, with stream 77 current."""
    try:
        shim = shim_library(3)
    except NoCompiler as error:
        pytest.skip(str(error))
    monkeypatch.setenv("D2_CACHE", str(tmp_path))
    monkeypatch.setattr(runtime, "_load_driver", lambda: shim)
    monkeypatch.setattr(torch.cuda, "init", lambda: None)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: (9, 0))
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: SimpleNamespace(cuda_stream=77))
    return shim


def test_the_launcher_talks_to_the_driver(driver: ctypes.CDLL, monkeypatch: pytest.MonkeyPatch) -> None:
    """Context, module, functions, frame and stream arrive; the kernels themselves run in the shim."""
    launcher = runtime.CudaLauncher(torch.device("cuda", 0))
    monkeypatch.setattr(cuda, "launcher", lambda device: launcher)
    scene = make_scene(100, 32, 32)
    render, upstream, expected = reference_with_gradients(scene)
    cpu = torch.device("cpu")
    assert_same_image(scene, render_kernels(scene, cpu)[1], render)
    assert_same_gradients(gradients_of_kernels(scene, cpu, upstream), expected)
    assert survey_kernels(scene, make_prior(scene), cpu).hits.any()
    assert driver.d2_shim_stream() == 77
    assert driver.d2_shim_contexts() == 0


def test_a_driver_that_refuses_the_kernels_is_named(driver: ctypes.CDLL, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runtime, "build", lambda *_: runtime.Binary(b"no cubin", "sm_90"))
    with pytest.raises(runtime.NoCuda, match=r"refuses kernels for sm_90 .*NO_BINARY.*: update the NVIDIA driver"):
        runtime.CudaLauncher(torch.device("cuda", 0))
    assert driver.d2_shim_contexts() == 0


# ---------------------------------------------------------------------------------------------------- the device


@pytest.mark.cuda
def test_the_device_decides(monkeypatch: pytest.MonkeyPatch) -> None:
    """The public functions on CUDA tensors: kernels, not the reference; autograd; opcheck; a prior left on the CPU."""
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device (torch.cuda.is_available() is False)")
    monkeypatch.setattr(reference, "rasterize", None)
    monkeypatch.setattr(reference, "survey", None)
    device = torch.device("cuda", 0)
    scene = make_scene(300).to(device, torch.float32)
    inputs = [part.requires_grad_() for part in inputs_of(scene)]
    splats = Splats(*inputs[:3], scene.splats.rows)
    render = rasterize(splats, inputs[3], scene.view, background=inputs[4], screen_offsets=inputs[5])
    upstream = [torch.randn_like(part) for part in render]
    found = torch.autograd.grad(render, inputs, upstream)
    assert all(part.is_cuda and torch.isfinite(part).all() for part in found)
    expected = gradients_of_kernels(make_scene(300), device, tuple(upstream))
    assert all(torch.equal(a, b) for a, b in zip(found, expected))
    assert survey(splats, scene.view, make_prior(make_scene(300))).hits.is_cuda
    camera = (scene.view.T_camera_world, scene.view.K, 64, 48, ops._constants(RasterSettings()))
    torch.library.opcheck(torch.ops.d2.rasterize.default, (*inputs, *camera))


@pytest.mark.cuda
def test_work_goes_to_the_current_stream() -> None:
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device (torch.cuda.is_available() is False)")
    device = torch.device("cuda", 0)
    scene = make_scene(300)
    _, expected = render_kernels(scene, device)
    torch.cuda.synchronize()
    with torch.cuda.stream(torch.cuda.Stream(device)):
        _, found = render_kernels(scene, device)
        same = [torch.equal(a, b) for a, b in zip(found, expected)]
    assert all(same[:3])
