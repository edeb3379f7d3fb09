"""Settings of the alignment of monocular maps: the fit, when to refuse it, and the local correction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from d2_plugin.settings import Count, NotNegative, Positive, Range, Seed, Settings, Share

Correlation = Annotated[float, Range(-1, 1)]


@dataclass(frozen=True)
class AlignSettings(Settings):
    """Alignment of monocular to geometric depth (docs/priors.md)."""

    residual: Literal["relative", "absolute"] = "relative"
    """`absolute` is the paper's a D^m + b - D^g; `relative` divides it by D^g, as verification does. What passes the
    filter is wrong at 1 %. Measured: the median error of aligned maps is .041 with either on studio; the error of the
    line with 20, 40 % wrong anchors (`d2 bench align`) is .005, .011 absolute and .007, .022 relative."""
    epsilon: Positive = 0.02
    """Smoothing of the Charbonnier penalty: of the relative residual, or (absolute) times the median of the target."""
    max_anchors: Annotated[int, Range(1)] = 20_000
    """More anchors than this are subsampled. Measured with 1.4 million: the aligned depth changes by 1.8e-4."""
    min_anchors: Count = 50
    """Fewer anchors than this are refused."""
    min_spread: NotNegative = 1e-3
    """Geometric depths whose 5..95 percentile range is below this share of their median are refused."""
    max_gap: NotNegative = 1e-8
    """Relative duality gap above which a fit is refused. Measured: every case stops below 1e-10."""
    min_t: NotNegative = 10.0
    """Scale over its standard error below which a fit needs `min_correlation`. Measured: clean 2e4, 60 % outliers 80,
    unrelated maps 0.7."""
    min_correlation: Correlation = 0.5
    """Rank correlation that speaks for a scale whose standard error does not. Measured on pose2sim_single: one view has
    t = 4 and t = 69 in two successive frames, at .87 and .86."""
    inlier_error: Positive = 0.1
    """Relative discrepancy e below which an anchor counts as an inlier of the fit."""
    min_inliers: Share = 0.3
    """A smaller share of inliers is refused."""
    wrong_kind_correlation: Correlation = -0.3
    """Rank correlation of the map with what it is declared to be; below this the declared kind is contradicted."""
    local_scales: tuple[Positive, ...] = (0.25, 0.12, 0.06, 0.03)
    """Standard deviations of the windows of the local correction, coarse to fine, in image widths; none is the paper.
    Measured on studio: mono-only error .0425 without, .027 with; see `d2_plugin.priors.monocular.correct`."""
    local_prior: Positive = 0.05
    """Weight of "no correction": a window in which this share of the pixels is known is corrected by half."""
    local_limit: Positive = 0.7
    """Anchors off by more than this in log depth (a factor of two) say nothing about the bend of the map."""
    leverage_guard: bool = False
    """Fit only anchors near the line that passes nearest to the best `min_inliers` of them: every convex fit breaks at
    40 % leverage outliers. The certificate then holds for the anchors that were kept. Measured (`d2 bench align`): with
    20 to 60 % wrong anchors the error of the line is .001 to .003 with, .007 to .16 without, in the same time. Off,
    because filtered anchors are wrong at 1 % (studio) and the guard has not been measured on recordings."""
    together: bool = False
    """Fit the lines of all frames of a block (`stereo.reuse_block`) together: aligned maps must agree where the image
    did not change. Off: on studio and plaza errors stay the same and maps are steadier by a hundredth, while images
    are read twice; docs/priors.md, "Alignment", has the figures."""
    across: bool = True
    """Where the anchors of a map span too little of it to tell a slope, take the slope with which it shows the same
    surfaces as other cameras' maps do (`d2_plugin.priors.monocular.across`); with `agreement` alone."""
    seed: Seed = 0
    """Seed of the subsampling, of the leverage guard and of the samples that are compared between cameras."""
