"""Settings of geometric depth: how views are matched, which depths survive the filter, what is carried over."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from d2_plugin.errors import D2Error
from d2_plugin.settings import Angle, Count, NotNegative, Positive, Range, Seed, Settings, Share

MatcherName = Literal["auto", "none", "sensor", "workspace", "colmap", "patchmatch", "sweep"]
"""What matches views, or what kind of depth on disk is taken in place of matching."""

NO_MATCHER: MatcherName = "none"
"""Nothing is matched and no depth on disk is read: for cameras that share nothing."""

Pixels = Annotated[int, Range(0, unit="pixels")]
Side = Annotated[int, Range(1, unit="pixels")]


@dataclass(frozen=True)
class StereoSettings(Settings):
    """Geometric depth: matching and filter (docs/priors.md)."""

    matcher: MatcherName = "auto"
    """Matchers: `patchmatch` (compiled), `sweep` (OpenCV), `colmap` (needs CUDA). Depth that lies on disk: `sensor`,
    `workspace` (COLMAP's). `none` matches nothing and reads nothing. `auto` takes the first of sensor (of every
    camera), workspace, colmap, patchmatch and sweep that there is. Measured on eight rigs of 2 to 4 views: F of
    patchmatch is above the sweep's on each, narrow pairs too."""
    folder: str = ""
    """Where the depth on disk lies, relative to the recording; `{frame}` (as in `mvs/{frame:05d}`) stands for the frame
    number. Where empty: `depth` for `sensor`, `colmap/FRAME`, `colmap` or `dense` for `workspace`."""
    max_pixels: Annotated[int, Range(1, unit="pixels")] = 500_000
    """Images with more pixels are matched at a half, a third, ... of their size; depth comes back at full size.
    Windows of 11 pixels see more of a wall at half size. Measured on n3dv_sear_steak_t0 (1352x1014, 4 views): at half
    size 35 % verified in 14 CPU seconds, in full 28 % in 47, with the same median deviation from SIFT points."""
    patchmatch_device: Literal["auto", "cuda", "cpu"] = "auto"
    """Where patchmatch runs: `auto` takes the GPU where torch sees one. Both return the same depth."""
    patchmatch_rounds: tuple[Count, ...] = (4, 2, 2, 1)
    """Red-black sweeps at each resolution, coarsest first; each resolution is twice the one before, the last is full.
    A second sweep at full resolution fits noise. Measured: it costs half as much again."""
    patchmatch_sources: Annotated[int, Range(1, 32)] = 4
    """At most this many other views are matched, those that overlap at a good angle."""
    patchmatch_contrast: Positive = 0.08
    """Standard deviation of the bilateral weight over grey values in a matching window, in 0..1."""
    patchmatch_geometric_rounds: Count = 0
    """Extra passes that also ask the other views' depths (1 is a "dense" mode): more complete, and more often wrong."""
    patchmatch_geometric_weight: NotNegative = 0.1
    """Matching cost of one pixel of forward-backward error in those passes."""
    patchmatch_consensus_passes: Count = 2
    """How often each plane is averaged with those of its neighbours that agree with it; 0 keeps the raw planes."""
    patchmatch_consensus_tolerance: NotNegative = 0.02
    """Neighbouring planes agree when they pass within this share of the inverse depth."""
    colmap_geometric: bool = True
    """Whether COLMAP's second pass runs, which asks the other views' depths; the paper's COLMAP does."""
    colmap_minutes: Annotated[float, Range(0, unit="minutes", open_low=True)] = 30.0
    """COLMAP is ended when it takes longer than this for one timestamp."""
    sweep_step: Annotated[float, Range(0, unit="pixels", open_low=True)] = 1.0
    """Mean disparity between neighbouring planes of the sweep, in the source view. A parabola finds what lies between
    two planes. Measured on four Middlebury pairs: half a pixel doubles the time and changes F at 1 % by .015 at most,
    either way."""
    sweep_window: Side = 3
    """Side of the box over which the sweep correlates; the guided filter then aggregates the cost."""
    sweep_guide_radius: Pixels = 4
    """Radius of the guided filter over the sweep's cost slices."""
    sweep_guide_epsilon: Positive = 0.02
    """Contrast below which the guided filter averages across an edge of the image, in 0..1."""
    cost_max: Annotated[float, Range(0, 2)] = 0.5
    """A depth survives when its matching cost 1 - NCC is below this."""
    texture_window: Side = 11
    """Side of the window in which texture is measured."""
    texture_min: NotNegative = 0.005
    """A depth survives where the grey value's standard deviation in the window exceeds this, in 0..1. Only windows
    without any texture are refused, because coherence tells wrong matches better; OpenMVS, without it, asks for .02."""
    coherence_min: Share = 0.57
    """A depth survives when this share of its neighbours lies on its tangent plane; 0 switches the test off."""
    coherence_radius: Pixels = 9
    """Half the side of the window whose pixels are asked for coherence."""
    coherence_contrast: Positive = 0.05
    """Neighbours whose grey value differs by more than this (0..1) have little say in coherence."""
    reprojection_max: Annotated[float, Range(0, unit="pixels", open_low=True)] = 1.0
    """Forward-backward reprojection error of a confirming source must be below this, as in COLMAP."""
    between_pixels: bool = True
    """Read a source's depth between its pixels where they are one surface; off, that of the nearest one. Measured:
    plaza's verified share grows from 19.3 to 25.6 % (4 views) and 1.7 to 2.3 % (2 views), off by more than 1 % are .57
    instead of .65 % and 4.3 instead of 6.8 %; other recordings gain up to .6 % of their pixels."""
    relative_depth_max: Positive = 0.01
    """Relative depth difference to a confirming source must be below this."""
    min_sources: Count = 1
    """Number of sources that must confirm a depth; all of them where there are fewer. One is enough beside the
    coherence test. Measured on studio, where a third of the surface is in two views only: a second one costs 46 % of
    the depths."""
    min_angle: Angle = 1.0
    """A source confirms only where both rays meet at more than this; identical cameras never do."""
    max_angle: Angle = 60.0
    """A source confirms only where both rays meet at less than this; beyond, views look too different for a match to
    mean anything. Measured on a synthetic pair with plain walls: 10.5 % of the depths are off by more than 5 % without
    this limit, .9 % with it, and as many are right."""
    sensor_sigma: Share = 0.01
    """Relative standard deviation of a depth sensor; matched depth declares its own."""
    speckle_size: Pixels = 20
    """Connected pieces of the depth map with fewer pixels are dropped."""
    reuse_static: bool = True
    """Carry matches over where the image did not change; off matches every frame in full."""
    reuse_change: Share = 12 / 255
    """Change of the grey value (0..1, mean of 3x3 pixels) above which a pixel is matched anew."""
    reuse_radius: Pixels = 6
    """Pixels this near to a change are matched anew too: the matching window reaches that far."""
    reuse_margin: Pixels = 4
    """Pixels this near to those are matched with them, to hand over good planes, but not taken. Measured on studio:
    median error of verified pixels .00090 with and .00098 without, .00086 where every frame is matched in full."""
    reuse_block: Annotated[int, Range(0, unit="frames")] = 30
    """After this many frames everything is matched anew; blocks are independent, and shards are made of them."""
    seed: Seed = 0
    """Seed of the matchers that draw random hypotheses."""

    def __post_init__(self) -> None:
        """Check each value, then those that belong together."""
        super().__post_init__()
        if not self.patchmatch_rounds:
            raise D2Error("setting StereoSettings.patchmatch_rounds needs at least one level, got none: write [1]")
        if not self.min_angle < self.max_angle:
            raise D2Error(
                f"setting StereoSettings.min_angle must be below max_angle, got {self.min_angle:g} and "
                f"{self.max_angle:g} degrees: no depth could survive"
            )

    @classmethod
    def from_dict(cls, table: Mapping[str, Any], where: str = "priors.stereo") -> StereoSettings:
        """From a table as TOML gives it (see `Settings.from_dict`).

        Raises:
            D2Error: an unknown name, a value of the wrong type or out of range, or `maker`, the old name of `matcher`.
        """
        if isinstance(table, Mapping) and "maker" in table:
            raise D2Error(f"setting maker in [{where}] is now called matcher: write matcher = {table['maker']!r}")
        return super().from_dict(table, where)
