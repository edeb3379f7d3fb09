"""Views and Gaussians on different devices, and Gaussians that no compiled kernel draws."""

import pytest
import torch
from fake_gpu import OnGpu, fake_gpu, move  # noqa: F401  a fixture
from refusals import refuses
from repositories import VARIANTS
from tiny import make_views

from d2_plugin import D2Hooks
from d2_plugin.config import D2Config, DensifyConfig, DepthLossConfig
from d2_plugin.protocol import Splats
from d2_plugin.rasterizer import MOST_IN_TORCH, cuda, native, rasterize, survey

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
    refuses(sentence, survey, splats(MOST_IN_TORCH + 1), view, None)
