"""The photometric loss in the kernel is the one in torch: value, gradient, borders, threads."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity
from torch import Tensor

from d2_plugin.gaussians import native_ssim as kernel
from d2_plugin.gaussians.photometric import photometric_loss, reference_photometric_loss

SIZES = [(1, 1), (1, 40), (40, 1), (5, 7), (10, 12), (11, 11), (37, 23), (90, 61), (150, 160)]


@pytest.fixture(autouse=True)
def compiled() -> None:
    if kernel.library() is None:
        pytest.skip("there is no C++ compiler")


def images(height: int, width: int, channels: int = 3, seed: int = 0, noise: float = 0.1) -> tuple[Tensor, Tensor]:
    """A textured target and a noisy version of it."""
    generator = torch.Generator().manual_seed(seed)
    target = torch.rand(height, width, channels, generator=generator)
    return (target + noise * torch.randn(target.shape, generator=generator)).clamp(0, 1), target


def loss_with_gradient(loss_of, image: Tensor, target: Tensor, dtype: torch.dtype, **options) -> tuple[Tensor, Tensor]:
    image = image.to(dtype, copy=True).requires_grad_()
    loss = loss_of(image, target.to(dtype), **options)
    loss.backward()
    return loss.detach(), image.grad


def assert_agree(image: Tensor, target: Tensor, **options) -> None:
    """Kernel in float32 against torch in float64."""
    loss, gradient = loss_with_gradient(photometric_loss, image, target, torch.float32, **options)
    exact, exact_gradient = loss_with_gradient(reference_photometric_loss, image, target, torch.float64, **options)
    assert loss.dtype == torch.float32
    assert loss.shape == ()
    torch.testing.assert_close(loss.double(), exact, rtol=3e-6, atol=5e-7)
    assert (gradient - exact_gradient).norm() < 5e-6 * exact_gradient.norm()


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_value_and_gradient_are_those_of_torch_in_float64_for_any_size(height: int, width: int) -> None:
    assert_agree(*images(height, width))


@pytest.mark.parametrize("channels", [1, 2, 4])
def test_any_number_of_channels(channels: int) -> None:
    assert_agree(*images(20, 30, channels))


@pytest.mark.parametrize("weight", [1e-3, 0.5, 1.0])
def test_any_weight_of_the_structural_part(weight: float) -> None:
    assert_agree(*images(20, 30), ssim_weight=weight)


def test_images_need_not_be_contiguous() -> None:
    image, target = images(30, 20)
    assert_agree(image.transpose(0, 1), target.flip(0).transpose(0, 1))


@pytest.mark.parametrize("level", [0.1, 0.9])
def test_flat_images_lose_fewer_digits_than_in_torch(level: float) -> None:
    """Variances near zero are differences of nearly equal numbers; c2 = 9e-4 hides little of their rounding."""
    generator = torch.Generator().manual_seed(0)
    target = torch.full((60, 60, 3), level)
    image = target + 0.02 + 1e-3 * torch.rand(60, 60, 3, generator=generator)
    _, gradient = loss_with_gradient(photometric_loss, image, target, torch.float32)
    _, plain = loss_with_gradient(reference_photometric_loss, image, target, torch.float32)
    _, exact = loss_with_gradient(reference_photometric_loss, image, target, torch.float64)
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


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("height", [63, 64, 131])
def test_one_and_more_threads_give_the_same_bits(height: int) -> None:
    results = []
    for count in (1, 2, 4):
        torch.set_num_threads(count)
        results.append(loss_with_gradient(photometric_loss, *images(height, 50), torch.float32))
    assert all(torch.equal(one, other) for result in results[1:] for one, other in zip(results[0], result))


def test_a_nan_pixel_spoils_only_its_surroundings() -> None:
    image, target = images(60, 60)
    _, clean = loss_with_gradient(photometric_loss, image, target, torch.float32)
    image[30, 20, 1] = math.nan
    loss, gradient = loss_with_gradient(photometric_loss, image, target, torch.float32)
    assert loss.isnan()
    touched = torch.zeros_like(gradient, dtype=torch.bool)
    touched[20:41, 10:31, 1] = True  # two windows
    assert gradient[touched].isnan().all()
    assert torch.equal(gradient[~touched], clean[~touched])


def test_the_gradient_scales_with_what_comes_back_and_may_be_asked_for_twice() -> None:
    image, target = images(30, 30)
    _, once = loss_with_gradient(photometric_loss, image, target, torch.float32)
    image.requires_grad_()
    loss = photometric_loss(image, target)
    loss.backward(retain_graph=True)
    (3 * loss).backward()
    torch.testing.assert_close(image.grad, 4 * once)


def test_without_gradients_the_value_is_the_same() -> None:
    image, target = images(30, 30)
    loss = photometric_loss(image, target)
    assert not loss.requires_grad
    with torch.no_grad():
        assert torch.equal(photometric_loss(image.requires_grad_(), target), loss)
    assert torch.equal(photometric_loss(image, target).detach(), loss)


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
    exact = loss_with_gradient(photometric_loss, image, kept.float() / 255, torch.float32)
    image.requires_grad_()
    loss = photometric_loss(image, kept)
    loss.backward()
    assert torch.equal(loss.detach(), exact[0])
    assert torch.equal(image.grad, exact[1])
    torch.testing.assert_close(photometric_loss(image.double(), kept).float(), loss)  # in torch
