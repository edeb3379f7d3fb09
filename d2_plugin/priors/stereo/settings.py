"""Settings of geometric depth: where it comes from, how views are matched, what is carried over."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from d2_plugin.errors import D2Error
from d2_plugin.settings import Angle, Range, Seed, Settings, Share

MatcherName = Literal["auto", "none", "sensor", "workspace", "patchmatch"]
"""What matches views, or what kind of depth on disk is taken in place of matching."""

NO_MATCHER: MatcherName = "none"
"""Nothing is matched and no depth on disk is read: for cameras that share nothing."""

COMMON = ("max_pixels", "between_pixels", "min_sources", "min_angle", "max_angle", "reuse_static")
"""What every matched depth depends on."""

DEPENDS_ON: dict[str, tuple[str, ...]] = {
    "patchmatch": (*COMMON, "patchmatch_sources", "seed"),
    "workspace": ("between_pixels", "min_sources", "min_angle", "max_angle"),
    "sensor": ("sensor_sigma",),
}
"""By matcher, the settings that its depth depends on: a change of any other keeps the maps in the cache. Which folder
and which maps of a workspace are read shows in the maps, whose hash is part of the key. So does `reuse_block`: the key
of a frame holds that of the frame whose matches it carries over."""


@dataclass(frozen=True)
class StereoSettings(Settings):
    """Geometric depth (docs/priors.md)."""

    matcher: MatcherName = "auto"
    """`patchmatch` matches. Depth that lies on disk: `sensor`, `workspace` (COLMAP's). `none` matches nothing and reads
    nothing. `auto` takes the first of sensor (of every camera), workspace and patchmatch that there is."""
    folder: str = ""
    """Where the depth on disk lies, relative to the recording; `{frame}` (as in `mvs/{frame:05d}`) stands for the frame
    number. Where empty: `depth` for `sensor`, `colmap/FRAME`, `colmap` or `dense` for `workspace`."""
    max_pixels: Annotated[int, Range(1, 1 << 28, unit="pixels")] = 500_000
    """Images with more pixels are matched at a half, a third, ... of their size, and all at twice that first; depth
    comes back at full size."""
    patchmatch_device: Literal["auto", "cuda", "cpu"] = "auto"
    """Where patchmatch runs: `auto` takes the GPU where torch sees one. Both return the same depth."""
    patchmatch_sources: Annotated[int, Range(1, 32)] = 4
    """At most this many other views are matched: those that overlap at a good angle."""
    between_pixels: bool = True
    """Read a source's depth between its pixels where they are one surface; off, that of the nearest one."""
    min_sources: Annotated[int, Range(0, 1000)] = 1
    """Number of sources that must confirm a depth; all of them where there are fewer."""
    min_angle: Angle = 1.0
    """A source confirms only where both rays meet at more than this; identical cameras never do."""
    max_angle: Angle = 60.0
    """A source confirms only where both rays meet at less than this; beyond, views look too different for a match to
    mean anything."""
    sensor_sigma: Share = 0.01
    """Relative standard deviation of a depth sensor; matched depth declares its own."""
    reuse_static: bool = True
    """Carry matches over where the image did not change; off matches every frame in full."""
    reuse_block: Annotated[int, Range(0, 1_000_000, unit="frames")] = 30
    """After this many frames everything is matched anew; blocks are independent, and shards are made of them."""
    seed: Seed = 0
    """Seed of the matchers that draw random hypotheses."""

    def __post_init__(self) -> None:
        """Check each value, then those that belong together."""
        super().__post_init__()
        if not self.min_angle < self.max_angle:
            raise D2Error(
                f"setting StereoSettings.min_angle must be below max_angle, got {self.min_angle:g} and "
                f"{self.max_angle:g} degrees: no depth could survive"
            )
