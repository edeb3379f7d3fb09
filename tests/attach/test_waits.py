"""On a GPU an attached step waits for the device once, and a prior travels there as small as it is stored.

Counted on a GPU that is not there (`fake_gpu`), with the real kernels of gpu.cu in their shim.
"""

from collections import Counter

import pytest
import torch
from fake_gpu import FakeGpu, OnGpu, fake_gpu, move  # noqa: F401  a fixture
from hooks.test_motion import Halfway
from repositories import VARIANTS
from tiny import HEIGHT, WIDTH, TinyStore
from torch import Tensor
from torch.utils._python_dispatch import _disable_current_modes

from d2_plugin import D2Hooks
from d2_plugin.config import D2Config, DepthLossConfig, MotionConfig, ParallaxConfig
from d2_plugin.hooks.densify import DensifyConfig
from d2_plugin.hooks.prune import PruneConfig

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
    for step, camera in enumerate(
        (*cameras, cameras[0]), 1
    ):  # views are checked, priors read, SSIM's window made, once
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
        term = d2.loss(25, cameras[25 % len(cameras)])
        term.backward()
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
    views = len(cameras)
    assert sum(waits.values()) <= (PER_VIEW + (name in ONE_MORE)) * views + PER_EVALUATION, waits
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
