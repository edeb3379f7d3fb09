"""Building the priors of a capture: per frame stereo, per picture a monocular map, alignment, verification, fusion."""

from __future__ import annotations

import logging
import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from d2_plugin.captures.capture import Capture
from d2_plugin.errors import D2Error, unknown_name
from d2_plugin.priors.depth_on_disk import recorded_depth
from d2_plugin.priors.fuse import VARIANTS, FusedPrior, empty_prior, fuse, hanging_pixels
from d2_plugin.priors.geometry import check_depth_range
from d2_plugin.priors.monocular.agree import with_agreement
from d2_plugin.priors.monocular.align import Alignment, align, aligned_depth, not_aligned
from d2_plugin.priors.monocular.correct import corrected_depth
from d2_plugin.priors.settings import NO_MATCHER, PriorSettings
from d2_plugin.priors.sources import (
    Frame,
    GeometricSource,
    MonoSource,
    StoredDepth,
    describe_camera,
    frame_blocks,
    hash_of,
    mono_source,
)
from d2_plugin.priors.stereo.geometric_depth import DepthBounds, depth_bounds
from d2_plugin.priors.store import PriorStore

__all__ = ["PriorSettings", "PriorSummary", "build_priors"]

FUSION_VERSION = 3  # raise it when alignment or fusion change what they return

SHOWN = {"verified": "verified", "agreed": "agreed", "mono only": "mono", "conflict": "conflict", "empty": "empty"}
"""Columns of the summary, and the share each shows."""

NO_GEOMETRY = "no geometric depth survived the filter"
NO_MAP = "there is no monocular map of this frame"
SCALE_UNKNOWN = "a relative monocular map without geometric depth: its scale cannot be known"

Progress = Callable[[int, int, str], None]
"""(pictures done, pictures in all, what was just done)."""

logger = logging.getLogger(__name__)


@dataclass
class PriorSummary:
    """What a build did: mean shares of the labels per camera, refused views and why, notes on what was left out."""

    built: int = 0
    kept: int = 0
    shares: dict[str, dict[str, float]] = field(default_factory=dict)
    refused: list[tuple[str, int, str]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    _counts: Counter[str] = field(default_factory=Counter)

    def add(self, camera: str, frame: int, record: dict[str, Any], built: bool) -> None:
        """Take one view's record into account."""
        self.built, self.kept = self.built + built, self.kept + (not built)
        count = self._counts[camera]
        mean = self.shares.setdefault(camera, dict.fromkeys(record["shares"], 0.0))
        for label, share in record["shares"].items():
            mean[label] += (share - mean[label]) / (count + 1)
        self._counts[camera] += 1
        if record["refused"]:
            self.refused.append((camera, frame, record["refused"]))

    def add_part(self, part: PriorSummary) -> None:
        """Take in the summary of another part of the same build; notes that both have are kept once."""
        self.built, self.kept = self.built + part.built, self.kept + part.kept
        for camera, share in part.shares.items():
            mean = self.shares.setdefault(camera, dict.fromkeys(share, 0.0))
            total = self._counts[camera] + part._counts[camera]
            for label, value in share.items():
                mean[label] += (value - mean[label]) * part._counts[camera] / total
            self._counts[camera] = total
        self.refused = sorted([*self.refused, *part.refused], key=lambda refusal: refusal[1])
        self.notes += [note for note in part.notes if note not in self.notes]

    def __str__(self) -> str:
        lines = [
            f"{self.built} priors built, {self.kept} kept",
            f"{'camera':12}" + "  ".join(f"{name:>9}" for name in SHOWN),
        ]
        for camera, share in self.shares.items():
            values = (share[label] for label in SHOWN.values())
            lines.append(f"{camera:12}" + "  ".join(f"{value:9.1%}" for value in values))
        reasons = Counter(reason for _, _, reason in self.refused)
        for reason, count in reasons.most_common():
            examples = [f"{camera}/{frame}" for camera, frame, why in self.refused if why == reason][:3]
            lines.append(f"refused {count}x ({', '.join(examples)}{', ...' if count > 3 else ''}): {reason}")
        return "\n".join([*lines, *self.notes])


def build_priors(
    capture: Capture,
    cameras: Sequence[str],
    output: Path | str,
    settings: PriorSettings,
    *,
    sparse_points: np.ndarray | None = None,
    progress: Progress | None = None,
    shard: tuple[int, int] | None = None,
) -> PriorSummary:
    """Build what is missing of the priors of `cameras` in the store at `output`.

    Geometric depth of a frame comes from these cameras at that timestamp and from no other. A view that must be refused
    gets an empty prior and a reason; nothing is lost. A build that was killed goes on where it stopped.

    Args:
        capture: the recording.
        cameras: the training cameras; held-out ones must not be among them.
        output: folder of the store.
        settings: everything that decides what D* is.
        sparse_points: world points [N, 3] triangulated with the known poses, for the depth range.
        progress: called after every picture.
        shard: (index, count) with 0 <= index < count builds one part of the frames; all parts, built anywhere and in
            any order into one folder, make the store that a single build makes.

    Raises:
        D2Error: unknown cameras, no depth source at all, or a folder that holds something else.
    """
    frames = _shard(capture.frames, settings, shard)
    builder = _Builder(capture, list(cameras), Path(output), settings, sparse_points)
    summary = PriorSummary(notes=builder.notes)
    total, done = len(frames) * len(builder.names), 0
    for frame in frames:
        for camera, record, built in builder.build(frame):
            summary.add(camera, frame, record, built)
            done += 1
            if progress is not None:
                progress(done, total, f"camera {camera}, frame {frame}: {record['shares']['verified']:.0%} verified")
    return summary


class _Builder:
    """The sources, settings and store of one build."""

    def __init__(
        self, capture: Capture, names: list[str], output: Path, settings: PriorSettings, points: np.ndarray | None
    ) -> None:
        self.capture, self.names, self.notes = capture, names, []
        _check(capture, names, settings)
        self.cameras = [capture.cameras[name] for name in names]
        self.mono = None if settings.variant == "mvs" else mono_source(capture, settings, output / "cache" / "mono")
        recorded = recorded_depth(capture, names, settings.stereo)
        matched = len(names) > 1 and settings.stereo.maker != NO_MATCHER
        self.bounds: DepthBounds | None = None
        self.geometric: GeometricSource | None = None
        if recorded is not None:
            self.notes.append(f"geometric depth: {recorded.about}")
            self.bounds = _chosen_bounds(settings)
        elif matched:
            self.bounds = _chosen_bounds(settings) or _rounded(
                depth_bounds(self.cameras, points, settings.stereo.max_angle)
            )
        if recorded is not None or matched:
            folder = output / "cache" / "stereo"
            self.geometric = GeometricSource(
                self.cameras, self.bounds, settings.stereo, folder, capture.frames, self.read, recorded
            )
        self.settings, self.variant = settings, self._variant(settings.variant)
        self.store = PriorStore.create(output, names, capture.frames, {"capture": capture.name})

    def _variant(self, wanted: str) -> str:
        """The variant that the sources at hand allow; what is left out is noted."""
        if self.geometric is not None and self.mono is not None:
            return wanted
        if self.geometric is not None:
            if wanted != "mvs":
                self.notes.append("no monocular depth: geometric depth counts as verified without a second source")
            return "mvs"
        if self.mono is None:
            raise D2Error(
                f"{self.capture.name} has no depth source ({self._lacking}): give a metric monocular network, or "
                "cameras that see the same"
            )
        self.notes.append(
            f"{self._lacking}: no geometric depth, so nothing is verified and nothing can prune or supervise"
        )
        return wanted

    @property
    def _lacking(self) -> str:
        """Why there is no geometric depth."""
        return "one camera" if len(self.names) == 1 else "nothing matched"

    def read(self, number: int) -> Frame:
        """The pictures of one frame."""
        return Frame.read(self.capture, self.names, number)

    def build(self, number: int) -> Iterator[tuple[str, dict[str, Any], bool]]:
        """(camera, record, whether it was built now) for every camera of one frame."""
        frame = self.read(number)
        keys = {name: self._key(name, frame) for name in self.names}
        missing = [name for name in self.names if not self.store.is_current(name, number, keys[name])]
        priors = self._priors(frame, missing)
        for name in self.names:
            if name in missing:
                prior, record = priors[name]
                record |= {"shares": prior.shares(), "key": keys[name]}
                self.store.write(name, number, prior, frame.images[name], record)
            yield name, self.store.record(name, number), name in missing

    def _priors(self, frame: Frame, missing: Sequence[str]) -> dict[str, tuple[FusedPrior, dict[str, Any]]]:
        """D* and record of the `missing` cameras of one frame; cameras that must agree need each other's."""
        if not missing:
            return {}
        geometric = self.geometric.depths(frame) if self.geometric is not None else {}
        names = self.names if self._agrees else missing
        made = {name: self._prior(name, frame, geometric.get(name)) for name in names}
        if self._agrees:
            fused = {name: prior for name, (prior, _) in made.items()}
            agreed = with_agreement(
                fused, dict(zip(self.names, self.cameras, strict=True)), self.settings.agreement, self.settings.tau_c
            )
            made = {name: (agreed[name], record) for name, (_, record) in made.items()}
        return made

    @property
    def _agrees(self) -> bool:
        several = self.geometric is not None and len(self.names) > 1
        return self.settings.agreement > 0 and self.variant == "dual" and several

    def _key(self, name: str, frame: Frame) -> str:
        return hash_of(
            FUSION_VERSION,
            self.variant,
            self.settings.tau_c,
            self.settings.z_far_factor,
            self.settings.hanging_limit,
            asdict(self.settings.align),
            None if self.geometric is None else self.geometric.key(frame),
            None if self.mono is None else self.mono.key(name, frame),
            [self.settings.agreement, *(self.mono.key(other, frame) for other in self.names)] if self._agrees else None,
        )

    def _prior(self, name: str, frame: Frame, stereo: StoredDepth | None) -> tuple[FusedPrior, dict[str, Any]]:
        shape = frame.images[name].shape[:2]
        geometric = np.zeros(shape, np.float32) if stereo is None else stereo.depth
        alignment, mono, refused = self._aligned(name, frame, geometric)
        hanging = hanging_pixels(mono, self.settings.hanging_limit)
        fused = fuse(mono, geometric, tau_c=self.settings.tau_c, variant=self.variant, hanging=hanging)
        prior = empty_prior(shape) if refused else fused
        record = {
            "refused": refused,
            "variant": self.variant,
            "alignment": None if alignment is None else alignment.as_json(),
            "monocular": None if self.mono is None else self.mono.about,
            "stereo": None if stereo is None else {k: v for k, v in stereo.record.items() if k != "checksum"},
            "bounds": None if self.bounds is None else list(self.bounds),
            "settings": asdict(self.settings),
            "camera": describe_camera(self.capture.cameras[name]),
            "image": frame.hashes[name],
        }
        return prior, record

    def _aligned(self, name: str, frame: Frame, geometric: np.ndarray) -> tuple[Alignment | None, np.ndarray, str]:
        """The alignment, aligned monocular depth [H, W], and why the view is refused (empty where it is not)."""
        nothing = np.zeros_like(geometric)
        if self.mono is None:
            return None, nothing, "" if geometric.any() else NO_GEOMETRY
        prediction = self.mono.map(name, frame)
        if prediction is None:
            return None, nothing, NO_MAP
        if self.geometric is None and self.mono.kind == "relative":
            return None, nothing, SCALE_UNKNOWN
        alignment = self._fit(prediction, geometric, self.mono)
        if not alignment.accepted:
            return alignment, nothing, alignment.status.value
        anchors = geometric[geometric > 0]
        z_far = self.settings.z_far_factor * float(np.percentile(anchors, 99.5)) if anchors.size else np.inf
        aligned = aligned_depth(prediction, alignment, z_far)
        if self.variant != "dual_unaligned":
            aligned = corrected_depth(aligned, geometric, self.settings.align)
        return alignment, aligned, ""

    def _fit(self, prediction: np.ndarray, geometric: np.ndarray, mono: MonoSource) -> Alignment:
        """The alignment; a metric map is taken as it is where there is no geometric depth to fit it to."""
        if self.geometric is None or self.variant == "dual_unaligned":
            return not_aligned(mono.kind)
        return align(prediction, geometric, kind=mono.kind, settings=self.settings.align)


def _chosen_bounds(settings: PriorSettings) -> DepthBounds | None:
    """The depth range of the settings, None where they leave it open."""
    if settings.depth_range is None:
        return None
    return DepthBounds(*check_depth_range(settings.depth_range), "setting depth_range")


def _rounded(bounds: DepthBounds) -> DepthBounds:
    """Bounds to two digits, outwards: triangulation draws random samples, and its last digits must not void a cache."""

    def outwards(value: float, towards: Callable[[float], int]) -> float:
        unit = 10.0 ** (math.floor(math.log10(value)) - 1)
        return towards(value / unit) * unit

    return DepthBounds(outwards(bounds.near, math.floor), outwards(bounds.far, math.ceil), bounds.origin)


def _shard(frames: Sequence[int], settings: PriorSettings, shard: tuple[int, int] | None) -> list[int]:
    """The frames of one part: whole blocks, since frames within a block are built in order."""
    index, count = (0, 1) if shard is None else shard
    if not 0 <= index < count:
        raise D2Error(f"shard {index} of {count} does not exist: give an index from 0 to {count - 1}")
    return [number for block in frame_blocks(frames, settings.stereo)[index::count] for number in block]


def _check(capture: Capture, names: list[str], settings: PriorSettings) -> None:
    if not names:
        raise D2Error("no camera was chosen for the priors: name at least one")
    for name in names:
        if name not in capture.cameras:
            raise unknown_name("camera", name, capture.cameras)
    if len(set(names)) < len(names):
        raise D2Error(f"a camera is named twice in {', '.join(names)}: name each once")
    if settings.variant not in VARIANTS:
        raise unknown_name("prior variant", settings.variant, VARIANTS)
