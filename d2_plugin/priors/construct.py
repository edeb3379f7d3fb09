"""D* of the views of one instant from its two sources: align, correct, verify, fuse, let cameras agree.

A further map per pixel is a field of `FusedPrior` that `Construction._view` fills, and a column of the store's
`PRIOR_DTYPE` that `PriorStore.write` writes; the colours of the picture go that way.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from d2_plugin.captures.capture import Camera, MonoKind
from d2_plugin.priors.disk.confidence import ConfidenceMaps
from d2_plugin.priors.disk.stored import planar
from d2_plugin.priors.evidence import with_evidence
from d2_plugin.priors.frame import Frame
from d2_plugin.priors.fuse import FusedPrior, empty_prior, fuse, hanging_pixels
from d2_plugin.priors.monocular.across import Shown, aligned_across
from d2_plugin.priors.monocular.align import (
    Alignment,
    AlignStatus,
    align,
    aligned_depth,
    aligned_inverse,
    inverse_at_least,
    not_aligned,
)
from d2_plugin.priors.monocular.correct import corrected_depth
from d2_plugin.priors.monocular.far import CLEARLY, far_pixels
from d2_plugin.priors.monocular.maps import MonoSource
from d2_plugin.priors.monocular.native.order import quantile
from d2_plugin.priors.monocular.together import Seen, aligned_together
from d2_plugin.priors.monocular.uncertainty import Skill, Uncertainty, monocular_uncertainty
from d2_plugin.priors.settings import PriorSettings
from d2_plugin.priors.stereo.cache import DepthCache, StoredDepth
from d2_plugin.priors.stereo.reuse import changed
from d2_plugin.protocol import Label

CONSTRUCTION_VERSION = 13  # raise it when alignment or fusion change what they return

NO_GEOMETRY = "no geometric depth survived the filter"
NO_MAP = "there is no monocular map of this frame"
SCALE_UNKNOWN = "a relative monocular map without geometric depth: its scale cannot be known"


@dataclass(frozen=True, eq=False)
class ViewPrior:
    """D* of one view and what is known about it."""

    maps: FusedPrior
    refused: str
    """Why the view has no depth; empty where it has."""
    alignment: Alignment | None
    skill: Skill | None
    """What left-out anchors say about the monocular map; None where that was not asked."""
    stereo: dict[str, Any] | None
    """What the cache of geometric depth recorded."""

    def record(self) -> dict[str, Any]:
        """What of it goes into the JSON beside the stored maps."""
        return {
            "refused": self.refused,
            "alignment": None if self.alignment is None else self.alignment.as_json(),
            "skill": None if self.skill is None else self.skill.as_json(),
            "stereo": self.stereo,
            "shares": self.maps.shares(),
            "sigmas": self.maps.sigmas(),
        }


@dataclass(frozen=True, eq=False)
class AlignedMap:
    """D-bar^m of one view, float32 [H, W] (0 = none), how it was aligned, and why it is refused if it is."""

    depth: np.ndarray
    alignment: Alignment | None = None
    refused: str = ""
    uncertainty: Uncertainty | None = None
    """How wrong it may be; None where the settings do not ask."""
    farthest: float = float("inf")
    """The farthest anchor, but for a half per cent; infinite where there is none."""


class Sources(NamedTuple):
    """What there is of one view before anything is made of it."""

    stereo: StoredDepth
    prediction: np.ndarray | None
    """The monocular map [H, W]; None where there is none."""
    alignment: Alignment | None
    """Of that map; None where nothing asks for one."""


class Construction:
    """Turns the two depths of a frame into D*.

    Args:
        cameras: the training cameras, by name.
        mono: the monocular maps, None where there are none.
        geometric: geometric depth, None where there is none.
        settings: of the construction; `variant` is one that the sources allow.
        confidence: what the monocular maps say of themselves; nothing where None.
        block: reads the frames that are aligned together with one; each stands alone where None.
    """

    def __init__(
        self,
        cameras: Mapping[str, Camera],
        mono: MonoSource | None,
        geometric: DepthCache | None,
        settings: PriorSettings,
        confidence: ConfidenceMaps | None = None,
        block: Callable[[int], Sequence[Frame]] | None = None,
    ) -> None:
        self.confidence = ConfidenceMaps(Path(), ()) if confidence is None else confidence
        self.cameras, self.mono, self.geometric, self.settings = cameras, mono, geometric, settings
        self.block, self._together = block, dict[int, dict[str, Alignment]]()
        several = geometric is not None and len(cameras) > 1
        self.agrees = settings.agreement > 0 and settings.variant == "dual" and several

    def priors(self, frame: Frame, wanted: Sequence[str]) -> dict[str, ViewPrior]:
        """D* of the wanted cameras of one frame; cameras that must agree need each other's, and all come back."""
        geometric = {} if self.geometric is None else self.geometric.depths(frame)
        names = self.cameras if self.agrees else wanted
        sources = {name: self._sources(name, frame, geometric.get(name)) for name in names}
        if self.agrees and self.settings.align.across:
            sources = self._across(sources)
        views = {name: self._view(name, frame, found) for name, found in sources.items()}
        if not self.agrees:
            return views
        maps = {name: view.maps for name, view in views.items()}
        tails = {name: view.skill.tail for name, view in views.items() if view.skill is not None}
        informed = with_evidence(maps, self.cameras, self.settings.agreement, tails)
        return {name: replace(view, maps=informed[name]) for name, view in views.items()}

    def _sources(self, name: str, frame: Frame, stereo: StoredDepth | None) -> Sources:
        """Both depths of one camera and the alignment that they alone give."""
        if stereo is None:
            nothing = np.zeros(frame.images[name].shape[:2], np.float32)
            stereo = StoredDepth(nothing, np.full_like(nothing, np.inf), {})
        recorded = frame.recorded.get(name)
        if recorded is not None:
            sigma = np.where(recorded, stereo.sigma, np.float32(np.inf))
            stereo = replace(stereo, depth=stereo.depth * recorded, sigma=sigma)
        prediction = self._prediction(name, frame)
        if self.mono is None or prediction is None or (self.geometric is None and self.mono.kind == "relative"):
            return Sources(stereo, prediction, None)
        return Sources(stereo, prediction, self._fit(name, frame, prediction, stereo.depth, self.mono.kind))

    def _across(self, sources: dict[str, Sources]) -> dict[str, Sources]:
        """The same, with the alignments that only other cameras' maps can tell."""
        assert self.mono is not None
        shown = {
            name: Shown(self.cameras[name], found.prediction, found.stereo.depth, found.alignment)
            for name, found in sources.items()
            if found.prediction is not None and found.alignment is not None
        }
        told = aligned_across(shown, self.mono.kind, self.settings.align)
        return sources | {name: sources[name]._replace(alignment=alignment) for name, alignment in told.items()}

    def _view(self, name: str, frame: Frame, sources: Sources) -> ViewPrior:
        """D* of one camera, before it is compared with the others."""
        image, stereo, recorded = frame.images[name], sources.stereo, frame.recorded.get(name)
        mono = self._aligned(name, frame, sources)
        maps = self._fused(mono, stereo)
        if self.settings.far and self.settings.variant == "dual" and sources.prediction is not None:
            maps = _with_far(maps, mono, sources.prediction, stereo.depth, image)
        if recorded is not None:
            maps = _within(maps, recorded)
        about_stereo = {key: value for key, value in stereo.record.items() if key != "checksum"} or None
        skill = None if mono.uncertainty is None else mono.uncertainty.skill
        return ViewPrior(replace(maps, colors=image), mono.refused, mono.alignment, skill, about_stereo)

    def _fused(self, mono: AlignedMap, stereo: StoredDepth) -> FusedPrior:
        """Verification and fusion. A map that was refused leaves the stereo depth alone, or nothing in the paper."""
        settings, variant = self.settings, self.settings.variant
        if mono.refused and not (settings.uncertainty and variant == "dual"):
            return empty_prior(stereo.depth.shape)
        if mono.refused:
            variant = "mvs"
        hanging = hanging_pixels(mono.depth, settings.hanging_limit)
        if not settings.uncertainty:
            return fuse(mono.depth, stereo.depth, tau_c=settings.tau_c, variant=variant, hanging=hanging)
        unknown = np.full_like(stereo.sigma, np.inf)
        alone, at_anchors = (unknown, unknown) if mono.uncertainty is None else mono.uncertainty[:2]
        # A map that was not aligned has no sigma to verify by: that row of the paper's table keeps its fixed threshold.
        allowed = settings.conflict_sigmas * np.sqrt(at_anchors * at_anchors + stereo.sigma * stereo.sigma)
        return fuse(
            mono.depth,
            stereo.depth,
            tau_c=settings.tau_c if variant == "dual_unaligned" else allowed,
            variant=variant,
            hanging=hanging,
            most_vetoed=settings.most_vetoed if variant == "dual" else 1.0,
            sigma_mono=alone,
            sigma_geometric=stereo.sigma,
        )

    def _aligned(self, name: str, frame: Frame, sources: Sources) -> AlignedMap:
        """The monocular map in world units, where there is one and its scale can be known."""
        geometric, prediction, alignment = sources.stereo.depth, sources.prediction, sources.alignment
        nothing = np.zeros_like(geometric)
        if self.mono is None:
            return AlignedMap(nothing, refused="" if geometric.any() else NO_GEOMETRY)
        if prediction is None:
            return AlignedMap(nothing, refused=NO_MAP)
        if alignment is None:
            return AlignedMap(nothing, refused=SCALE_UNKNOWN)
        if not alignment.accepted:
            return AlignedMap(nothing, alignment, alignment.status.value)
        anchors = geometric[geometric > 0]
        farthest = quantile(anchors, 0.995) if anchors.size else np.inf
        aligned = aligned_depth(prediction, alignment, self.settings.z_far_factor * farthest)
        if self.settings.variant == "dual_unaligned":
            return AlignedMap(aligned, alignment)
        depth = corrected_depth(aligned, geometric, self.settings.align)
        known = self.settings.uncertainty and anchors.size > 0
        sure = self.confidence.of(self.cameras[name], frame.number)
        asked = aligned, geometric, self.settings.align, sure, self.mono.kind
        uncertainty = monocular_uncertainty(*asked) if known else None
        if uncertainty is not None and (alignment.status is AlignStatus.ACROSS or np.isnan(uncertainty.skill.scale)):
            shared = np.where(depth > 0, np.float32(alignment.across), np.float32(np.inf))
            uncertainty = uncertainty._replace(sigma=np.fmin(uncertainty.sigma, shared))
        return AlignedMap(depth, alignment, "", uncertainty, farthest)

    def _prediction(self, name: str, frame: Frame) -> np.ndarray | None:
        """The monocular map [H, W], planar and NaN where it says nothing of itself; None where there is none."""
        prediction = None if self.mono is None else self.mono.map(name, frame)
        if prediction is None:
            return None
        if self.settings.mono_along == "ray":
            prediction = planar(prediction, self.cameras[name])
        sure = self.confidence.of(self.cameras[name], frame.number)
        return prediction if sure is None else np.where(sure > 0, prediction, np.float32(np.nan))

    def _fit(
        self, name: str, frame: Frame, prediction: np.ndarray, geometric: np.ndarray, kind: MonoKind
    ) -> Alignment:
        """The alignment; a metric map is taken as it is where there is no geometric depth to fit it to."""
        if self.geometric is None or self.settings.variant == "dual_unaligned":
            return not_aligned(kind)
        if self.settings.align.together and self.block is not None:
            if frame.number not in self._together:
                self._together = self._aligned_together(self.block(frame.number), self.geometric, kind)
            return self._together[frame.number][name]
        return align(prediction, geometric, kind=kind, settings=self.settings.align)

    def _aligned_together(
        self, frames: Sequence[Frame], geometric: DepthCache, kind: MonoKind
    ) -> dict[int, dict[str, Alignment]]:
        """The alignments of a block, by frame and camera."""
        found: dict[int, dict[str, Alignment]] = {frame.number: {} for frame in frames}
        for name in self.cameras:
            seen = {}
            for frame in frames:
                mono = self._prediction(name, frame)
                if mono is not None:
                    recorded = frame.recorded.get(name)
                    depth = geometric.depths(frame)[name].depth * (1 if recorded is None else recorded)
                    seen[frame.number] = Seen(frame.images[name], mono, depth)
            change = partial(changed, settings=self.settings.stereo)
            for number, alignment in aligned_together(seen, kind, self.settings.align, change).items():
                found[number][name] = alignment
        return found


def _within(maps: FusedPrior, recorded: np.ndarray) -> FusedPrior:
    """Nothing is known of pixels that were not recorded."""
    return replace(
        maps,
        depth=np.where(recorded, maps.depth, np.float32(0)),
        labels=np.where(recorded, maps.labels, np.uint8(Label.EMPTY)),
        sigma=np.where(recorded, maps.sigma, np.float32(np.inf)),
    )


def _with_far(
    maps: FusedPrior, mono: AlignedMap, prediction: np.ndarray, geometric: np.ndarray, image: np.ndarray
) -> FusedPrior:
    """Far pixels take the farthest geometric depth of the view: what is known of them is that they lie behind it."""
    alignment = mono.alignment
    if mono.refused or alignment is None or inverse_at_least(prediction, alignment) * mono.farthest >= CLEARLY:
        return maps
    far = far_pixels(aligned_inverse(prediction, alignment), geometric, image)
    if not far.any():
        return maps
    return replace(
        maps,
        depth=np.where(far, np.float32(mono.farthest), maps.depth),
        labels=np.where(far, np.uint8(Label.FAR), maps.labels),
        sigma=np.where(far, np.float32(np.inf), maps.sigma),
    )
