"""Settings of the depth priors: one frozen dataclass per stage, a docstring and a measurement under each default."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class StereoSettings:
    """Geometric depth: how views are matched and which depths survive (`reference/priors.md` sections 2 and 3)."""

    maker: str = "auto"
    """`patchmatch` (compiled), `sweep` (OpenCV), or `auto`: patchmatch where there is a compiler."""
    sweep_step: float = 0.5
    """Disparity between neighbouring planes of the sweep, source pixels; above half a pixel the minimum is missed."""
    sweep_window: int = 3
    """Side of the box over which the sweep correlates, pixels; the guided filter then aggregates the cost."""
    sweep_guide_radius: int = 4
    """Radius of the guided filter over the sweep's cost slices, pixels."""
    sweep_guide_epsilon: float = 0.02
    """Contrast below which the guided filter averages across an edge of the picture, in 0..1."""
    cost_max: float = 0.5
    """A depth survives when its matching cost 1 - NCC (0..2) is below this."""
    texture_window: int = 11
    """Side of the window in which texture is measured, pixels."""
    texture_min: float = 0.02
    """A depth survives where the grey value's standard deviation in the window exceeds this, in 0..1 (OpenMVS)."""
    reprojection_max: float = 1.0
    """Forward-backward reprojection error of a confirming source must be below this, pixels (COLMAP)."""
    relative_depth_max: float = 0.01
    """Relative depth difference to a confirming source must be below this."""
    min_sources: int = 2
    """Number of sources that must confirm a depth; all of them where there are fewer."""
    min_angle: float = 1.0
    """A source confirms only where both rays meet at more than this, degrees; identical cameras never do."""
    speckle_size: int = 50
    """Connected pieces of the depth map with fewer pixels are dropped."""
    seed: int = 0
    """Seed of the makers that draw random hypotheses."""
