"""GPU kernels against the reference: the same .cu source on the CPU (fibre shim) and, where there is one, on a GPU.

`backend` runs every check twice: "shim" executes kernels and host code of `d2_plugin.rasterizer.cuda` on CPU tensors;
"cuda" (marker `cuda`) on the device.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator

import pytest
import torch
from cuda_cases import (
    FORWARD_TOLERANCE,
    GRADIENT_TOLERANCE,
    Scene,
    ShimLauncher,
    assert_same_gradients,
    assert_same_image,
    camera_of,
    gradients_of_kernels,
    inputs_of,
    make_prior,
    make_reliable,
    make_scene,
    near_a_cut_off,
    random_upstream,
    reference_with_gradients,
    relative_error,
    render_kernels,
    shim_library,
    survey_kernels,
    with_edge,
)

from d2_plugin import D2Error
from d2_plugin.compiler import NoCompiler
from d2_plugin.protocol import Label, RasterSettings, Render, Splats
from d2_plugin.rasterizer import autograd, cuda, rasterize, reference, survey


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """The images are too small for two: the reference would mostly wait."""
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


def assert_as_the_reference(scene: Scene, backend: torch.device) -> Render:
    render, upstream, expected = reference_with_gradients(scene)
    assert_same_image(scene, render_kernels(scene, backend)[1], render)
    assert_same_gradients(gradients_of_kernels(scene, backend, upstream), expected)
    return render


edges = pytest.mark.parametrize("edge", [False, True], ids=["", "edge"])


@edges
@pytest.mark.parametrize("antialiased", [False, True], ids=["", "antialiased"])
@pytest.mark.parametrize("size", [(64, 48), (67, 41), (1, 1), (15, 33)], ids=lambda size: "{}x{}".format(*size))
def test_image_and_gradients_are_the_references_at_any_size(
    backend: torch.device, size: tuple[int, int], antialiased: bool, edge: bool
) -> None:
    scene = make_scene(300, *size, settings=RasterSettings(antialiased=antialiased))
    scene = with_edge(scene) if edge else scene
    assert_as_the_reference(scene, backend)


@edges
@pytest.mark.parametrize("channels", [1, 40])
def test_any_number_of_color_channels(backend: torch.device, channels: int, edge: bool) -> None:
    scene = make_scene(120, 40, 24, channels=channels)
    scene = with_edge(scene) if edge else scene
    assert_as_the_reference(scene, backend)


@edges
def test_many_opaque_layers_and_many_batches(backend: torch.device, edge: bool) -> None:
    """700 layers over a tile: three batches of the forward pass, eleven of the backward, most of them hidden."""
    scene = make_scene(700, 33, 17, scale=0.3, opaque=True)
    scene = with_edge(scene) if edge else scene
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
    scene, (color, depth_sum, alpha, front, *_) = render_kernels(with_edge(make_scene(0)), backend)
    assert front.shape == alpha.shape
    assert not front.any()
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


@edges
@pytest.mark.parametrize("channels", [3, 40])
def test_a_loss_that_sends_nan_where_nothing_is_drawn_spoils_no_gradient(
    backend: torch.device, channels: int, edge: bool
) -> None:
    """As normalised depth does: 0 / 0 where alpha is 0."""
    scene = make_scene(8, channels=channels)
    scene = with_edge(scene) if edge else scene
    _, outputs = render_kernels(scene, backend)
    empty = outputs[2].cpu() == 0
    assert empty.any()
    upstream = random_upstream(scene)
    expected = gradients_of_kernels(scene, backend, upstream)
    found = gradients_of_kernels(
        scene, backend, tuple(part.masked_fill(mask_of(empty, part), torch.nan) for part in upstream)
    )
    for i in (0, 1, 2, 3, 5):  # the background does shine through there
        assert torch.equal(found[i], expected[i])


def mask_of(pixels: torch.Tensor, part: torch.Tensor) -> torch.Tensor:
    return pixels[..., None].expand_as(part) if part.ndim == 3 else pixels


def test_where_no_space_is_known_to_be_free_no_gradient_of_it_counts(backend: torch.device) -> None:
    scene = with_edge(make_scene(100))
    edge = scene.near_edge
    unknown = ~(edge.isfinite() & (edge > 1e-30))
    *upstream, on_front = random_upstream(scene)
    results = [
        gradients_of_kernels(scene, backend, (*upstream, on_front.masked_fill(unknown, value)))
        for value in (0, torch.nan)
    ]
    assert all(torch.equal(a, b) for a, b in zip(*results))


def test_a_near_edge_changes_nothing_but_the_front(backend: torch.device) -> None:
    scene = make_scene(300)
    bare, full = (render_kernels(part, backend)[1] for part in (scene, with_edge(scene)))
    assert all(torch.equal(a, b) for a, b in zip(bare[:3], full[:3]))
    upstream = random_upstream(scene)
    for other in (None, torch.zeros_like(upstream[1])):
        found = gradients_of_kernels(with_edge(scene), backend, (*upstream, other))
        assert all(torch.equal(a, b) for a, b in zip(found, gradients_of_kernels(scene, backend, upstream)))
    prior = make_prior(scene)
    one, two = (survey_kernels(part, prior, backend) for part in (scene, with_edge(scene)))
    assert all(torch.equal(a, b) for a, b in zip(one[:6], two[:6]))
    assert not one.front.any()
    assert two.front.any()


def test_gradients_outside_of_the_fov_clamp(backend: torch.device) -> None:
    """Long Gaussians whose centres lie far beside the image, where the Jacobian stands still."""
    scene = make_scene(60, settings=RasterSettings(fov_clamp=0.6), scale=0.3)
    assert_as_the_reference(scene, backend)


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
    scene = with_edge(scene._replace(splats=Splats(means, covariances, opacities, scene.splats.rows)))
    _, outputs = render_kernels(scene, backend)
    upstream = tuple(torch.ones_like(part) for part in outputs[:4])
    survey_of_it = survey_kernels(scene, make_reliable(make_prior(scene)), backend)
    for value in (*outputs[:4], *gradients_of_kernels(scene, backend, upstream), *survey_of_it):
        assert torch.isfinite(value).all()


@pytest.mark.parametrize("given", range(4), ids=Render._fields)
def test_outputs_without_an_upstream_gradient_count_as_zero(backend: torch.device, given: int) -> None:
    scene = with_edge(make_scene(100, 32, 32))
    upstream = random_upstream(scene)
    zeros = tuple(part * (i == given) for i, part in enumerate(upstream))
    expected = gradients_of_kernels(scene, backend, zeros)
    scene, outputs = render_kernels(scene, backend)
    absent = [part.to(backend, torch.float32) if i == given else None for i, part in enumerate(upstream)]
    found = cuda.backward(
        *absent, *inputs_of(scene), *camera_of(scene), autograd.constants_of(scene.settings), *outputs
    )
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


@pytest.mark.parametrize(
    "scene",
    [make_scene(300), make_scene(500, 37, 29, scale=0.3, opaque=True), make_scene(0)],
    ids=["random", "opaque", "empty"],
)
@pytest.mark.parametrize("more", [False, True], ids=["", "edge and reliability"])
def test_survey_is_the_references(backend: torch.device, scene: Scene, more: bool) -> None:
    scene = scene._replace(screen_offsets=torch.zeros_like(scene.screen_offsets))
    calm = ~near_a_cut_off(scene)
    prior = make_prior(scene)
    prior.labels[~calm] = Label.MONO
    prior.labels[calm] = torch.where(prior.labels[calm] == Label.MONO, Label.VERIFIED, prior.labels[calm])
    if more:
        scene, prior = with_edge(scene), make_reliable(prior)
        scene.near_edge[~calm], prior.reliability[~calm] = 0, 0
    double = scene.to(torch.device("cpu"), torch.float64)
    expected = reference.survey(double.splats, double.view, prior, double.settings, 1e-8, double.near_edge)
    found = survey_kernels(scene, prior, backend)
    assert torch.equal(found.hits.cpu(), expected.hits)
    for name in ("depth_sum", "alpha"):
        worst = (getattr(found, name).cpu() - getattr(expected, name))[calm].abs()
        assert not len(worst) or worst.amax() < FORWARD_TOLERANCE
    assert bool(expected.front.any()) == (more and len(found.front) > 0)
    for name in ("weight", "error", "front"):
        assert relative_error(getattr(found, name), getattr(expected, name)) < GRADIENT_TOLERANCE
    off = (found.max_weight.cpu() - expected.max_weight).abs() > FORWARD_TOLERANCE
    assert off.sum() <= 0.02 * len(off), "more than those whose maximum may lie at a cut-off"


def test_no_result_depends_on_the_order_of_warps_and_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = with_edge(make_scene(400, 45, 37, scale=0.25))
    upstream = random_upstream(scene)
    results = []
    for order in (0, 1, 2, 3):  # as they are numbered, in the opposite order, at random
        launcher = ShimLauncher(order)
        monkeypatch.setattr(cuda, "launcher", lambda device, launcher=launcher: launcher)
        cpu = torch.device("cpu")
        results.append((*gradients_of_kernels(scene, cpu, upstream), *survey_kernels(scene, make_prior(scene), cpu)))
        named = {"d2_project", "d2_list", "d2_render_front", "d2_backward_front", "d2_survey_front"}
        assert named <= set(launcher.launched)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other))


def test_two_runs_give_the_same_bits(backend: torch.device) -> None:
    scene = with_edge(make_scene(300))
    upstream = random_upstream(scene)
    runs = [gradients_of_kernels(scene, backend, upstream) for _ in range(2)]
    assert all(torch.equal(a, b) for a, b in zip(*runs))


def test_a_skewed_camera_is_refused(backend: torch.device) -> None:
    scene = make_scene(10)
    scene.view.K[0, 1] = 0.5
    with pytest.raises(D2Error, match=r"K has skew 0\.5, expected 0"):
        render_kernels(scene, backend)


def test_more_pairs_than_slots_can_number_are_refused() -> None:
    ends = torch.tensor([5, 2**31])
    with pytest.raises(D2Error, match="2147483648 pairs of Gaussian and tile"):
        cuda._count_pairs(ends, torch.eye(3))


# ---------------------------------------------------------------------------------------------------- the device


@pytest.mark.cuda
def test_the_device_decides(monkeypatch: pytest.MonkeyPatch) -> None:
    """The public functions on CUDA tensors: kernels, not the reference; autograd; a prior left on the CPU."""
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device (torch.cuda.is_available() is False)")
    monkeypatch.setattr(reference, "rasterize", None)
    monkeypatch.setattr(reference, "survey", None)
    device = torch.device("cuda", 0)
    scene = with_edge(make_scene(300)).to(device, torch.float32)
    inputs = [part.requires_grad_() for part in inputs_of(scene)]
    splats = Splats(*inputs[:3], scene.splats.rows)
    options = {"background": inputs[4], "screen_offsets": inputs[5], "near_edge": scene.near_edge}
    render = rasterize(splats, inputs[3], scene.view, **options)
    upstream = [torch.randn_like(part) for part in render]
    found = torch.autograd.grad(render, inputs, upstream)
    assert all(part.is_cuda and torch.isfinite(part).all() for part in found)
    expected = gradients_of_kernels(with_edge(make_scene(300)), device, tuple(upstream))
    assert all(torch.equal(a, b) for a, b in zip(found, expected))
    assert survey(
        splats, scene.view, make_prior(make_scene(300)), near_edge=with_edge(make_scene(300)).near_edge
    ).hits.is_cuda


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
