"""Settings of the alignment of monocular maps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from d2_plugin.settings import Count, Range, Settings, Share


@dataclass(frozen=True)
class AlignSettings(Settings):
    """Monocular depth aligned to geometric."""

    residual: Literal["relative", "absolute"] = "relative"
    """`absolute` is the paper's a D^m + b - D^g; `relative` divides it by D^g, as verification does."""
    epsilon: Annotated[float, Range(1e-6, 1e6)] = 0.02
    """Smoothing of the Charbonnier penalty: of the relative residual, or (absolute) times the median of the target."""
    min_anchors: Count = 50
    """Fewer anchors than this are refused."""
    min_inliers: Share = 0.3
    """A fit is refused where a smaller share of the anchors agrees with it within 10 %."""
    local_correction: bool = True
    """Bend the aligned map by the geometric depths around each pixel; off, as in the paper, it stays one line."""
    across: bool = True
    """Where the anchors of a map span too little of it to tell a slope, take the slope with which it shows the same
    surfaces as other cameras' maps do (`d2_plugin.priors.monocular.across`); with `agreement` alone."""
