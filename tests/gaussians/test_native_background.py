"""The background in the kernel is that of torch: value, gradients, threads."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from tiny import make_model, make_views
from torch import Tensor

from d2_plugin.backbones import background as module
from d2_plugin.backbones.background import Background
from d2_plugin.gaussians import native_background as kernel
from d2_plugin.protocol import Render, View

SIZES = [(32, 24), (1, 1), (40, 40), (81, 7), (100, 33), (320, 45)]


@pytest.fixture(autouse=True)
def compiled() -> None:
    if kernel.library() is None:
        pytest.skip("there is no C++ compiler")


def view_of(width: int, height: int) -> View:
    K = torch.tensor([[0.8 * width, 0, width / 2], [0, 0.8 * width, height / 2], [0, 0, 1]])
    return View("cam", 0, 0.0, torch.eye(4), K, width, height)


def sky(dtype: torch.dtype = torch.float32) -> Background:
    """Its colours leave 0..1 here and there."""
    found = Background(torch.device("cpu"))
    with torch.no_grad():
        found.harmonics.uniform_(-0.5, 0.5, generator=torch.Generator().manual_seed(0))
    found.constant.data, found.harmonics.data = found.constant.to(dtype), found.harmonics.to(dtype)
    return found


def behind(width: int, height: int, dtype: torch.dtype) -> tuple[Tensor, ...]:
    """The image with the background, and the gradients of everything for a random one."""
    generator = torch.Generator().manual_seed(1)
    drawn = torch.rand(height, width, 4, generator=generator).to(dtype)
    color, alpha = drawn[..., :3].clone().requires_grad_(), drawn[..., 3].clone().requires_grad_()
    upstream = torch.randn(height, width, 3, generator=generator).to(dtype)
    found = sky(dtype)
    out = found.behind(Render(color, alpha, alpha), view_of(width, height)).color
    return out.detach(), *torch.autograd.grad(out, (color, alpha, found.constant, found.harmonics), upstream)


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_the_background_and_its_gradients_are_those_of_torch_in_float64(width: int, height: int) -> None:
    for found, exact in zip(behind(width, height, torch.float32), behind(width, height, torch.float64), strict=True):
        assert found.dtype == torch.float32
        assert (found - exact).norm() <= 3e-6 * exact.norm() + 1e-6


def test_the_number_of_threads_changes_no_bit(same_for_any_threads: Callable) -> None:
    sizes = (100, 70), (320, 180), (41, 23)
    same_for_any_threads(lambda: [part for size in sizes for part in behind(*size, torch.float32)])


def test_a_background_that_is_nan_is_seen() -> None:
    found = sky()
    with torch.no_grad():
        found.constant[0, 1] = math.nan
    black = torch.zeros(24, 32)
    out = found.behind(Render(black[..., None].repeat(1, 1, 3), black, black), view_of(32, 24)).color
    assert out[..., 1].isnan().all()
    assert out[..., 0].isfinite().all()


def test_without_a_compiler_the_image_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    model, view = make_model(background=True), make_views()[0]
    native = model.render(view).color
    monkeypatch.setattr(module, "can_composite", lambda *parts: False)
    torch.testing.assert_close(model.render(view).color, native)
