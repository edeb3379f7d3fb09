"""Image and depth metrics, each in the exact variant that published tables use.

Images are tensors [H, W, 3] in 0..1 and every function returns one number per image; tables are means over images.
All arithmetic is float64 on the CPU. `flicker` alone needs two instants.
`METRICS`, at the end, says in words which definition stands behind each key of metrics.json, and computes it.

The published SSIM_1 and SSIM_2 columns of dense-view papers are scikit-image's `structural_similarity` with a uniform
7x7 window and a data range of 1 or 2. For the same window SSIM_2 >= SSIM_1 in practice; tables where it is lower mix
two definitions.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from d2_plugin.errors import D2Error
from d2_plugin.extras import is_installed

UNIFORM_WINDOW = 7
GAUSSIAN_WINDOW = 11
GAUSSIAN_SIGMA = 1.5
K1, K2 = 0.01, 0.03
"""SSIM's stabilising constants, times the data range."""

LEAST_SLOPE = 0.1
"""Contrast of a render, as a share of the truth's, below which no exposure explains it."""

STRIP_ROWS = 32
"""How many rows of the image are compared at a time."""


def psnr(image: Tensor, truth: Tensor, within: np.ndarray | None = None) -> float:
    """Peak signal to noise ratio in dB, 20 log10(1 / sqrt(MSE)); infinite for equal images.

    `within` [H, W] bool are the pixels that count; all where None. At least one must.

    >>> round(psnr(torch.full((4, 5, 3), 0.1), torch.zeros(4, 5, 3)), 3)
    20.0
    """
    first, second = _pair(image, truth)
    squared = np.square(first - second)
    error = float(squared.mean() if within is None else squared[:, within].mean())
    return math.inf if error == 0 else -10 * math.log10(error)


def psnr_color_corrected(image: Tensor, truth: Tensor) -> float:
    """PSNR after an affine change of each channel: exposure and white balance are no error of the model.

    The least squares fit is a truth + b = image, undone on the image and clamped to 0..1, as gsplat's evaluation does
    (`color_correct_affine`; multinerf's older one is quadratic and mixes channels). Fitted this way round a blurred
    image is not made paler, which would flatter it. A channel in which nothing agrees keeps its contrast, and one that
    the change takes farther from the truth stays as it is, so the figure is never below `psnr`.
    """
    render, target = _pair(image, truth)
    corrected = np.stack([_corrected(*channels) for channels in zip(render, target, strict=True)], -1)
    return psnr(torch.from_numpy(corrected), truth.detach().cpu().double())


def _corrected(image: np.ndarray, truth: np.ndarray) -> np.ndarray:
    deviation = truth - truth.mean()
    slope = float((deviation * image).sum()) / max(float(np.square(deviation).sum()), 1e-12)
    slope = slope if slope > LEAST_SLOPE else 1.0
    corrected = np.clip((image - image.mean()) / slope + truth.mean(), 0, 1)
    return min(corrected, image, key=lambda one: float(np.square(one - truth).sum()))


def ssim_uniform(image: Tensor, truth: Tensor, data_range: float = 1.0, within: np.ndarray | None = None) -> float:
    """Scikit-image's structural similarity: uniform 7x7 window, sample covariance, mean over windows inside the image.

    `within` [H, W] bool are the pixels whose windows count, all where None; nan where there is none inside.

    >>> image = torch.rand(8, 9, 3)
    >>> round(ssim_uniform(image, image), 6)
    1.0
    """
    first, second = _pair(image, truth, UNIFORM_WINDOW)
    count = UNIFORM_WINDOW**2
    taps = [1 / UNIFORM_WINDOW] * UNIFORM_WINDOW
    return _ssim(first, second, taps, data_range, count / (count - 1), within)


def ssim_3dgs(image: Tensor, truth: Tensor) -> float:
    """Structural similarity as 3DGS codebases compute it: Gaussian 11x11 window over a zero-padded image."""
    pair = _pair(image, truth, GAUSSIAN_WINDOW)
    reach = GAUSSIAN_WINDOW // 2
    weights = [math.exp(-0.5 * (offset / GAUSSIAN_SIGMA) ** 2) for offset in range(-reach, reach + 1)]
    taps = [weight / sum(weights) for weight in weights]
    first, second = (np.pad(image, ((0, 0), (reach, reach), (reach, reach))) for image in pair)
    return _ssim(first, second, taps, data_range=1.0, unbias=1.0)


def flip(image: Tensor, truth: Tensor) -> float | None:
    """FLIP of Andersson et al. 2020, 0..1, 0 for equal images: what an eye sees that flips from one to the other on a
    screen of 67 pixels per degree. By NVIDIA's package flip-evaluator; None where it is not installed."""
    if not is_installed("flip_evaluator"):
        return None
    package = importlib.import_module("flip_evaluator")
    first, second = (np.ascontiguousarray(part.transpose(1, 2, 0), np.float32) for part in _pair(truth, image))
    return float(package.evaluate(first, second, "LDR", applyMagma=False)[1])


def flicker(image: Tensor, truth: Tensor, image_before: Tensor, truth_before: Tensor) -> float:
    """Mean error of the change from one frame to the next, |(I_t - I_s) - (T_t - T_s)|, in 0..1; 0 is steady.

    The data sets define no such metric, this is the project's own. It is blind to errors that stay the same, which
    PSNR counts, and sees what PSNR hides: two renders equally wrong, once too bright and once too dark, flicker.
    Compare figures of the same frames only: it grows with the time between them.
    """
    first, second = _pair(image, truth)
    first_before, second_before = _pair(image_before, truth_before)
    if first.shape != first_before.shape:
        raise D2Error(
            f"images of shape {tuple(image.shape)} and {tuple(image_before.shape)} are no two frames of one camera: "
            "give frames of equal size"
        )
    return float(np.abs((first - first_before) - (second - second_before)).mean())


def depth_absrel(depth: Tensor, truth: Tensor) -> float | None:
    """Mean relative depth error |z - z*| / z* over pixels with true depth z* > 0; None where there is none.

    `depth` [H, W] is 0 (or not finite) where nothing was rendered. Such a pixel counts as a relative error of 1:
    leaving it out would flatter a model with holes.
    """
    rendered, true = _known_depths(depth, truth)
    if true.numel() == 0:
        return None
    error = torch.where(rendered > 0, (rendered - true).abs() / true, torch.ones_like(true))
    return error.mean().item()


def depth_delta1(depth: Tensor, truth: Tensor) -> float | None:
    """Share of pixels with true depth where max(z / z*, z* / z) < 1.25; None where there is no truth.

    A missing rendered depth counts as a miss.
    """
    rendered, true = _known_depths(depth, truth)
    if true.numel() == 0:
        return None
    ratio = torch.maximum(rendered / true, true / rendered.clamp(min=torch.finfo(true.dtype).tiny))
    return ((ratio < 1.25) & (rendered > 0)).double().mean().item()


def _known_depths(depth: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
    """Rendered (0 = missing) and true depth, float64, at the pixels that have a true one."""
    if depth.shape != truth.shape:
        raise D2Error(f"rendered depth {tuple(depth.shape)} and truth {tuple(truth.shape)} differ: compare equal sizes")
    known = torch.isfinite(truth) & (truth > 0)
    rendered = depth[known].double()
    return torch.where(torch.isfinite(rendered), rendered, 0.0), truth[known].double()


def _ssim(
    image: np.ndarray,
    truth: np.ndarray,
    taps: Sequence[float],
    data_range: float,
    unbias: float,
    within: np.ndarray | None = None,
) -> float:
    """Mean SSIM over windows inside the images [3, H, W]; `unbias` turns window variances into sample variances.

    Goes over the image in strips, which stay in the processor's cache and keep memory small for large images.
    """
    margin = len(taps) - 1
    centres = slice(margin // 2, -(margin // 2))
    rows, columns = image.shape[1] - margin, image.shape[2] - margin
    counted = np.ones((rows, columns), bool) if within is None else within[centres, centres]
    total = 0.0
    for start in range(0, rows, STRIP_ROWS):
        strip = slice(start, min(start + STRIP_ROWS, rows) + margin)
        similar = _similarity(image[:, strip], truth[:, strip], taps, data_range, unbias)
        total += float(similar.sum() if within is None else similar[:, counted[start : start + STRIP_ROWS]].sum())
    count = image.shape[0] * int(counted.sum())
    return total / count if count else math.nan


def _similarity(
    image: np.ndarray, truth: np.ndarray, taps: Sequence[float], data_range: float, unbias: float
) -> np.ndarray:
    """The SSIM of every window inside the images, [3, H - w + 1, W - w + 1] for w taps."""
    c1, c2 = (K1 * data_range) ** 2, (K2 * data_range) ** 2
    products = np.stack([image, truth, image * image, truth * truth, image * truth])
    mean_x, mean_y, square_x, square_y, cross = _filtered(_filtered(products, taps, -1), taps, -2)
    variance_x, variance_y = unbias * (square_x - mean_x**2), unbias * (square_y - mean_y**2)
    covariance = unbias * (cross - mean_x * mean_y)
    luminance = (2 * mean_x * mean_y + c1) / (mean_x**2 + mean_y**2 + c1)
    structure = (2 * covariance + c2) / (variance_x + variance_y + c2)
    return luminance * structure


def _filtered(values: np.ndarray, taps: Sequence[float], axis: int) -> np.ndarray:
    """Correlation with `taps` along one axis, where the window fits."""
    moved = np.swapaxes(values, axis, 0)
    length = len(moved) - len(taps) + 1
    return np.swapaxes(sum(tap * moved[start : start + length] for start, tap in enumerate(taps)), axis, 0)


def _pair(image: Tensor, truth: Tensor, window: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Both images as [3, H, W] float64 (in float32 the variances of flat regions would be rounding noise)."""
    if not isinstance(image, Tensor) or not isinstance(truth, Tensor):
        kinds = f"{type(image).__name__} and {type(truth).__name__}"
        raise D2Error(f"images are compared as tensors [H, W, 3], got {kinds}: give two tensors")
    if image.shape != truth.shape or image.ndim != 3 or image.shape[2] != 3:
        raise D2Error(
            f"images of shape {tuple(image.shape)} and {tuple(truth.shape)} cannot be compared: give two [H, W, 3]"
        )
    if min(image.shape[:2]) < window:
        raise D2Error(
            f"an image of {image.shape[1]}x{image.shape[0]} pixels is smaller than the {window}x{window} window "
            "of this metric: compare larger images"
        )
    first, second = (image.detach().cpu().double().permute(2, 0, 1).numpy() for image in (image, truth))
    return np.ascontiguousarray(first), np.ascontiguousarray(second)


@dataclass(frozen=True, eq=False)
class Compared:
    """One view as it is scored."""

    image: Tensor
    truth: Tensor
    depth: Tensor | None = None
    true_depth: Tensor | None = None
    moving: np.ndarray | None = None
    """[H, W] bool, pixels of the truth that show something that moves; None where nothing does or nobody knows."""
    before: tuple[Tensor, Tensor] | None = None
    """Render and truth of the frame before, of the same camera."""
    networks: Mapping[str, Callable[[Tensor, Tensor], float] | None] = field(default_factory=dict)
    inside: np.ndarray | None = None
    """[H, W] bool, recorded pixels inside the recording's foreground mask; None where it has none."""
    recorded: np.ndarray | None = None
    """[H, W] bool, pixels that were recorded; None where all were. At the others image and truth are the same."""

    @property
    def pixels(self) -> tuple[Tensor, Tensor]:
        """Image and truth [1, K, 3] of what was recorded, whole where all was."""
        if self.recorded is None:
            return self.image, self.truth
        where = torch.from_numpy(self.recorded)
        return self.image[where][None], self.truth[where][None]

    @property
    def depths(self) -> tuple[Tensor, Tensor] | None:
        """Rendered and true depth where there are both."""
        return None if self.depth is None or self.true_depth is None else (self.depth, self.true_depth)

    def by_network(self, name: str) -> float | None:
        """What a network says of the two images; None where it is not there."""
        network = self.networks.get(name)
        return None if network is None else network(self.image, self.truth)


@dataclass(frozen=True)
class Metric:
    """A key of metrics.json: its definition in words, and its value for one view."""

    variant: str
    score: Callable[[Compared], float | None]


NO_DIFFERENCE = 100.0
"""What counts as the PSNR of equal images, dB: their own is infinite, which has no mean and no place in JSON."""

METRICS = {
    "psnr": Metric(
        f"20 log10(1 / sqrt(MSE)) of an image's recorded pixels in dB, at most {NO_DIFFERENCE:g}; mean over images",
        lambda c: min(psnr(c.image, c.truth, c.recorded), NO_DIFFERENCE),
    ),
    "psnr_cc": Metric(
        "PSNR with a truth + b = image undone in each channel where that helps (gsplat color_correct_affine)",
        lambda c: min(psnr_color_corrected(*c.pixels), NO_DIFFERENCE),
    ),
    "psnr_moving": Metric(
        "PSNR of the pixels that differ by more than 12/255 from the median of their camera's frames (this project)",
        lambda c: None if c.moving is None else min(psnr(c.image, c.truth, c.moving), NO_DIFFERENCE),
    ),
    "psnr_mask": Metric(
        "PSNR of the recorded pixels inside the recording's foreground mask, where it has one (this project)",
        lambda c: None if c.inside is None else min(psnr(c.image, c.truth, c.inside), NO_DIFFERENCE),
    ),
    "ssim1": Metric(
        "uniform 7x7 window, sample covariance, 3 px border dropped, data range 1 (scikit-image)",
        lambda c: ssim_uniform(c.image, c.truth, within=c.recorded),
    ),
    "ssim2": Metric(
        "uniform 7x7 window, sample covariance, 3 px border dropped, data range 2 (scikit-image)",
        lambda c: ssim_uniform(c.image, c.truth, 2.0, c.recorded),  # scikit-image's old default for floats
    ),
    "ssim_3dgs": Metric(
        "Gaussian 11x11 window with sigma 1.5, zero padding, biased covariance (3DGS)",
        lambda c: ssim_3dgs(c.image, c.truth),
    ),
    "lpips": Metric(
        "version 0.1 on AlexNet, images in 0..1 unmapped (lpipsPyTorch, as 3DGS codebases)",
        lambda c: c.by_network("lpips"),
    ),
    "lpips_vgg": Metric(
        "version 0.1 on VGG16, images in 0..1 unmapped (lpipsPyTorch, as 3DGS codebases)",
        lambda c: c.by_network("lpips_vgg"),
    ),
    "flip": Metric(
        "LDR-FLIP at 67 pixels per degree, mean over the image (flip-evaluator), where that is installed",
        lambda c: flip(c.image, c.truth),
    ),
    "flicker": Metric(
        "mean |(I_t - I_s) - (T_t - T_s)| of render I and truth T, s the frame compared before t (this project)",
        lambda c: None if c.before is None else flicker(c.image, c.truth, *c.before),
    ),
    "depth_absrel": Metric(
        "mean |z - z*| / z* over true depth; a missing rendered depth counts as 1",
        lambda c: None if c.depths is None else depth_absrel(*c.depths),
    ),
    "depth_delta1": Metric(
        "share of true depth with max(z / z*, z* / z) < 1.25; a missing rendered depth counts as a miss",
        lambda c: None if c.depths is None else depth_delta1(*c.depths),
    ),
}
"""All metrics, in the order of metrics.json. One row is all that a metric takes; `tables.COLUMNS` shows it."""

VARIANTS = {name: metric.variant for name, metric in METRICS.items()}
"""The definition of each metric in words."""
