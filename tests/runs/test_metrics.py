"""Metrics agree with the reference implementations they are named after."""

import doctest
import importlib.util
import logging
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refuses
from torch import nn

from d2_plugin.gaussians.photometric import ssim
from d2_plugin.runs import metrics
from d2_plugin.runs.lpips import find_lpips


def sine_pair() -> tuple[torch.Tensor, torch.Tensor]:
    """Waves [H, W, 3], and the same a pixel further to the right."""
    y, x = np.mgrid[0:48, 0:64]
    waves = [0.5 + 0.4 * np.sin(x / 7 + y / 11), 0.5 + 0.4 * np.cos(x / 5), 0.5 + 0.4 * np.sin(y / 6)]
    a = torch.from_numpy(np.stack(waves, -1)).float()
    return a, a.roll(1, 1)


def scikit_image(a: torch.Tensor, b: torch.Tensor, data_range: float) -> float:
    structural_similarity = pytest.importorskip("skimage.metrics").structural_similarity
    return structural_similarity(a.double().numpy(), b.double().numpy(), data_range=data_range, channel_axis=2)


@settings(max_examples=25, deadline=None)
@given(st.integers(7, 90), st.integers(7, 40), st.floats(0.0, 0.5), st.integers(0, 2**31))
def test_ssim1_and_ssim2_are_scikit_images(height: int, width: int, noise: float, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    a = torch.rand(height, width, 3, generator=generator)
    b = (a + noise * torch.randn(a.shape, generator=generator)).clamp(0, 1)
    assert metrics.ssim_uniform(a, b) == pytest.approx(scikit_image(a, b, 1.0), abs=1e-9)
    assert metrics.ssim_uniform(a, b, 2.0) == pytest.approx(scikit_image(a, b, 2.0), abs=1e-9)


def test_the_gaussian_ssim_is_the_convolution_of_3dgs() -> None:
    """The metric and the loss; written out with torch's convolution, as the codebases do it."""
    a, b = (image.double().permute(2, 0, 1)[None] for image in sine_pair())
    taps = torch.exp(-((torch.arange(11, dtype=torch.float64) - 5) ** 2) / (2 * 1.5**2))
    window = torch.outer(taps, taps).div(taps.sum() ** 2).expand(3, 1, 11, 11)

    def blur(x: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.conv2d(x, window, padding=5, groups=3)

    mean_a, mean_b = blur(a), blur(b)
    var_a, var_b, cov = blur(a * a) - mean_a**2, blur(b * b) - mean_b**2, blur(a * b) - mean_a * mean_b
    top = (2 * mean_a * mean_b + 1e-4) * (2 * cov + 9e-4)
    expected = (top / ((mean_a**2 + mean_b**2 + 1e-4) * (var_a + var_b + 9e-4))).mean().item()
    assert metrics.ssim_3dgs(*sine_pair()) == pytest.approx(expected, abs=1e-12)
    assert ssim(*(image.double() for image in sine_pair())).item() == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize(("metric", "size"), [(metrics.ssim_uniform, 7), (metrics.ssim_3dgs, 11)])
def test_a_window_larger_than_the_image_is_refused(metric: Callable[..., float], size: int) -> None:
    assert math.isfinite(metric(torch.rand(size, size, 3), torch.rand(size, size, 3)))
    small = torch.rand(size - 1, 40, 3)
    refuses(f"40x{size - 1} pixels is smaller than the {size}x{size} window", metric, small, small)


@pytest.mark.parametrize(
    ("metric", "sizes", "message"),
    [
        (metrics.psnr, ((8, 8, 3), (8, 9, 3)), "cannot be compared"),
        (metrics.psnr, ((3, 8, 8), (3, 8, 8)), "cannot be compared"),
        (metrics.depth_absrel, ((8, 8), (4, 4)), "differ: compare equal sizes"),
        (metrics.flicker, ((4, 4, 3), (4, 4, 3), (8, 4, 3), (8, 4, 3)), "no two frames of one camera"),
    ],
)
def test_what_cannot_be_compared_is_refused(metric, sizes, message) -> None:
    refuses(message, metric, *map(torch.rand, sizes))


def test_flip_is_nvidias_own_and_without_its_package_it_is_not_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    a, b = sine_pair()
    with monkeypatch.context() as patch:
        patch.setattr(importlib.util, "find_spec", lambda name: None)
        assert metrics.flip(a, b) is None
    package = pytest.importorskip("flip_evaluator", reason="flip-evaluator is in the `flip` extra")
    assert metrics.flip(a, a) == 0
    assert metrics.flip(a, b) == pytest.approx(package.evaluate(b.numpy(), a.numpy(), "LDR")[1], abs=1e-6)
    assert metrics.flip(a, b) > 0.05


def test_flicker_is_blind_to_constant_errors_and_to_true_motion() -> None:
    before, after = torch.rand(2, 6, 8, 3, generator=torch.Generator().manual_seed(0))
    assert metrics.flicker(after, after, before, before) == 0
    assert metrics.flicker(after + 0.2, after, before + 0.2, before) == pytest.approx(0, abs=1e-7)
    assert metrics.flicker(after + 0.1, after, before - 0.1, before) == pytest.approx(0.2, abs=1e-7)
    assert metrics.psnr(after + 0.1, after) == pytest.approx(metrics.psnr(before - 0.1, before), abs=1e-4)


def test_depth_errors_count_true_pixels_only() -> None:
    truth = torch.tensor([[2.0, 4.0, 0.0, math.nan]])
    depth = torch.tensor([[2.2, 3.0, 9.0, 9.0]])
    assert metrics.depth_absrel(depth, truth) == pytest.approx((0.1 + 0.25) / 2)
    assert metrics.depth_delta1(depth, truth) == 0.5
    assert metrics.depth_absrel(depth, torch.zeros(1, 4)) is None
    assert metrics.depth_delta1(depth, torch.zeros(1, 4)) is None


@pytest.fixture(scope="module")
def image() -> torch.Tensor:
    rows, columns = torch.meshgrid(torch.linspace(0, 6, 40), torch.linspace(0, 9, 50), indexing="ij")
    return 0.5 + 0.3 * torch.stack([torch.sin(columns), torch.cos(rows), torch.sin(rows + columns)], -1)


def test_another_exposure_and_white_balance_are_no_error_after_colour_correction(image: torch.Tensor) -> None:
    other = image * torch.tensor([1.2, 0.9, 1.05]) + torch.tensor([0.02, 0.05, -0.04])
    assert metrics.psnr(other, image) < 25
    assert metrics.psnr_color_corrected(other, image) > 90
    assert metrics.psnr_color_corrected(image, image) > 90


def test_colour_correction_neither_flatters_a_blurred_render_nor_invents_contrast(image: torch.Tensor) -> None:
    """Noise is divided by the slope as well: no fit in the other direction, which would fade it out."""
    noise = 0.2 * torch.rand(image.shape, generator=torch.Generator().manual_seed(0)) - 0.1
    noisy = image + noise
    assert metrics.psnr_color_corrected(noisy, image) == pytest.approx(metrics.psnr(noisy, image), abs=0.2)
    flat = torch.full_like(image, 0.3)
    mean = image.mean((0, 1)).expand_as(image)
    assert metrics.psnr_color_corrected(flat, image) == pytest.approx(metrics.psnr(mean, image))
    faint = 0.5 + 0.12 * (image - 0.5) + noise  # undoing its slope makes its noise eight times as large
    assert metrics.psnr_color_corrected(faint, image) >= metrics.psnr(faint, image)


def test_the_examples_of_the_docstrings_run_and_equal_images_are_infinitely_alike() -> None:
    assert doctest.testmod(metrics).failed == 0
    assert metrics.psnr(torch.zeros(4, 5, 3), torch.zeros(4, 5, 3)) == math.inf
    assert math.isnan(metrics.psnr(torch.full((4, 5, 3), math.nan), torch.zeros(4, 5, 3))), "no number is no likeness"


CONVOLUTIONS = {
    "alex": {0: (64, 3, 11), 3: (192, 64, 5), 6: (384, 192, 3), 8: (256, 384, 3), 10: (256, 256, 3)},
    "vgg": {0: (64, 3, 3), 2: (64, 64, 3), 5: (128, 64, 3), 7: (128, 128, 3), 10: (256, 128, 3), 12: (256, 256, 3),
            14: (256, 256, 3), 17: (512, 256, 3), 19: (512, 512, 3), 21: (512, 512, 3), 24: (512, 512, 3),
            26: (512, 512, 3), 28: (512, 512, 3)},
}  # fmt: skip
"""Layer numbers and shapes (out, in, kernel) of torchvision's state dictionaries."""

FILES = {"alex": "alexnet-owt-7be5be79.pth", "vgg": "vgg16-397923af.pth"}
"""As torchvision publishes them."""


def write_weights(folder: Path, net: str = "alex") -> dict[str, torch.Tensor]:
    """Random weights of a network and its linear layers, in files named and keyed like the published ones."""
    generator = torch.Generator().manual_seed(0)
    state = {"classifier.1.weight": torch.zeros(2, 2)}  # ignored
    for number, (out, width, kernel) in CONVOLUTIONS[net].items():
        shape = (out, width, kernel, kernel)
        state[f"features.{number}.weight"] = torch.randn(shape, generator=generator) * (2 / (width * kernel**2)) ** 0.5
        state[f"features.{number}.bias"] = 0.1 * torch.randn(out, generator=generator)
    linear = {
        f"lin{i}.model.1.weight": torch.rand(1, channels, 1, 1, generator=generator)
        for i, channels in enumerate(CONVOLUTIONS[net][block[-1][0]][0] for block in BLOCKS[net])
    }
    torch.save(state, folder / FILES[net])
    torch.save(linear, folder / f"{net}.pth")
    return state | linear


BLOCKS = {
    "alex": [[(0, 4, 2)], [(3, 1, 2)], [(6, 1, 1)], [(8, 1, 1)], [(10, 1, 1)]],
    "vgg": [[(n, 1, 1) for n in block] for block in ((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28))],
}
"""Layer, stride and padding of each convolution, by the depth at which features are compared."""

POOLED = {"alex": {1: 3, 2: 3}, "vgg": dict.fromkeys(range(1, 5), 2)}
"""Window of the pooling before a block."""


@pytest.mark.parametrize("net", ["alex", "vgg"])
def test_the_distance_is_the_published_formula_on_images_in_0_to_1(tmp_path: Path, net: str) -> None:
    weights, before = write_weights(tmp_path, net), torch.get_rng_state()
    distance = find_lpips(net, tmp_path)
    assert torch.equal(torch.get_rng_state(), before)
    a, b = torch.rand(2, 66, 66, 3, generator=torch.Generator().manual_seed(2))
    shift, scale = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
    x = torch.stack([((image - shift) / scale).permute(2, 0, 1) for image in (a, b)])
    total = 0.0
    for i, block in enumerate(BLOCKS[net]):
        x = nn.functional.max_pool2d(x, POOLED[net][i], 2) if i in POOLED[net] else x
        for number, stride, padding in block:
            weight, bias = weights[f"features.{number}.weight"], weights[f"features.{number}.bias"]
            x = nn.functional.conv2d(x, weight, bias, stride=stride, padding=padding).relu()
        unit = x / (x.square().sum(1, keepdim=True).sqrt() + 1e-10)
        total += nn.functional.conv2d((unit[:1] - unit[1:]) ** 2, weights[f"lin{i}.model.1.weight"]).mean().item()
    assert distance(a, b) == pytest.approx(total, rel=1e-5)
    refuses("at least 64x64 pixels", distance, a[:32], b[:32])


def test_without_weights_it_is_not_available_and_says_so_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, logger="d2_plugin.runs.lpips"):
        assert find_lpips("alex", tmp_path) is None
    [record] = caplog.records
    assert "LPIPS is not available" in record.message
    assert "alex.pth" in record.message


def test_files_that_are_no_weights_are_refused(tmp_path: Path) -> None:
    write_weights(tmp_path)
    torch.save({"lin0.model.1.weight": torch.rand(1, 64, 1, 1)}, tmp_path / "alex.pth")
    refuses("as LPIPS alex .*: check the files", find_lpips, "alex", tmp_path)
    (tmp_path / "alex.pth").write_bytes(b"nothing")
    refuses(r"cannot read LPIPS weights .*alex\.pth", find_lpips, "alex", tmp_path)
    refuses("unknown LPIPS network 'squeeze'", find_lpips, "squeeze", tmp_path)


def test_ssim_within_some_pixels_is_the_mean_of_their_windows() -> None:
    """Over 32 rows, so that strips meet; of two halves of the pixels it adds up to the whole image."""
    generator = torch.Generator().manual_seed(0)
    image, truth = (torch.rand(50, 21, 3, generator=generator) for _ in range(2))
    half = np.random.default_rng(0).random((50, 21)) < 0.3
    inside = np.zeros_like(half)
    inside[3:-3, 3:-3] = True
    parts = [(metrics.ssim_uniform(image, truth, within=part), (part & inside).sum()) for part in (half, ~half)]
    whole = metrics.ssim_uniform(image, truth)
    assert sum(score * count for score, count in parts) / inside.sum() == pytest.approx(whole, abs=1e-12)
    assert metrics.ssim_uniform(image, truth, within=inside) == pytest.approx(whole, abs=1e-12)
    assert math.isnan(metrics.ssim_uniform(image, truth, within=~inside))
