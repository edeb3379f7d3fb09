"""Settings of the depth priors: one frozen dataclass per stage, a docstring and a measurement under each default."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from d2_plugin.captures.capture import MonoKind
from d2_plugin.errors import D2Error, unknown_name

NO_MATCHER = "none"
"""What `StereoSettings.maker` says where nothing is matched."""


@dataclass(frozen=True)
class StereoSettings:
    """Geometric depth: how views are matched and which depths survive (`reference/priors.md` sections 2 and 3)."""

    maker: str = "auto"
    """Matchers: `patchmatch` (compiled), `sweep` (OpenCV), `colmap` (needs CUDA). Depth that lies on disk: `workspace`
    (COLMAP's), `sensor`. `none` matches nothing and reads nothing. `auto` takes the first there is of sensor (of every
    camera), workspace, colmap, patchmatch, sweep. Measured on eight rigs of 2 to 4 views: F of patchmatch is above the
    sweep's on each, narrow pairs too."""
    folder: str = ""
    """Where the depth on disk lies, relative to the capture; `{frame}` (as in `mvs/{frame:05d}`) stands for the frame
    number. Where empty: `depth` for `sensor`, `colmap/FRAME`, `colmap` or `dense` for `workspace`."""
    max_pixels: int = 500_000
    """Pictures with more pixels are matched at a half, a third, ... of their size; depth comes back at full size.
    Measured on n3dv_sear_steak_t0 (1352x1014, 4 views): at half size 35 % verified in 14 CPU seconds, in full 28 % in
    47, with the same median deviation from SIFT points; windows of 11 pixels see more of a wall at half size."""
    patchmatch_rounds: tuple[int, ...] = (4, 2, 2, 1)
    """Red-black sweeps at each resolution, coarsest first; each resolution is twice the one before, the last is full.
    A second sweep at full resolution fits noise and costs half as much again."""
    patchmatch_sources: int = 4
    """At most this many other views are matched, those that overlap at a good angle."""
    patchmatch_contrast: float = 0.08
    """Standard deviation of the bilateral weight over grey values in a matching window, in 0..1."""
    patchmatch_geometric_rounds: int = 0
    """Extra passes that also ask the other views' depths (1 is a "dense" mode): more complete, and more often wrong."""
    patchmatch_geometric_weight: float = 0.1
    """Matching cost of one pixel of forward-backward error in those passes."""
    patchmatch_consensus_passes: int = 2
    """How often each plane is averaged with those of its neighbours that agree with it; 0 keeps the raw planes."""
    patchmatch_consensus_tolerance: float = 0.02
    """Neighbouring planes agree when they pass within this share of the inverse depth."""
    colmap_geometric: bool = True
    """Whether COLMAP's second pass runs, which asks the other views' depths; the paper's COLMAP does."""
    colmap_minutes: float = 30.0
    """COLMAP is ended when it takes longer than this for one timestamp."""
    sweep_step: float = 1.0
    """Mean disparity between neighbouring planes of the sweep, source pixels. Measured on four Middlebury pairs: half a
    pixel doubles the time and changes F at 1 % by .015 at most, either way: the parabola finds what lies between."""
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
    texture_min: float = 0.005
    """A depth survives where the grey value's standard deviation in the window exceeds this, in 0..1. Coherence tells
    wrong matches better, so only windows without any texture are refused; OpenMVS, without it, asks for .02."""
    coherence_min: float = 0.57
    """A depth survives when this share of its neighbours lies on its tangent plane; 0 switches the test off."""
    coherence_radius: int = 9
    """Half the side of the window whose pixels are asked for coherence, pixels."""
    coherence_contrast: float = 0.05
    """Neighbours whose grey value differs by more than this (0..1) have little say in coherence."""
    reprojection_max: float = 1.0
    """Forward-backward reprojection error of a confirming source must be below this, pixels (COLMAP)."""
    relative_depth_max: float = 0.01
    """Relative depth difference to a confirming source must be below this."""
    min_sources: int = 1
    """Number of sources that must confirm a depth; all of them where there are fewer. With the coherence test one is
    enough: on studio a second one costs 46 % of the depths, and a third of its surface is in two views only."""
    min_angle: float = 1.0
    """A source confirms only where both rays meet at more than this, degrees; identical cameras never do."""
    max_angle: float = 60.0
    """Nor where they meet at more than this: such views look too different for a match to mean anything. Measured on a
    synthetic pair with plain walls: 10.5 % of the depths off by more than 5 % without, .9 % with, as many right."""
    speckle_size: int = 20
    """Connected pieces of the depth map with fewer pixels are dropped."""
    reuse_static: bool = True
    """Carry matches over where the picture did not change; off matches every frame in full."""
    reuse_change: float = 12 / 255
    """Change of the grey value (0..1, mean of 3x3 pixels) above which a pixel is matched anew."""
    reuse_radius: int = 6
    """Pixels this near to a change are matched anew too: the matching window reaches that far."""
    reuse_margin: int = 4
    """Pixels this near to those are matched with them, to hand over good planes, but not taken. Measured on studio:
    median error of verified pixels .00090 with and .00098 without, .00086 where every frame is matched in full."""
    reuse_block: int = 30
    """After this many frames everything is matched anew; blocks are independent, and shards are made of them."""
    seed: int = 0
    """Seed of the makers that draw random hypotheses."""


@dataclass(frozen=True)
class AlignSettings:
    """Alignment of one monocular map to one geometric map, and when to refuse it (`reference/priors.md` section 5)."""

    residual: str = "relative"
    """`absolute` is the paper's a D^m + b - D^g; `relative` divides it by D^g, as verification does. Measured: median
    error of aligned maps .041 with either on studio; error of the line with 20, 40 % wrong anchors (`d2 bench align`):
    .005, .011 absolute, .007, .022 relative. What passes the filter is wrong at 1 %."""
    epsilon: float = 0.02
    """Smoothing of the Charbonnier penalty: of the relative residual, or (absolute) times the median of the target."""
    max_anchors: int = 20_000
    """More anchors than this are subsampled; measured change of the aligned depth at 1.4 million: 1.8e-4."""
    min_anchors: int = 50
    """Fewer anchors than this are refused."""
    min_spread: float = 1e-3
    """Geometric depths whose 5..95 percentile range is below this share of their median are refused."""
    max_gap: float = 1e-8
    """Relative duality gap above which a fit is refused; every case measured stops below 1e-10."""
    min_t: float = 10.0
    """Scale over its standard error below which a fit needs `min_correlation`; measured: clean 2e4, 60 % outliers 80,
    unrelated maps 0.7."""
    min_correlation: float = 0.5
    """Rank correlation that speaks for a scale whose standard error does not: on pose2sim_single one view has t = 4 and
    t = 69 in two successive frames, at .87 and .86."""
    inlier_error: float = 0.1
    """Relative discrepancy e below which an anchor counts as an inlier of the fit."""
    min_inliers: float = 0.3
    """A smaller share of inliers is refused."""
    wrong_kind_correlation: float = -0.3
    """Rank correlation of the map with what it is declared to be; below this the declared kind is contradicted."""
    local_scales: tuple[float, ...] = (0.25, 0.12, 0.06, 0.03)
    """Standard deviations of the windows of the local correction, coarse to fine, in picture widths; none is the paper.
    Measured: mono-only error .0425 without, .027 with (studio); see `d2_plugin.priors.monocular.correct`."""
    local_prior: float = 0.05
    """Weight of "no correction": a window in which this share of the pixels is known is corrected by half."""
    local_limit: float = 0.7
    """Anchors off by more than this in log depth (a factor of two) say nothing about the bend of the map."""
    leverage_guard: bool = False
    """Fit only anchors near the line that passes nearest to the best `min_inliers` of them: every convex fit breaks at
    40 % leverage outliers. Measured (`d2 bench align`): with 20 to 60 % wrong anchors the error of the line is .001 to
    .003 with, .007 to .16 without, in the same time. Off, because filtered anchors are wrong at 1 % (studio) and the
    guard has not been measured on recordings. The certificate then holds for the anchors that were kept."""
    seed: int = 0
    """Seed of the subsampling and of the leverage guard."""


@dataclass(frozen=True)
class PriorSettings:
    """Everything that decides what D* of a capture is."""

    variant: str = "dual"
    """What D* is made of: `dual`, or one of the paper's ablation rows (see `d2_plugin.priors.fuse.VARIANTS`)."""
    tau_c: float = 0.1
    """A geometric depth is verified when aligned monocular depth differs by less than this share of it. Measured on
    studio at .05, .1, .15: verified 33.2, 33.8, 34.1 % of the pixels, of which .1, .4, .7 % are off by over 5 %."""
    z_far_factor: float = 3.0
    """Aligned monocular depth beyond this multiple of the 99.5 percentile of the anchors is left empty."""
    hanging_limit: float = 0.08
    """Mono-only pixels are left empty where monocular depth spans more than this share within 1 % of the picture's
    width: they hang between two surfaces. 0 keeps them, as the paper does."""
    agreement: float = 0.02
    """Mono-only pixels whose depth another camera's confirms within this share may prune and supervise as well (`dual`
    alone); 0 leaves that out, as the paper does. Measured: see `d2_plugin.priors.monocular.agree`."""
    depth_range: tuple[float, float] | None = None
    """Near and far of the stereo search, world units; by default from sparse points, the data set, or the baselines."""
    mono_onnx: str | None = None
    """Path of a monocular ONNX network; the capture's own maps on disk where None."""
    mono_kind: MonoKind | None = None
    """What the network predicts: `relative` (inverse depth) or `metric`; required with `mono_onnx`."""
    mono_preprocessing: str = "auto"
    """Of the network's input: `depth_anything_v2`, `unit`, or `auto`."""
    mono_threads: int = 1
    """Threads of one inference."""
    stereo: StereoSettings = field(default_factory=StereoSettings)
    """Geometric depth."""
    align: AlignSettings = field(default_factory=AlignSettings)
    """Alignment and its acceptance."""

    @classmethod
    def paper(cls, **changes: Any) -> PriorSettings:
        """The paper's construction and nothing else: absolute residuals, one scale and shift, blurred edges kept,
        each camera for itself."""
        align = AlignSettings(residual="absolute", epsilon=0.01, local_scales=())
        return cls(hanging_limit=0.0, agreement=0.0, align=align, **changes)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> PriorSettings:
        """From a table as TOML gives it, with the tables `stereo` and `align` inside; what is absent keeps its default.

        Raises:
            D2Error: an unknown name, with the nearest one suggested, or a value of another type than the default's.
        """
        tables = {"stereo": StereoSettings, "align": AlignSettings}
        inner = {name: kind(**_known(kind, name, values[name])) for name, kind in tables.items() if name in values}
        return cls(**_known(cls, "priors", {name: values[name] for name in values if name not in tables}), **inner)


def _known(kind: type, table: str, values: Any) -> dict[str, Any]:
    """The entries of a table as arguments of the dataclass `kind`; lists become tuples."""
    if not isinstance(values, Mapping):
        raise D2Error(f"{table} must be a table of settings, got {values!r}: write [priors.{table}] above them")
    defaults = {entry.name: entry.default for entry in fields(kind)}
    arguments = {}
    for name, value in values.items():
        if name not in defaults:
            raise unknown_name(f"setting in [{table}]", name, defaults)
        arguments[name] = tuple(value) if isinstance(value, list) else value
        expected = type(defaults[name])
        if expected in (bool, int, float, str, tuple) and not _fits(arguments[name], expected):
            like = f"{expected.__name__} as {defaults[name]!r}"
            raise D2Error(f"setting {name} in [{table}] must be {like}, got {value!r}: correct it or leave it out")
    return arguments


def _fits(value: Any, expected: type) -> bool:
    if expected is float:
        return isinstance(value, int | float) and not isinstance(value, bool)
    return isinstance(value, expected) and (expected is bool or not isinstance(value, bool))
