"""Settings of the depth priors: those of the construction here, with those of its two stages inside."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal

from d2_plugin.errors import D2Error
from d2_plugin.priors.monocular.settings import AlignSettings
from d2_plugin.priors.stereo.settings import StereoSettings
from d2_plugin.recordings.recording import MonoKind
from d2_plugin.settings import Positive, Range, Relative, Settings, Share

__all__ = ["AlignSettings", "Preprocessing", "PriorSettings", "StereoSettings", "Variant"]

Variant = Literal["dual", "mono", "mvs", "dual_unaligned", "dual_unverified"]
"""What D* is made of; the paper's full prior and the rows "Prior" of its ablation table.

`dual`: aligned, verified, fused: the method.
`mono`: aligned monocular depth alone. Geometric depth serves the alignment and is then left out; every pixel counts as
verified, since the paper runs "identical densification, pruning, and RGB-D optimization" on each row.
`mvs`: geometric depth alone, every pixel of it counts as verified; no monocular map is used at all.
`dual_unaligned`: as `dual`, but with a = 1, b = 0. A relative map has no scale, so nearly all of it contradicts D^g.
`dual_unverified`: aligned, but every geometric depth counts as verified, whatever the monocular map has.
"""

Preprocessing = Literal["auto", "depth_anything_v2", "unit"]
"""How an image becomes a network's input."""

Along = Literal["z", "ray"]
"""What a stored depth is measured along."""

FlowRange = Literal["bytes", "unit", "signed"]
"""What values of an image a network of optical flow takes: 0 to 255, 0 to 1, or -1 to 1."""

MultiviewScale = Literal["shared", "view", "metric"]
"""What the depth of a multi-view network is known up to."""


@dataclass(frozen=True)
class PriorSettings(Settings):
    """Everything that decides what D* of a recording is."""

    variant: Variant = "dual"
    """What D* is made of: `dual`, or one of the paper's ablation rows (see `Variant`)."""
    uncertainty: bool = True
    """Declare a standard deviation per pixel and verify by it: two sources conflict when they differ by more than
    `conflict_sigmas`, and a map that cannot be aligned leaves stereo as it is. Off: the paper's fixed `tau_c`, sigma 0
    at verified pixels and infinite elsewhere, and no depth at all where the map cannot be aligned."""
    conflict_sigmas: Annotated[float, Range(1e-3, 1e6)] = 3.0
    """Standard deviations of their difference above which the two sources conflict (with `uncertainty`)."""
    most_vetoed: Share = 0.01
    """Where a map contradicts more than this share of a view's geometric depths, the map is wrong, and all of them stay
    (`dual` with `uncertainty`); 1 lets every map veto."""
    tau_c: Relative = 0.1
    """A geometric depth is verified when aligned monocular depth differs by less than this share of it (without
    `uncertainty`)."""
    hanging_limit: Relative = 0.08
    """Mono-only pixels are left empty where monocular depth spans more than this share within 1 % of the image's
    width: they hang between two surfaces. 0 keeps them, as the paper does."""
    agreement: Relative = 0.02
    """Two cameras' monocular depths agree within this share (`dual` alone). 0 leaves the other cameras out, as in the
    paper: they neither confirm nor contradict a mono-only pixel (`d2_plugin.priors.evidence`)."""
    color_limit: Share = 0.04
    """A verified pixel is left empty whose colour is off by more than this share of white from what each camera that
    knows the same depth shows there: it has the depth of what lies behind. 0 compares no colours, as in the paper."""
    far: bool = True
    """Find sky and what lies beyond any parallax (`dual` alone); off, as in the paper, they are like all others."""
    between: bool = True
    """Make what the cameras would have seen between their instants, for the hook `motion`."""
    flow_onnx: str | None = None
    """Path of an ONNX network of optical flow for that, as RAFT is exported; OpenCV's DIS where None."""
    flow_range: FlowRange = "bytes"
    """What values of an image it takes: `bytes`, 0 to 255 (RAFT, SEA-RAFT, OpenCV's zoo), `unit`, 0 to 1, or `signed`,
    -1 to 1 (torchvision's RAFT)."""
    depth_range: tuple[Positive, Positive] | None = None
    """Near and far of the stereo search, world units; by default from sparse points, the data set, or the baselines."""
    mono_onnx: str | None = None
    """Path of a monocular ONNX network; the recording's own maps on disk where None."""
    mono_kind: MonoKind | None = None
    """What the network predicts: `relative` (inverse depth) or `metric`; required with `mono_onnx`."""
    mono_along: Along = "z"
    """What metric monocular maps measure: planar depth `z`, or the distance from the camera along the `ray`."""
    mono_preprocessing: Preprocessing = "auto"
    """Of the network's input: `depth_anything_v2`, `unit`, or `auto`."""
    mono_threads: Annotated[int, Range(0, 1024, unit="threads")] = 1
    """Threads of one inference; 0 leaves the number to onnxruntime."""
    multiview: str | None = None
    """Depth of all views from one network: a folder with FRAME.npz as Depth Anything 3, VGGT and MapAnything write
    them, or an ONNX file for this number of views. Takes part in `dual` with `uncertainty`."""
    multiview_scale: MultiviewScale = "shared"
    """Its depth is in the calibration's unit (`metric`), up to one factor an instant (`shared`), or one a `view`."""
    multiview_along: Along = "z"
    """What it measures: planar depth `z`, or the distance from the camera along the `ray`."""
    stereo: StereoSettings = field(default_factory=StereoSettings)
    """Geometric depth."""
    align: AlignSettings = field(default_factory=AlignSettings)
    """Alignment and its acceptance."""

    def __post_init__(self) -> None:
        """Check each value, and that near is before far."""
        super().__post_init__()
        if self.depth_range is not None:
            near, far = self.depth_range
            if not near < far:
                raise D2Error(
                    f"depth range must be 0 < near < far in world units, got near {near:g} and far {far:g}: swap or "
                    "correct it"
                )

    @classmethod
    def paper(cls, **changes: Any) -> PriorSettings:
        """The paper's construction and nothing else: absolute residuals, one scale and shift, blurred edges kept,
        each camera for itself, depth read at pixels."""
        align = AlignSettings(residual="absolute", epsilon=0.01, local_correction=False, across=False)
        changes["stereo"] = replace(changes.get("stereo", StereoSettings()), between_pixels=False)
        changes |= {"uncertainty": False, "hanging_limit": 0.0, "agreement": 0.0}
        changes |= {"color_limit": 0.0, "far": False, "between": False}
        return cls(align=align, **changes)
