"""On a GPU an attached step waits for the device once, and a prior travels there as small as it is stored.

Counted on a GPU that is not there (`fake_gpu`), with the real kernels of gpu.cu in their shim. A view goes where the
Gaussians are, and Gaussians that no compiled kernel draws are refused.
"""

from collections import Counter

import pytest
import torch
from fake_gpu import FakeGpu, OnGpu, fake_gpu, move  # noqa: F401  a fixture
from hooks.test_motion import Halfway
from refusals import refuses
from repositories import VARIANTS
from tiny import HEIGHT, WIDTH, TinyStore, make_views
from torch import Tensor
from torch.utils._python_dispatch import _disable_current_modes

from d2_plugin import D2Hooks
from d2_plugin.config import D2Config, DepthLossConfig, MotionConfig, ParallaxConfig
from d2_plugin.hooks.densify import DensifyConfig
from d2_plugin.hooks.prune import PruneConfig
from d2_plugin.protocol import DepthPrior, Splats
from d2_plugin.rasterizer import MOST_IN_TORCH, cuda, native, rasterize, survey

ONE_MORE = {"swift4d", "gsplat_dynamic"}
"""Their own code, too, draws which Gaussians move from a mask, whose number has to be known."""

PER_VIEW, PER_EVALUATION = 4, 24
"""Waits of an evaluation: for each view whether its prior knows free space, the pairs to sort, the pixels that lack a
surface, and those of them that are free; and for the edit that follows, an inverse deformation included."""

SMALL = 512
"""Bytes of matrices and numbers."""


def on_the_gpu(name: str, instant: bool = False) -> tuple[object, list[object]]:
    """The adapter of a mimic, and one of its cameras at both instants; or all of them at one instant."""
    moved: dict[int, object] = {}
    with _disable_current_modes():  # what stands on the host need not be counted
        standing = VARIANTS[name]()
    items = name == "gsplat_dynamic"  # a data set's items stay on the host
    half = len(standing.cameras) // 2
    chosen = standing.cameras[:half] if instant else standing.cameras[::half]
    return move(standing.adapter, moved), [camera if items else move(camera, moved) for camera in chosen]


ON_THE_GPU = sorted(VARIANTS.keys() - {"deformable3d 6dof"})
"""Its mimic stays on the host."""


@pytest.mark.parametrize("name", [name for name in ON_THE_GPU if name != "hust4d coarse"])  # where hooks wait
def test_motion_waits_once_a_step(name: str, fake_gpu: FakeGpu) -> None:  # noqa: F811
    adapter, cameras = on_the_gpu(name)
    d2 = D2Hooks(D2Config(finite_every=0, motion=MotionConfig()), adapter, Halfway())
    for step, camera in enumerate((*cameras, cameras[0]), 1):  # what is checked, read or made once
        d2.loss(step, camera)
        d2.step(step)
    with fake_gpu.counting():
        d2.loss(4, cameras[0]).backward()
        d2.step(4)
        waits, copied = own(fake_gpu.where), Counter(fake_gpu.copied)
    assert sum(waits.values()) <= 1 + 2 * (name in ONE_MORE), waits  # their mask for the slice and for its colours
    assert copied["to device"] <= 4 * WIDTH * HEIGHT + SMALL, copied


@pytest.mark.parametrize("name", ["fudan", "gsplat", "spacetime"])
def test_parallax_waits_once_a_step_where_it_knows_what_is_in_sight(name: str, fake_gpu: FakeGpu) -> None:  # noqa: F811
    adapter, cameras = on_the_gpu(name, instant=True)
    d2 = D2Hooks(D2Config(finite_every=0, parallax=ParallaxConfig(every=1)), adapter, TinyStore())
    for step in range(1, 25):  # all others, both parts of the way
        d2.loss(step, cameras[step % len(cameras)])
        d2.step(step)
    with fake_gpu.counting():
        d2.loss(25, cameras[25 % len(cameras)]).backward()
        waits, copied = own(fake_gpu.where), Counter(fake_gpu.copied)
    assert sum(waits.values()) <= 1, waits  # the pairs to sort
    assert copied["to device"] <= 8 * WIDTH * HEIGHT + SMALL, copied  # its codes and colours


def own(waits: Counter[str]) -> Counter[str]:
    """Without those of the trainer's own functions."""
    return Counter({place: count for place, count in waits.items() if "mimics/" not in place})


@pytest.mark.parametrize("name", ON_THE_GPU)
@pytest.mark.usefixtures("workplace")
def test_a_step_waits_once_and_copies_no_more_than_the_codes(name: str, fake_gpu: FakeGpu) -> None:  # noqa: F811
    adapter, cameras = on_the_gpu(name)
    due = {"start": 3, "every": 3, "stop": 4}
    hooks = {"densify": DensifyConfig(**due), "prune": PruneConfig(**due), "depth_loss": DepthLossConfig()}
    d2 = D2Hooks(D2Config(prior="prior", finite_every=0, views_per_evaluation=2, **hooks), adapter)
    d2.loss(1, cameras[0])  # a new view is checked once
    d2.step(1)
    with fake_gpu.counting():
        loss = d2.loss(2, cameras[0])
        if isinstance(loss, Tensor):
            loss.backward()
        d2.step(2)
        waits, copied = own(fake_gpu.where), Counter(fake_gpu.copied)
    assert isinstance(loss, OnGpu) == (name != "hust4d coarse")
    assert sum(waits.values()) <= 1 + (name in ONE_MORE), waits
    assert copied["to device"] <= 4 * WIDTH * HEIGHT + SMALL, copied
    assert copied["to host"] <= SMALL, copied
    d2.loss(3, cameras[1])
    with fake_gpu.counting():
        d2.step(3)
        waits = own(fake_gpu.where)
    assert sum(waits.values()) <= (PER_VIEW + (name in ONE_MORE)) * len(cameras) + PER_EVALUATION, waits
    if name != "hust4d coarse":
        assert d2.log.inserted > 0


def test_what_waits_is_counted_and_nothing_else(fake_gpu: FakeGpu) -> None:  # noqa: F811
    numbers = torch.rand(4, 3)
    with fake_gpu.counting():
        there = numbers.to("cuda", non_blocking=True)
        assert isinstance(there, OnGpu)
        assert there.device == torch.device("cuda:0")
        assert isinstance(torch.arange(3, device=there.device), OnGpu)
        leaf = torch.nn.Parameter(there)
        torch.where(leaf > 0.5, leaf, 0.0).sum().backward()
        assert isinstance(leaf.grad, OnGpu)
        there[0, 0] = 3.0
        there[there > 1] = 0.0  # filled where the mask is
        torch.linalg.inv_ex(there[:3])
        assert not fake_gpu.waits
        assert fake_gpu.copied == {"to device": 48}
    ways = {
        "_local_scalar_dense": lambda: float(there.sum()),
        "equal": lambda: torch.equal(there, there),
        "tolist": lambda: there.tolist(),
        "nonzero": lambda: torch.nonzero(there),
        "mask as an index": lambda: there[there > 0],
        "copy to the host": lambda: there.cpu(),
        "copy to the device": lambda: there.new_tensor([1.0, 2.0]),
        "_linalg_check_errors": lambda: torch.linalg.inv(there[:3] + torch.eye(3, device="cuda")),
    }
    for name, way in ways.items():
        with fake_gpu.counting():
            way()
            assert fake_gpu.waits == {name: 1}


ALL = D2Config(prior="prior", densify=DensifyConfig(start=2, every=2), depth_loss=DepthLossConfig(), finite_every=0)


@pytest.mark.parametrize("name", ["gsplat", "deformable3d", "fastergs4d"])
@pytest.mark.usefixtures("workplace", "fake_gpu")
def test_a_view_on_the_cpu_goes_where_the_gaussians_are(name: str) -> None:
    d2 = D2Hooks(ALL, move(VARIANTS[name]().adapter))
    for step, view in enumerate(make_views()[:2], 1):
        assert isinstance(d2.loss(step, view), OnGpu)
        d2.step(step)
    assert d2.log.inserted > 0


@pytest.mark.parametrize("hook", ["depth_loss", "densify"])
@pytest.mark.usefixtures("workplace", "fake_gpu")
def test_a_backbone_that_leaves_it_there_is_told_which_view(hook: str) -> None:
    adapter = move(VARIANTS["gsplat"]().adapter)
    adapter.view = lambda camera: camera
    d2 = D2Hooks.from_config({"prior": "prior", hook: {"start": 1, "every": 1}}, adapter, iterations=10)
    if hook == "densify":
        d2.loss(1, make_views()[0])
    run = (lambda: d2.step(1)) if hook == "densify" else (lambda: d2.loss(1, make_views()[0]))
    refuses(r"camera 'cam0' at frame 0 is on cpu but slice_at\(\) returned .* on cuda:0", run)


@pytest.mark.usefixtures("fake_gpu")
def test_kernels_take_a_camera_on_the_cpu() -> None:
    view, count = make_views()[0], 20
    generator = torch.Generator().manual_seed(0)
    means = torch.rand(count, 3, generator=generator) + torch.tensor([-0.5, -0.5, 2.0])
    parts = means, torch.tensor([0.01, 0, 0, 0.01, 0, 0.01]).repeat(count, 1), torch.full((count,), 0.5)
    there = Splats(*(part.to("cuda") for part in parts), torch.arange(count, device="cuda"))
    drawn = rasterize(there, torch.ones(count, 3).to("cuda"), view)
    expected = rasterize(Splats(*parts, torch.arange(count)), torch.ones(count, 3), view)
    torch.testing.assert_close(drawn.alpha.held, expected.alpha, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("on_gpu", [False, True])
@pytest.mark.usefixtures("fake_gpu")
def test_a_million_gaussians_without_kernels_are_refused(on_gpu: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cuda if on_gpu else native, "available", lambda *_: False)
    view = make_views()[0]

    def splats(count: int) -> Splats:
        parts = torch.zeros(1, 3).expand(count, 3), torch.ones(1, 6).expand(count, 6), torch.zeros(1).expand(count)
        return Splats(*(part.to("cuda") if on_gpu else part for part in parts), torch.arange(0))

    def draw(count: int) -> None:
        made = splats(count)
        rasterize(made, made.means, view)

    draw(10)
    sentence = rf"{MOST_IN_TORCH + 1} Gaussians on {'cuda:0' if on_gpu else 'cpu'} and no compiled kernels: plain torch"
    refuses(sentence, draw, MOST_IN_TORCH + 1)
    prior = DepthPrior(*torch.zeros(2, view.height, view.width))
    refuses(sentence, survey, splats(MOST_IN_TORCH + 1), view, prior)
