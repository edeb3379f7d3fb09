"""D* of the views of one instant from its two sources: align, correct, verify, fuse, compare with the other cameras.

A further map per pixel is a field of `FusedPrior` that `_view_prior` fills, and a column of the store's `PRIOR_DTYPE`
that `PriorStore.write` writes; the colours of the image go that way.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from d2_plugin.priors.evidence import AT_BEST, with_evidence
from d2_plugin.priors.fuse import fuse, hanging_pixels, with_matches
from d2_plugin.priors.maps_on_disk import divided, planar
from d2_plugin.priors.monocular.across import Shown, aligned_across
from d2_plugin.priors.monocular.align import Alignment, AlignStatus, align, aligned_depth, aligned_inverse, not_aligned
from d2_plugin.priors.monocular.correct import corrected_depth
from d2_plugin.priors.monocular.far import far_pixels
from d2_plugin.priors.monocular.uncertainty import Skill, Uncertainty, monocular_uncertainty
from d2_plugin.priors.multiview.fit import UNSEEN, Vote, fitted, voted
from d2_plugin.priors.multiview.source import MultiviewMap
from d2_plugin.priors.other_colors import without_other_colors
from d2_plugin.priors.settings import PriorSettings
from d2_plugin.priors.stereo.filtering.filter import GeometricDepth
from d2_plugin.protocol import Label
from d2_plugin.recordings.recording import Camera, MonoKind
from d2_plugin.store.maps import FusedPrior, empty_prior

CONSTRUCTION_VERSION = 20  # raise it when alignment or fusion change what they return

FARTHEST = 3.0
"""Aligned monocular depth beyond this multiple of the 99.5 percentile of the anchors is left empty."""

NO_GEOMETRY = "no geometric depth survived the filter"
NO_MAP = "there is no monocular map of this frame"
SCALE_UNKNOWN = "a relative monocular map without geometric depth: its scale cannot be known"


@dataclass(frozen=True, eq=False)
class ViewSources:
    """What the prior of one view is made of."""

    image: np.ndarray
    """RGB uint8 [H, W, 3]."""
    geometric: GeometricDepth | None
    """None where the recording has no geometric depth at all."""
    mono: np.ndarray | None
    """The monocular prediction float32 [H, W]; None where there is none of this view."""
    confidence: np.ndarray | None = None
    """That of the monocular map, 0..1 [H, W]; None is 1 everywhere."""
    recorded: np.ndarray | None = None
    """Which pixels were recorded, bool [H, W]; None is all."""
    multiview: MultiviewMap | None = None
    """Of a multi-view network; None where it says nothing of this view."""


@dataclass(frozen=True, eq=False)
class ViewPrior:
    """D* of one view and what is known about it."""

    maps: FusedPrior
    refused: str
    """Why the view has no depth; empty where it has."""
    alignment: Alignment | None
    skill: Skill | None
    """What left-out anchors show of the monocular map; None where they were not left out."""
    stereo: dict[str, Any] | None
    """What the cache of geometric depth recorded."""
    several: dict[str, Any] | None = None
    """Alignment and skill of the multi-view map; None where there is none."""

    def record(self) -> dict[str, Any]:
        """What of it goes into the JSON beside the stored maps."""
        return {
            "refused": self.refused,
            "alignment": None if self.alignment is None else self.alignment.as_json(),
            "skill": None if self.skill is None else self.skill.as_json(),
            "multiview": self.several,
            "stereo": self.stereo,
            "shares": self.maps.shares(),
            "sigmas": self.maps.sigmas(),
        }


def compares_cameras(settings: PriorSettings, cameras: int, measured: bool) -> bool:
    """Whether the prior of one camera depends on those of the others; `measured` by stereo or from several views."""
    return measured and cameras > 1 and (_compares_maps(settings) or _compares_colors(settings))


def _compares_maps(settings: PriorSettings) -> bool:
    return settings.agreement > 0 and settings.variant == "dual"


def _compares_colors(settings: PriorSettings) -> bool:
    return settings.color_limit > 0 and settings.variant != "mono"


def construct(
    views: Mapping[str, ViewSources], cameras: Mapping[str, Camera], settings: PriorSettings, kind: MonoKind | None
) -> dict[str, ViewPrior]:
    """D* of synchronized views, by camera.

    Args:
        views: their sources; all of an instant where cameras are compared (`compares_cameras`).
        cameras: their calibrations.
        settings: of the construction; `variant` is one that the sources allow.
        kind: what the monocular maps are; None where the recording has none.
    """
    prepared = {name: _Prepared.of(view, cameras[name], settings, kind) for name, view in views.items()}
    measured = any(view.geometric is not None or view.multiview is not None for view in views.values())
    compared = compares_cameras(settings, len(cameras), measured)
    compares_maps = compared and _compares_maps(settings)
    if compares_maps and settings.align.across and kind is not None:
        shown = {
            name: Shown(cameras[name], view.prediction, view.depth, view.alignment)
            for name, view in prepared.items()
            if view.prediction is not None and view.alignment is not None
        }
        for name, alignment in aligned_across(shown, kind).items():
            prepared[name] = replace(prepared[name], alignment=alignment)
    several = _of_several_views(prepared, cameras, settings)
    priors = {name: _view_prior(view, several.get(name), settings) for name, view in prepared.items()}
    maps = {name: prior.maps for name, prior in priors.items()}
    if compared and _compares_colors(settings):
        maps = without_other_colors(maps, cameras, settings.color_limit)
    if not compares_maps:
        return {name: replace(prior, maps=maps[name]) for name, prior in priors.items()}
    tails = {name: prior.skill.tail for name, prior in priors.items() if prior.skill is not None}
    unmeasured = any(
        prior.several and (prior.several["skill"] or {}).get("scale", 0) is None for prior in priors.values()
    )
    at_best = UNSEEN if unmeasured else AT_BEST
    informed = with_evidence(maps, cameras, settings.agreement, tails, at_best)
    return {name: replace(prior, maps=informed[name]) for name, prior in priors.items()}


@dataclass(frozen=True, eq=False)
class _Prepared:
    """Both depths of one view, where it was recorded, and the alignment that they alone give."""

    view: ViewSources
    depth: np.ndarray
    """D^g float32 [H, W], 0 where there is none."""
    sigma: np.ndarray
    """Of D^g, infinite where there is none."""
    prediction: np.ndarray | None
    """The monocular map, planar, and NaN where its confidence is 0."""
    alignment: Alignment | None
    """Of that map; None where there is no map, or its scale cannot be known."""
    kind: MonoKind | None
    """What the map is; None where the recording has none."""
    confidence: np.ndarray | None
    """Of the map, in any unit; None is the same everywhere."""
    shifted: bool = True
    """Whether the map is known up to a scale and a shift, and not up to a scale alone."""

    @classmethod
    def of(cls, view: ViewSources, camera: Camera, settings: PriorSettings, kind: MonoKind | None) -> _Prepared:
        if view.geometric is None:
            depth = np.zeros(view.image.shape[:2], np.float32)
            sigma = np.full_like(depth, np.inf)
        else:
            depth, sigma = view.geometric.depth, view.geometric.sigma
        if view.recorded is not None:
            depth, sigma = depth * view.recorded, np.where(view.recorded, sigma, np.float32(np.inf))
        prediction = view.mono
        if prediction is not None and settings.mono_along == "ray":
            prediction = planar(prediction, camera)
        if prediction is not None and view.confidence is not None:
            prediction = np.where(view.confidence > 0, prediction, np.float32(np.nan))
        alignment = _alignment(prediction, depth, view.geometric is None, settings, kind)
        return cls(view, depth, sigma, prediction, alignment, kind, view.confidence)


def _of_several_views(
    prepared: Mapping[str, _Prepared], cameras: Mapping[str, Camera], settings: PriorSettings
) -> dict[str, _Prepared]:
    """The same views with their multi-view maps in the place of the monocular ones."""
    maps = {name: view.view.multiview for name, view in prepared.items() if view.view.multiview is not None}
    anchors = {name: prepared[name].depth for name in maps}
    found = fitted(maps, anchors, cameras, settings) if maps else {}
    return {
        name: replace(
            prepared[name],
            prediction=map_.depth,
            alignment=map_.alignment,
            kind="metric",
            confidence=map_.sure,
            shifted=False,
        )
        for name, map_ in found.items()
    }


def _alignment(
    prediction: np.ndarray | None,
    depth: np.ndarray,
    without_geometry: bool,
    settings: PriorSettings,
    kind: MonoKind | None,
) -> Alignment | None:
    """The alignment; a metric map is taken as it is where there is no geometric depth to fit it to."""
    if prediction is None or kind is None or (without_geometry and kind == "relative"):
        return None
    if without_geometry or settings.variant == "dual_unaligned":
        return not_aligned(kind)
    return align(prediction, depth, kind=kind, settings=settings.align)


@dataclass(frozen=True, eq=False)
class _AlignedMap:
    """D-bar^m of one view, float32 [H, W] (0 = none), and why it is refused if it is."""

    depth: np.ndarray
    refused: str = ""
    uncertainty: Uncertainty | None = None
    """How wrong it may be; None where the settings leave that out."""
    farthest: float = float("inf")
    """The farthest anchor, but for a half per cent; infinite where there is none."""

    @property
    def skill(self) -> Skill | None:
        return None if self.uncertainty is None else self.uncertainty.skill


def _view_prior(prepared: _Prepared, several: _Prepared | None, settings: PriorSettings) -> ViewPrior:
    """D* of one camera, before it is compared with the others; `several` holds its multi-view map."""
    view = prepared.view
    mono = _aligned(prepared, settings)
    multi = None if several is None else _aligned(several, settings)
    both = mono if multi is None else _voted(mono, multi, prepared, settings)
    maps = _fused(both, prepared, settings)
    if settings.agreement > 0 and settings.variant == "dual" and view.geometric and both.uncertainty:
        maps = with_matches(maps, both.depth, both.uncertainty.sigma, view.geometric.unconfirmed)
    if settings.far and settings.variant == "dual" and not mono.refused:
        maps = _with_far(maps, mono, prepared)
    if view.recorded is not None:
        maps = _relabelled(maps, ~view.recorded, 0, Label.EMPTY)  # nothing is known of what was not recorded
    stored = {} if view.geometric is None else view.geometric.record
    about_stereo = {key: value for key, value in stored.items() if key != "checksum"} or None
    about_several = None
    refused = mono.refused
    if several is not None and multi is not None and several.alignment is not None:
        about_several = {"alignment": several.alignment.as_json(), "skill": multi.skill and multi.skill.as_json()}
        refused = mono.refused and multi.refused
    colored = replace(maps, colors=view.image)
    return ViewPrior(colored, refused, prepared.alignment, mono.skill, about_stereo, about_several)


def _voted(mono: _AlignedMap, multi: _AlignedMap, prepared: _Prepared, settings: PriorSettings) -> _AlignedMap:
    """Both maps of a view as one, as far as they are accepted."""
    if multi.refused or multi.uncertainty is None:
        return mono
    if mono.refused or mono.uncertainty is None:
        return multi
    skill = min(mono.uncertainty.skill, multi.uncertainty.skill, key=lambda skill: np.nan_to_num(skill.tail, nan=1))
    one, two = (Vote(map_.depth, *map_.uncertainty[:2]) for map_ in (mono, multi) if map_.uncertainty is not None)
    vote = voted(one, two, prepared.depth, settings.conflict_sigmas)
    return replace(mono, depth=vote.depth, uncertainty=Uncertainty(vote.sigma, vote.at_anchors, skill))


def _aligned(prepared: _Prepared, settings: PriorSettings) -> _AlignedMap:
    """A network's map in world units, where there is one and its scale can be known."""
    geometric, prediction, alignment = prepared.depth, prepared.prediction, prepared.alignment
    nothing = np.zeros_like(geometric)
    if prepared.kind is None:
        return _AlignedMap(nothing, "" if geometric.any() else NO_GEOMETRY)
    if prediction is None:
        return _AlignedMap(nothing, NO_MAP)
    if alignment is None:
        return _AlignedMap(nothing, SCALE_UNKNOWN)
    if not alignment.accepted:
        return _AlignedMap(nothing, alignment.status.value)
    anchors = geometric[geometric > 0]
    farthest = float(np.quantile(anchors, 0.995)) if anchors.size else np.inf
    aligned = aligned_depth(prediction, alignment, FARTHEST * farthest)
    if settings.variant == "dual_unaligned":
        return _AlignedMap(aligned)
    depth, uncertainty = corrected_depth(aligned, geometric, settings.align), None
    if settings.uncertainty and (anchors.size > 0 or alignment.status is AlignStatus.ACROSS):
        kind = prepared.kind if prepared.shifted else None
        uncertainty = monocular_uncertainty(aligned, geometric, settings.align, prepared.confidence, kind)
        # A map that says nothing of a pixel contradicts nothing there.
        unsaid = np.where(np.isnan(prediction), np.float32(np.inf), uncertainty.at_anchors)
        uncertainty = uncertainty._replace(at_anchors=unsaid)
        if alignment.status is AlignStatus.ACROSS or np.isnan(uncertainty.skill.scale):
            shared = np.where(depth > 0, np.float32(alignment.across), np.float32(np.inf))
            if not prepared.shifted:
                shared = np.hypot(divided(shared, prepared.confidence), np.float32(UNSEEN))
            uncertainty = uncertainty._replace(sigma=np.fmin(uncertainty.sigma, shared))
    return _AlignedMap(depth, "", uncertainty, farthest)


def _fused(mono: _AlignedMap, prepared: _Prepared, settings: PriorSettings) -> FusedPrior:
    """Verification and fusion. A map that was refused leaves the stereo depth alone, or nothing in the paper."""
    variant = settings.variant
    if mono.refused and not (settings.uncertainty and variant == "dual"):
        return empty_prior(prepared.depth.shape)
    if mono.refused:
        variant = "mvs"
    hanging = hanging_pixels(mono.depth, settings.hanging_limit)
    if not settings.uncertainty:
        return fuse(mono.depth, prepared.depth, tau_c=settings.tau_c, variant=variant, hanging=hanging)
    unknown = np.full_like(prepared.sigma, np.inf)
    alone, at_anchors = (unknown, unknown) if mono.uncertainty is None else mono.uncertainty[:2]
    # A map that was not aligned has no sigma to verify by: that row of the paper's table keeps its fixed threshold.
    allowed = settings.conflict_sigmas * np.sqrt(at_anchors * at_anchors + prepared.sigma * prepared.sigma)
    return fuse(
        mono.depth,
        prepared.depth,
        tau_c=settings.tau_c if variant == "dual_unaligned" else allowed,
        variant=variant,
        hanging=hanging,
        most_vetoed=settings.most_vetoed if variant == "dual" else 1.0,
        sigma_mono=alone,
        sigma_geometric=prepared.sigma,
    )


def _relabelled(maps: FusedPrior, pixels: np.ndarray, depth: float, label: Label) -> FusedPrior:
    """One depth and one label at some pixels, with no bound on the error."""
    return replace(
        maps,
        depth=np.where(pixels, np.float32(depth), maps.depth),
        labels=np.where(pixels, np.uint8(label), maps.labels),
        sigma=np.where(pixels, np.float32(np.inf), maps.sigma),
    )


def _with_far(maps: FusedPrior, mono: _AlignedMap, prepared: _Prepared) -> FusedPrior:
    """Far pixels take the farthest geometric depth of the view: what is known of them is that they lie behind it."""
    prediction, alignment = prepared.prediction, prepared.alignment
    if prediction is None or alignment is None:
        return maps
    far = far_pixels(aligned_inverse(prediction, alignment), prepared.depth, prepared.view.image)
    return _relabelled(maps, far, mono.farthest, Label.FAR)
