"""The kernels of the CPU and of the GPU against the reference in float64; nothing about threads or order changes them.

The GPU's run on the CPU (`shim`: the same .cu source and host code) and, where there is one, on a device (`cuda`).
"""

import functools
import os
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path as File

import pytest
import torch
from refusals import refuses
from splat_scenes import Path, Scene, ShimLauncher, brute_force, near_edge_of, path_of, prior_of, random_scene, use_shim

from d2_plugin.protocol import Label
from d2_plugin.rasterizer import RasterSettings, Render, Splats, cuda, native, rasterize, reference, survey

pytestmark = pytest.mark.usefixtures("compiler")
NAMES = ("means", "covariances", "opacities", "colors", "background", "screen_offsets")
REFERENCE = Path(torch.float64)


def behind() -> Scene:
    """Some Gaussians behind a turned camera, some beside the image."""
    scene = random_scene(6, 200, 40, 40)
    scene.means[::20] *= -1
    scene.means[1::20, 0] += 100
    return scene.turned()


def layers(count: int, opacity: float) -> Scene:
    """Many over each tile: several batches of the forward pass and of the backward."""
    scene = random_scene(7, count, 17, 16, radius=60.0)
    return scene._replace(opacities=torch.full_like(scene.opacities, opacity))


SCENES = {
    "small Gaussians": lambda: random_scene(0, 200, 49, 37),
    "a third of a pixel": lambda: random_scene(3, 200, 33, 37, radius=0.3),
    "large Gaussians, early finish": lambda: random_scene(1, 120, 50, 30, radius=40.0),
    "a turned camera, some behind it": behind,
    "many opaque layers": lambda: layers(700, 0.97),
    "many faint layers": lambda: layers(600, 0.006),
    "one channel": lambda: random_scene(2, 100, 33, 20, channels=1),
    "five channels": lambda: random_scene(3, 100, 20, 33, channels=5),
    "forty channels": lambda: random_scene(3, 40, 33, 20, channels=40),
    "one pixel": lambda: random_scene(4, 30, 1, 1),
}

PLAIN, SMOOTH = RasterSettings(), RasterSettings(antialiased=True)


def with_gradients(
    scene: Scene, path: Path, edge: bool, settings: RasterSettings = PLAIN, calm: torch.Tensor | None = None
) -> tuple[Render, list[torch.Tensor]]:
    """The image, and gradients of a random sum of its pixels that are `calm`, by default all, in float64 on the CPU."""
    leaves = scene.on(path).requires_grad()
    background = torch.linspace(0.2, 0.9, scene.colors.shape[1]).to(leaves.means).requires_grad_()
    offsets = torch.zeros_like(leaves.means[:, :2], requires_grad=True)
    near_edge = near_edge_of(scene.view).to(path.device) if edge else None
    render = leaves.render(settings, background=background, screen_offsets=offsets, near_edge=near_edge)
    g, loss = torch.Generator().manual_seed(0), 0
    for part in render[: 3 + edge]:
        weight = torch.randn(part.shape, generator=g)
        weight *= 1 if calm is None else calm.view(*scene.size, *[1] * (part.ndim - 2))
        loss = loss + (part * weight.to(part)).sum()
    gradients = torch.autograd.grad(loss, (*leaves[:4], background, offsets))
    assert all(gradient.dtype == path.dtype for gradient in gradients)
    return render, [gradient.cpu().double() for gradient in gradients]


@functools.cache
def calm_scene(name: str, settings: RasterSettings) -> tuple[Scene, torch.Tensor]:
    """A scene, and its pixels where rounding decides nothing."""
    scene = SCENES[name]()
    calm = brute_force(scene, settings).away(settings)
    assert calm.double().mean() > 0.8, "most pixels must count"
    return scene, calm


@functools.cache
def exact_gradients(name: str, settings: RasterSettings, edge: bool) -> tuple[Render, list[torch.Tensor]]:
    scene, calm = calm_scene(name, settings)
    return with_gradients(scene, REFERENCE, edge, settings, calm)


@pytest.mark.parametrize(("settings", "edge"), [(PLAIN, False), (SMOOTH, True)], ids=["", "antialiased-edge"])
@pytest.mark.parametrize("name", SCENES)
def test_image_and_gradients_are_the_references(kernels: Path, name: str, settings: RasterSettings, edge: bool) -> None:
    scene, calm = calm_scene(name, settings)
    fast, gradients = with_gradients(scene, kernels, edge, settings, calm)
    exact, expected = exact_gradients(name, settings, edge)
    assert (fast.front is not None) == (exact.front is not None) == edge
    for part, other in zip(fast[: 3 + edge], exact):
        assert part.dtype == torch.float32
        assert (part.cpu().double() - other)[calm].abs().max() < 1e-4
    for part, gradient, other in zip(NAMES, gradients, expected):
        assert (gradient - other).norm() <= 1e-3 * other.norm() + 1e-6, part


@pytest.mark.parametrize("settings", [PLAIN, SMOOTH], ids=["", "reliability-antialiased-edge"])
@pytest.mark.parametrize("name", SCENES)
def test_survey_is_the_references(kernels: Path, name: str, settings: RasterSettings) -> None:
    reliable = edge = settings is SMOOTH
    scene, calm = calm_scene(name, settings)
    prior = prior_of(scene.view, reliable)
    prior.labels[~calm] = Label.MONO
    near_edge = near_edge_of(scene.view) if edge else None
    for part in (near_edge, prior.reliability):
        if part is not None:
            part[~calm] = 0
    exact = survey(scene.splats, scene.view, prior, settings, near_edge=near_edge)
    there = scene.on(kernels)
    fast = survey(there.splats, there.view, prior, settings, near_edge=near_edge)
    fast = type(fast)(*(part.cpu() for part in fast))
    assert edge or not fast.front.any()
    assert fast.hits.dtype == torch.int32
    assert torch.equal(fast.hits, exact.hits)
    for sums in ("weight", "error", "front"):
        torch.testing.assert_close(getattr(fast, sums).double(), getattr(exact, sums), rtol=1e-4, atol=2e-4)
    for map_ in ("depth_sum", "alpha"):
        assert (getattr(fast, map_).double() - getattr(exact, map_))[calm].abs().max() < 1e-4
    off = (fast.max_weight.double() - exact.max_weight).abs() > 1e-4
    assert off.sum() <= 0.02 * len(off), "more than those whose maximum may lie at a cut-off"


@pytest.mark.parametrize("used", range(4), ids=Render._fields)
def test_any_one_output_alone_has_its_gradient(kernels: Path, used: int) -> None:
    found = []
    for path in (kernels, REFERENCE):
        leaves = random_scene(10, 80, 25, 25).on(path).requires_grad()
        render = leaves.render(near_edge=near_edge_of(leaves.view))
        found.append([part.cpu() for part in torch.autograd.grad(render[used].sum(), leaves[:3])])
    for gradient, other in zip(*found):
        assert (gradient.double() - other).norm() <= 1e-3 * other.norm()


def everything(scene: Scene, path: Path = Path(torch.float32)) -> list[torch.Tensor]:  # noqa: B008  a frozen value
    """Image, gradients and surveys."""
    render, gradients = with_gradients(scene, path, edge=True)
    there, edge = scene.on(path), near_edge_of(scene.view)
    surveys = [survey(there.splats, there.view, prior_of(scene.view, r), near_edge=edge) for r in (False, True)]
    return [part.detach().cpu() for part in (*render, *gradients, *surveys[0], *surveys[1])]


def test_the_number_of_threads_changes_no_bit(same_for_any_threads: Callable) -> None:
    scene = random_scene(7, 2000, 150, 70)
    same_for_any_threads(lambda: everything(scene))


def test_the_order_of_blocks_warps_and_lanes_changes_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, results = random_scene(8, 200, 45, 37, radius=12.0), []
    for order in range(3):  # as they are numbered, in the opposite order, at random
        use_shim(monkeypatch, launcher := ShimLauncher(order))
        results.append(everything(scene))
        assert {"d2_backward_front", "d2_survey_front"} <= launcher.launched
    for other in results[1:]:
        assert all(torch.equal(*pair) for pair in zip(results[0], other))


def test_calls_from_several_python_threads_do_not_disturb_each_other() -> None:
    scenes = [random_scene(seed, 500, 80, 60) for seed in range(3)]
    expected = [everything(scene) for scene in scenes]
    with ThreadPoolExecutor(3) as threads:
        for parts, others in zip(threads.map(everything, scenes * 3), expected * 3):
            assert all(torch.equal(*pair) for pair in zip(parts, others))


@pytest.fixture(params=["-march=x86-64-v3", "-march=x86-64"])
def other_instructions(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The CPU's kernels, compiled for fewer lanes than this machine may have."""
    if os.uname().machine != "x86_64":
        pytest.skip("flags of x86")
    if "v3" in request.param and "avx512f" not in File("/proc/cpuinfo").read_text():
        pytest.skip("no AVX-512 here: what this machine's own kernels have is no wider")
    monkeypatch.setenv("D2_CXXFLAGS", request.param)
    native.library.cache_clear()
    yield Path(torch.float32)
    native.library.cache_clear()


def test_other_instruction_sets_agree_with_the_reference(other_instructions: Path) -> None:
    for name in ("one channel", "one pixel", "five channels"):
        for settings in (PLAIN, SMOOTH):
            test_image_and_gradients_are_the_references(other_instructions, name, settings, settings is SMOOTH)
            test_survey_is_the_references(other_instructions, name, settings)


def test_inputs_need_not_be_contiguous_and_gradients_may_be_expanded(kernels: Path) -> None:
    scene = random_scene(9, 100, 30, 30).on(kernels)
    strided = Scene(
        scene.means.T.contiguous().T,
        scene.covariances.flip(0).flip(0),
        torch.stack([scene.opacities, scene.opacities], 1)[:, 0],
        scene.colors.T.contiguous().T,
        scene.view,
    ).requires_grad()
    plain = scene.requires_grad()
    for leaves in (strided, plain):
        leaves.render().color.sum().backward()
    assert all(torch.equal(part.grad, other.grad) for part, other in zip(strided[:4], plain[:4]))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_torch_compile_leaves_it_as_it_is() -> None:
    scene = random_scene(12, 40, 20, 18).on(Path(torch.float32)).requires_grad()
    edge = near_edge_of(scene.view)

    def loss(means, covariances, opacities, colors):
        splats = Splats(means, covariances, opacities, torch.arange(40))
        render = rasterize(splats, colors, scene.view, near_edge=edge)
        return (render.color.sin() + (render.alpha + render.front)[..., None]).sum()

    expected = torch.autograd.grad(loss(*scene[:4]), scene[:4])
    compiled = torch.compile(loss, backend="aot_eager")
    found = torch.autograd.grad(compiled(*scene[:4]), scene[:4])
    for part, other in zip(found, expected):
        torch.testing.assert_close(part, other)


def test_without_a_compiler_the_torch_path_takes_over_with_one_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = random_scene(14, 50, 20, 20).on(Path(torch.float32))
    native.library.cache_clear()
    native.available.cache_clear()
    with monkeypatch.context() as patch, warnings.catch_warnings(record=True) as caught:
        patch.setenv("CXX", "no-such-compiler")
        warnings.simplefilter("always")
        slow = scene.render()
        scene.render()
        (message,) = [str(warning.message) for warning in caught]
        assert "no-such-compiler" in message
        assert "orders of magnitude slower" in message
    native.available.cache_clear()
    torch.testing.assert_close(slow.color, scene.render().color, atol=1e-5, rtol=0)


def test_an_image_as_wide_as_a_panorama_has_its_gaussians_in_place(kernels: Path) -> None:
    scene = random_scene(0, 1, 5000, 3)
    scene.means[0] = torch.tensor([2 * 2400.5 / 4250, 0, 2])  # two units before a camera of that focal length
    alpha = scene.on(kernels).render().alpha.cpu()
    assert alpha.argmax().item() == 5000 + 4900
    torch.testing.assert_close(alpha.double(), scene.render().alpha, atol=1e-4, rtol=0)


NO_MEMORY = """
import contextlib, torch, resource as system
from d2_plugin.rasterizer import Splats, View, rasterize
splats = Splats(torch.tensor([[0, 0, 2.0]]), torch.tensor([[1.0, 0, 0, 1, 0, 1]]), torch.ones(1), torch.arange(1))
view = View("cam", 0, 0.0, torch.eye(4), torch.tensor([[30.0, 0, 60], [0, 30, 1], [0, 0, 1]]), 120, 2)
torch.set_default_device("meta")  # where nothing of a scene on the CPU may lie
rasterize(splats, torch.ones(1, 3, device="cpu"), view)
used = system.getpagesize() * int(open("/proc/self/statm").read().split()[0])
system.setrlimit(system.RLIMIT_AS, (used + 2**30,) * 2)
for channels in (400_000, 390_000, 5):
    with contextlib.suppress(MemoryError):
        print(channels, rasterize(splats, torch.ones(1, channels, device="cpu"), view).alpha.max().item())
"""


@pytest.mark.skipif(not File("/proc/self/statm").exists(), reason="the system does not say what a process takes")
@pytest.mark.usefixtures("compiler")
def test_a_call_without_memory_says_so_and_the_next_one_draws() -> None:
    done = subprocess.run([sys.executable, "-c", NO_MEMORY], capture_output=True, text=True, timeout=600, check=True)
    assert done.stdout.startswith("5 0.99")


def test_more_pairs_than_slots_can_number_are_refused() -> None:
    refuses("2147483648 pairs of Gaussian and tile", cuda._count_pairs, torch.tensor([5, 2**31]), torch.eye(3))


@pytest.mark.cuda
def test_on_a_device_its_kernels_draw_on_the_current_stream_and_a_prior_may_lie_on_the_cpu(monkeypatch) -> None:
    path = path_of("cuda", monkeypatch)
    monkeypatch.setattr(reference, "rasterize", None)
    monkeypatch.setattr(reference, "survey", None)
    scene = random_scene(0, 250, 61, 37)
    expected = everything(scene, path)
    torch.cuda.synchronize()
    with torch.cuda.stream(torch.cuda.Stream(path.device)):
        found = everything(scene, path)
    assert all(torch.equal(*pair) for pair in zip(found, expected))
    there = scene.on(path)
    assert survey(there.splats, there.view, prior_of(scene.view), near_edge=near_edge_of(scene.view)).hits.is_cuda
