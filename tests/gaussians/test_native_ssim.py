"""The photometric loss and the background in the kernel are those in torch: value, gradient, borders, threads."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity
from torch import Tensor

from d2_plugin.backbones.background import Background
from d2_plugin.gaussians import native_ssim as kernel
from d2_plugin.gaussians.photometric import photometric_loss, reference_photometric_loss
from d2_plugin.protocol import Render, View

pytestmark = pytest.mark.usefixtures("compiler")
SIZES = [(1, 1), (1, 40), (40, 1), (11, 11), (37, 23), (150, 160)]


def images(height: int, width: int, channels: int = 3, seed: int = 0, noise: float = 0.1) -> tuple[Tensor, Tensor]:
    """A textured target and a noisy version of it."""
    generator = torch.Generator().manual_seed(seed)
    target = torch.rand(height, width, channels, generator=generator)
    return (target + noise * torch.randn(target.shape, generator=generator)).clamp(0, 1), target


def loss_with_gradient(
    image: Tensor, target: Tensor, dtype: torch.dtype = torch.float32, loss_of: Callable = photometric_loss, **options
) -> tuple[Tensor, Tensor]:
    image = image.to(dtype, copy=True).requires_grad_()
    loss = loss_of(image, target.to(dtype), **options)
    loss.backward()
    return loss.detach(), image.grad


@pytest.mark.parametrize(
    ("shape", "weight"),
    [*(((*size, 3), 0.2) for size in SIZES), *(((20, 30, channels), 0.2) for channels in (1, 4))]
    + [((20, 30, 3), weight) for weight in (1e-3, 1.0)],
)
@pytest.mark.parametrize("transposed", [False, True], ids=["", "transposed"])
def test_value_and_gradient_are_those_of_torch_in_float64(shape, weight, transposed) -> None:
    image, target = images(*shape)
    if transposed:  # and so not contiguous
        image, target = image.transpose(0, 1), target.flip(0).transpose(0, 1)
    loss, gradient = loss_with_gradient(image, target, ssim_weight=weight)
    exact, slope = loss_with_gradient(image, target, torch.float64, reference_photometric_loss, ssim_weight=weight)
    assert loss.dtype == torch.float32
    assert loss.shape == ()
    # Where var = E[x^2] - mean^2 cancels, float32 leaves 6e-8 of it, 3e-5 of one pixel's SSIM (its C2 is 9e-4).
    of_a_pixel = 3e-5 / (shape[0] * shape[1])
    torch.testing.assert_close(loss.double(), exact, rtol=3e-6, atol=5e-7 + weight / 2 * of_a_pixel)
    assert (gradient - slope).norm() < (5e-6 + of_a_pixel) * slope.norm()


@pytest.mark.parametrize("level", [0.1, 0.9])
def test_flat_images_lose_fewer_digits_than_in_torch(level: float) -> None:
    """Variances near zero are differences of nearly equal numbers; c2 = 9e-4 hides little of their rounding."""
    generator = torch.Generator().manual_seed(0)
    target = torch.full((60, 60, 3), level)
    image = target + 0.02 + 1e-3 * torch.rand(60, 60, 3, generator=generator)
    _, gradient = loss_with_gradient(image, target)
    plain, exact = (
        loss_with_gradient(image, target, t, reference_photometric_loss)[1] for t in (torch.float32, torch.float64)
    )
    assert (gradient - exact).norm() < 2e-5 * exact.norm()
    if level > 0.5:  # dark images have little to lose
        assert (gradient - exact).norm() < (plain - exact).norm()


def test_the_structural_part_is_that_of_scikit_image() -> None:
    """Inside a margin of zeros, where reflecting and padding with zeros are the same."""
    image, target = (torch.nn.functional.pad(part, (0, 0, 12, 12, 12, 12)) for part in images(40, 30))
    expected = structural_similarity(
        *(np.asarray(part, np.float64) for part in (image, target)),
        data_range=1.0, channel_axis=-1, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, full=True,
    )[1].mean()  # fmt: skip
    np.testing.assert_allclose(1 - photometric_loss(image, target, 1.0), expected, rtol=1e-6)


def test_a_nan_pixel_spoils_only_its_surroundings() -> None:
    image, target = images(60, 60)
    _, clean = loss_with_gradient(image, target)
    image[30, 20, 1] = math.nan
    loss, gradient = loss_with_gradient(image, target)
    assert loss.isnan()
    touched = torch.zeros_like(gradient, dtype=torch.bool)
    touched[20:41, 10:31, 1] = True  # two windows
    assert gradient[touched].isnan().all()
    assert torch.equal(gradient[~touched], clean[~touched])


def test_the_gradient_scales_with_what_comes_back_and_may_be_asked_for_twice_or_not_at_all() -> None:
    image, target = images(30, 30)
    value, once = loss_with_gradient(image, target)
    alone = photometric_loss(image, target)
    assert not alone.requires_grad
    assert torch.equal(alone, value)
    loss = photometric_loss(image.requires_grad_(), target)
    loss.backward(retain_graph=True)
    (3 * loss).backward()
    torch.testing.assert_close(image.grad, 4 * once)


def test_torch_takes_over_where_the_kernel_does_not_apply(monkeypatch: pytest.MonkeyPatch) -> None:
    image, target = images(20, 20)
    native = photometric_loss(image, target)
    learned = target.clone().requires_grad_()
    photometric_loss(image, learned).backward()
    assert learned.grad.any(), "a target that is learned needs its gradient"
    assert photometric_loss(image.double(), target.double()).dtype == torch.float64
    torch.testing.assert_close(photometric_loss(image, target, 0.0), (image - target).abs().mean())
    monkeypatch.setattr(kernel, "library", lambda: None)
    torch.testing.assert_close(photometric_loss(image, target), native)


@pytest.mark.parametrize("height", [20, 70])
def test_a_target_of_bytes_is_the_same_as_its_numbers_to_the_bit(height: int) -> None:
    image, target = images(height, 45)
    kept = (255 * target).round().to(torch.uint8)
    exact = loss_with_gradient(image, kept.float() / 255)
    loss = photometric_loss(image.requires_grad_(), kept)
    loss.backward()
    assert torch.equal(loss.detach(), exact[0])
    assert torch.equal(image.grad, exact[1])
    torch.testing.assert_close(photometric_loss(image.double(), kept).float(), loss)  # in torch


IMAGE_SIZES = [(32, 24), (1, 1), (40, 40), (81, 7), (100, 33), (320, 45)]


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


@pytest.mark.parametrize(("width", "height"), IMAGE_SIZES)
def test_the_background_and_its_gradients_are_those_of_torch_in_float64(width: int, height: int) -> None:
    for found, exact in zip(behind(width, height, torch.float32), behind(width, height, torch.float64), strict=True):
        assert found.dtype == torch.float32
        assert (found - exact).norm() <= 3e-6 * exact.norm() + 1e-6


def test_the_number_of_threads_changes_no_bit(same_for_any_threads: Callable) -> None:
    def everything() -> list[Tensor]:
        losses = [part for height in (63, 64, 131) for part in loss_with_gradient(*images(height, 50))]
        sizes = (100, 70), (320, 180), (41, 23)
        return losses + [part for size in sizes for part in behind(*size, torch.float32)]

    same_for_any_threads(everything)


def test_a_background_that_is_nan_is_seen() -> None:
    found = sky()
    with torch.no_grad():
        found.constant[0, 1] = math.nan
    black = torch.zeros(24, 32)
    out = found.behind(Render(black[..., None].repeat(1, 1, 3), black, black), view_of(32, 24)).color
    assert out[..., 1].isnan().all()
    assert out[..., 0].isfinite().all()
