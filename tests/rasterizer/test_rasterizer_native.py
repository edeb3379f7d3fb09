"""The CPU kernels against the reference in float64, and that nothing about threads or instruction sets changes them."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from splat_scenes import Scene, brute_force, make_view, near_edge_of, near_threshold, random_scene, single

from d2_plugin.compiler import NoCompiler, find_compiler
from d2_plugin.protocol import Label
from d2_plugin.rasterizer import DepthPrior, RasterSettings, Render, Splats, native, rasterize, survey

try:
    find_compiler()
except NoCompiler as error:
    pytest.skip(str(error), allow_module_level=True)

NAMES = ("means", "covariances", "opacities", "colors", "background", "screen_offsets")


def upstream(scene: Scene) -> tuple[torch.Tensor, ...]:
    g = torch.Generator().manual_seed(0)
    height, width = scene.view.height, scene.view.width
    shapes = ((height, width, scene.colors.shape[1]), *[(height, width)] * 3)
    return tuple(torch.randn(shape, generator=g) for shape in shapes)


def render_with_gradients(
    scene: Scene,
    dtype: torch.dtype,
    edge: bool = False,
    settings: RasterSettings = RasterSettings(),  # noqa: B008
) -> tuple[Render, list[torch.Tensor]]:
    scene = scene.to(dtype).requires_grad()
    background = torch.linspace(0.2, 0.9, scene.colors.shape[1], dtype=dtype).requires_grad_()
    offsets = torch.zeros(len(scene.means), 2, dtype=dtype, requires_grad=True)
    near_edge = near_edge_of(scene.view) if edge else None
    render = scene.render(settings, background=background, screen_offsets=offsets, near_edge=near_edge)
    used = [part for part in render if part is not None]
    loss = sum((part * weight.to(dtype)).sum() for part, weight in zip(used, upstream(scene)))
    return render, list(torch.autograd.grad(loss, (*scene[:4], background, offsets)))


def prior_of(scene: Scene) -> DepthPrior:
    g = torch.Generator().manual_seed(1)
    size = (scene.view.height, scene.view.width)
    depth = 1 + 4 * torch.rand(size, generator=g)
    depth[0, 0] = torch.nan
    return DepthPrior(depth, torch.randint(0, len(Label), size, generator=g, dtype=torch.uint8))


def reliable_prior_of(scene: Scene) -> DepthPrior:
    """With a reliability between 0 and 1, and numbers among them that say nothing."""
    prior = prior_of(scene)
    r = torch.rand(prior.depth.shape, generator=torch.Generator().manual_seed(2))
    r.view(-1)[1:28:9] = torch.tensor([0.0, torch.nan, torch.inf])[: len(r.view(-1)[1:28:9])]
    return prior._replace(reliability=r)


SCENES = {
    "small Gaussians": lambda: random_scene(0, 250, 61, 37),
    "a third of a pixel": lambda: random_scene(3, 200, 50, 37, radius=0.3),
    "large Gaussians, early finish": lambda: random_scene(1, 150, 70, 40, radius=40.0),
    "one channel": lambda: random_scene(2, 200, 40, 40, channels=1),
    "two channels": lambda: random_scene(2, 200, 40, 40, channels=2),
    "five channels": lambda: random_scene(3, 200, 33, 66, channels=5),
    "forty channels": lambda: random_scene(3, 40, 33, 20, channels=40),
    "one pixel": lambda: random_scene(4, 30, 1, 1),
    "7x5": lambda: random_scene(5, 50, 7, 5),
    "one Gaussian": lambda: single(),
}


edges = pytest.mark.parametrize("edge", [False, True], ids=["", "edge"])


@edges
@pytest.mark.parametrize("settings", [RasterSettings(), RasterSettings(antialiased=True)], ids=["", "antialiased"])
@pytest.mark.parametrize("name", SCENES)
def test_float32_kernels_agree_with_the_float64_reference(name, settings, edge):
    scene = SCENES[name]()
    fast, gradients = render_with_gradients(scene, torch.float32, edge, settings)
    exact, expected = render_with_gradients(scene, torch.float64, edge, settings)
    assert (fast.front is not None) == (exact.front is not None) == edge
    away = torch.from_numpy(~near_threshold(brute_force(scene, settings), settings))
    assert away.double().mean() > 0.9, "most pixels must count"
    for part, other in zip(fast[: 3 + edge], exact):
        assert part.dtype == torch.float32
        assert (part.double() - other)[away].abs().max() < 1e-4
    for part, gradient, other in zip(NAMES, gradients, expected):
        assert gradient.dtype == torch.float32
        assert (gradient.double() - other).norm() <= 1e-3 * other.norm() + 1e-6, part


@edges
@pytest.mark.parametrize("kind", [prior_of, reliable_prior_of])
@pytest.mark.parametrize("name", SCENES)
def test_survey_agrees_with_the_float64_reference(name, kind, edge):
    scene = SCENES[name]()
    prior, near_edge = kind(scene), near_edge_of(scene.view) if edge else None
    fast = survey(scene.to(torch.float32).splats, scene.view, prior, near_edge=near_edge)
    exact = survey(scene.splats, scene.view, prior, near_edge=near_edge)
    assert edge or not fast.front.any()
    close = {"rtol": 1e-4, "atol": 2e-4}
    # A Gaussian at a threshold anywhere may differ by that fragment, which is at most alpha_min or transmittance_min.
    for part, other in zip(fast[:3], exact[:3]):
        torch.testing.assert_close(part.double(), other, **close)
    assert (fast.hits - exact.hits).abs().max() <= 1
    assert fast.hits.dtype == torch.int32
    for part, other in zip(fast[4:], exact[4:]):
        torch.testing.assert_close(part.double(), other, **close)


def everything(scene: Scene) -> list[torch.Tensor]:
    render, gradients = render_with_gradients(scene, torch.float32, edge=True)
    splats, edge = scene.to(torch.float32).splats, near_edge_of(scene.view)
    surveys = [survey(splats, scene.view, kind(scene), near_edge=edge) for kind in (prior_of, reliable_prior_of)]
    return [*render, *gradients, *surveys[0], *surveys[1]]


@pytest.fixture
def threads():
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


def test_one_thread_gives_the_same_bits_as_two_and_as_three(threads):
    scene = random_scene(7, 3000, 150, 110)
    results = []
    for count in (1, 2, 3):
        threads(count)
        results.append(everything(scene))
    for others in results[1:]:
        assert all(torch.equal(part, other) for part, other in zip(results[0], others))


def test_calls_from_several_python_threads_do_not_disturb_each_other():
    scenes = [random_scene(seed, 500, 80, 60) for seed in range(3)]
    expected = [everything(scene) for scene in scenes]
    found: dict[int, list] = {}

    def work(index: int) -> None:
        for _ in range(5):
            found[index] = everything(scenes[index])

    workers = [threading.Thread(target=work, args=(index,)) for index in range(3)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    for index, parts in found.items():
        assert all(torch.equal(part, other) for part, other in zip(parts, expected[index]))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
def test_a_forked_process_can_still_render():
    code = (
        "import os, torch\n"
        "from splat_scenes import random_scene\n"
        "scene = random_scene(0, 500, 80, 60).to(torch.float32)\n"
        "before = scene.render().color\n"
        "child = os.fork()\n"
        "if child == 0:\n"
        "    os._exit(0 if torch.equal(scene.render().color, before) else 1)\n"
        "assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}
    subprocess.run([sys.executable, "-c", code], check=True, env=environment, timeout=120)


@pytest.mark.parametrize("flags", ["-march=x86-64-v3", "-march=x86-64"])
def test_other_instruction_sets_agree_with_the_reference(flags):
    if "x86" in flags and os.uname().machine != "x86_64":
        pytest.skip("flags of x86")
    if "v3" in flags and "avx2" not in Path("/proc/cpuinfo").read_text():
        pytest.skip("no AVX2 here")
    chosen = "agree and float64 and (one or five or 7x5)"
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", __file__, "-k", chosen]
    environment = {**os.environ, "D2_CXXFLAGS": flags}
    result = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300, check=False)
    assert result.returncode == 0, result.stdout


def test_inputs_need_not_be_contiguous_and_gradients_may_be_expanded():
    scene = random_scene(9, 100, 30, 30).to(torch.float32)
    strided = Scene(
        scene.means.T.contiguous().T,
        scene.covariances.flip(0).flip(0),
        torch.stack([scene.opacities, scene.opacities], 1)[:, 0],
        scene.colors.T.contiguous().T,
        scene.view,
    ).requires_grad()
    plain = scene.requires_grad()
    for render, parts in ((strided.render(), strided[:4]), (plain.render(), plain[:4])):
        render.color.sum().backward()
        assert all(part.grad is not None for part in parts)
    for part, other in zip(strided[:4], plain[:4]):
        torch.testing.assert_close(part.grad, other.grad, atol=0, rtol=0)


@pytest.mark.parametrize("used", [0, 1, 2, 3])
def test_any_one_output_alone_has_its_gradient(used):
    scene = random_scene(10, 80, 25, 25)
    found = []
    for dtype in (torch.float32, torch.float64):
        leaves = scene.to(dtype).requires_grad()
        render = leaves.render(near_edge=near_edge_of(scene.view))
        found.append(torch.autograd.grad(render[used].sum(), leaves[:3]))
    for gradient, other in zip(*found):
        assert (gradient.double() - other).norm() <= 1e-3 * other.norm()


def test_only_what_requires_gradients_gets_one():
    scene = random_scene(11, 50, 20, 20).to(torch.float32)
    scene.opacities.requires_grad_()
    scene.render().alpha.sum().backward()
    assert scene.opacities.grad is not None
    assert scene.means.grad is None
    assert not random_scene(11, 50, 20, 20).to(torch.float32).render().color.requires_grad


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_torch_compile_leaves_it_as_it_is():
    scene = random_scene(12, 40, 20, 18).to(torch.float32).requires_grad()
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


def test_what_is_not_seen_gets_a_gradient_of_exactly_zero():
    scene = random_scene(13, 60, 30, 30)
    scene.means[:20, 2] = -2.0  # behind the camera
    scene.means[20:40, 0] += 100.0  # beside it
    leaves = scene.to(torch.float32).requires_grad()
    leaves.render().color.sum().backward()
    for part in leaves[:4]:
        assert (part.grad[:40] == 0).all()
        assert (part.grad[40:] != 0).any()


def test_without_a_compiler_the_torch_path_takes_over_with_one_warning(monkeypatch):
    scene = random_scene(14, 50, 20, 20)
    native.library.cache_clear()
    native.available.cache_clear()
    with monkeypatch.context() as patch:
        patch.setenv("CXX", "no-such-compiler")
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            slow = scene.to(torch.float32).render()
            scene.to(torch.float32).render()
        (message,) = [str(warning.message) for warning in caught]
        assert "no-such-compiler" in message
        assert "orders of magnitude slower" in message
    native.available.cache_clear()
    torch.testing.assert_close(slow.color, scene.to(torch.float32).render().color, atol=1e-5, rtol=0)


def test_an_image_as_wide_as_a_panorama_has_its_gaussians_in_place():
    view = make_view(5000, 3, focal=2000.0)
    scene = single(depth=2.0, opacity=0.9, variance=1e-6)._replace(view=view)
    scene.means[0, 0] = 2.4005
    alpha = scene.to(torch.float32).render().alpha
    assert alpha.argmax().item() == 5000 + 4900
    np.testing.assert_allclose(alpha.double().numpy(), scene.render().alpha.numpy(), atol=1e-4)
