"""Building the priors of a recording: choose the sources, construct D* frame by frame, keep what is there already."""

from __future__ import annotations

import functools
import logging
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from d2_plugin.compiler import NoCompiler
from d2_plugin.errors import D2Error
from d2_plugin.priors.construct import CONSTRUCTION_VERSION, ViewSources, compares_cameras, construct
from d2_plugin.priors.cross_view import kernel as cross_view
from d2_plugin.priors.depth_on_disk import DepthOnDisk, find_depth_on_disk
from d2_plugin.priors.frame import Frame, describe_camera, describe_recording, digest, view_digest
from d2_plugin.priors.geometric_source import GeometricSource
from d2_plugin.priors.maps_on_disk import OF_DEPTH, OF_MONO, ConfidenceMaps
from d2_plugin.priors.monocular.maps import MonoSource, mono_source
from d2_plugin.priors.multiview.source import MultiviewSource
from d2_plugin.priors.settings import PriorSettings, Variant
from d2_plugin.priors.stereo.depth_range import DepthBounds, depth_bounds
from d2_plugin.priors.stereo.filtering import kernel as filtering
from d2_plugin.priors.stereo.matched_depth import MatchedDepth, frame_blocks
from d2_plugin.priors.stereo.settings import NO_MATCHER
from d2_plugin.priors.summary import PriorSummary
from d2_plugin.recordings.recording import Camera, MonoKind, Recording
from d2_plugin.recordings.selection import select_cameras
from d2_plugin.store.files import hash_of
from d2_plugin.store.store import PriorStore, not_of, other_recording

log = logging.getLogger(__name__)

__all__ = ["PriorSettings", "PriorSummary", "build_priors"]

COMPARED = 12
"""At most about so many images are read to tell whether a store belongs to a recording; the first equal one decides."""

Progress = Callable[[int, int, str], None]
"""(images done, images in all, what was just done)."""


def build_priors(
    recording: Recording,
    cameras: Sequence[str],
    output: Path | str,
    settings: PriorSettings,
    *,
    sparse_points: np.ndarray | None = None,
    progress: Progress = lambda done, total, note: None,
    shard: tuple[int, int] | None = None,
) -> PriorSummary:
    """Build what is missing of the priors of `cameras` in the store at `output`.

    Geometric depth of a frame comes from these cameras at that timestamp and from no other. A view that must be refused
    gets an empty prior and a reason, and the others are built. A build that was killed goes on where it stopped.

    Args:
        recording: the recording.
        cameras: the training cameras; held-out ones must not be among them.
        output: folder of the store.
        settings: everything that decides what D* is.
        sparse_points: world points [N, 3] triangulated with the known poses, for the depth range.
        progress: called after every image.
        shard: (index, count) with 0 <= index < count builds one part of the frames; all parts, built anywhere and in
            any order into one folder, make the store that a single build makes.

    Raises:
        D2Error: unknown cameras, no depth source at all, a folder that holds something else or the priors of another
            recording, no compiler for the kernels, or a disk that is full, broken or not ours.
    """
    output, names = Path(output), list(cameras)
    select_cameras(recording, names)  # refuses none, an unknown one, and one that is named twice
    _refuse_without_kernels()
    frames = _shard(recording.frames, settings, shard)
    _refuse_other_images(recording, names, output)
    place = PriorStore.place(output, names)
    if (place / "store.json").is_file():  # a prior may depend on the order
        names = list(PriorStore.described(place).cameras)
    sources = _Sources.find(recording, names, output, settings, sparse_points)
    store = PriorStore.create(output, names, recording.frames, describe_recording(recording))
    summary = PriorSummary(notes=sources.notes, folder=store.path)
    total, done = len(frames) * len(names), 0
    with store.building():
        for number in frames:
            for name, built in _build_frame(sources, store, number):
                record = store.record(name, number) or {}
                summary.add(name, number, record, built)
                done += 1
                progress(done, total, f"camera {name}, frame {number}: {record['shares']['verified']:.0%} verified")
    return summary


def _build_frame(sources: _Sources, store: PriorStore, number: int) -> Iterator[tuple[str, bool]]:
    """Construct and store what is missing of one frame: (camera, whether it was built now), one after the other."""
    frame = Frame.read(sources.recording, list(sources.cameras), number)
    keys = sources.keys(frame)
    missing = [name for name in keys if store.entries.find_current(name, number, keys[name]) is None]
    for name in missing:
        if (old := _recorded(store, name, number)) is not None and old.get("key") != keys[name]:
            sources.say_replaced(old, store.path)
    # Cameras that are compared need the maps of all others.
    needed = list(sources.cameras) if missing and sources.compared else missing
    priors = construct(sources.views(frame, needed), sources.cameras, sources.settings, sources.kind) if missing else {}
    for name in keys:
        if name in missing:
            record = {**sources.described(name, frame), **priors[name].record(), "key": keys[name]}
            store.write(name, number, priors[name].maps, record)
        yield name, name in missing


@dataclass(frozen=True, eq=False)
class _Sources:
    recording: Recording
    cameras: Mapping[str, Camera]
    wanted: PriorSettings
    """As the user gave them."""
    settings: PriorSettings
    """The same with the variant that the sources allow."""
    mono: MonoSource | None
    multiview: MultiviewSource | None
    geometric: GeometricSource | None
    bounds: DepthBounds | None
    """The depths that are searched; None where nothing bounds them."""
    confidence: ConfidenceMaps
    """Of the monocular maps."""
    notes: list[str]
    """For the user: which sources were taken, and what is left out for lack of one."""
    replaced: set[str] = field(default_factory=set)
    """What was said of priors that are replaced."""

    @classmethod
    def find(
        cls, recording: Recording, names: list[str], output: Path, settings: PriorSettings, points: np.ndarray | None
    ) -> _Sources:
        """The sources that recording and settings name; `points` [N, 3] bound the depths that are searched."""
        maps = output / "cache" / "mono"  # one for all sets of cameras: a map depends on its own image alone
        mono = None if settings.variant == "mvs" else mono_source(recording, settings, maps)
        cache = PriorStore.place(output, names) / "cache"
        notes: list[str] = []
        geometric, bounds = _geometric_source(recording, names, settings, points, cache, notes)
        several = None
        if settings.multiview is not None and settings.variant == "dual" and settings.uncertainty:
            read = functools.partial(Frame.read, recording, names)
            several = MultiviewSource(recording, names, settings, cache / "multiview", read)
        variant = _variant(settings.variant, recording, names, mono or several, geometric, notes)
        return cls(
            recording=recording,
            cameras={name: recording.cameras[name] for name in names},
            wanted=settings,
            settings=replace(settings, variant=variant),
            mono=mono,
            multiview=several,
            geometric=geometric,
            bounds=bounds,
            confidence=ConfidenceMaps.beside(recording.path if settings.uncertainty else None, OF_MONO, names),
            notes=notes,
        )

    @property
    def kind(self) -> MonoKind | None:
        return None if self.mono is None else self.mono.kind

    @property
    def compared(self) -> bool:
        """Whether the prior of one camera depends on those of the others."""
        measured = self.geometric is not None or self.multiview is not None
        return compares_cameras(self.settings, len(self.cameras), measured)

    def views(self, frame: Frame, names: Sequence[str]) -> dict[str, ViewSources]:
        depths = {} if self.geometric is None else self.geometric.depths(frame)
        several = {} if self.multiview is None else self.multiview.views(frame)
        return {
            name: ViewSources(
                frame.images[name],
                depths.get(name),
                None if self.mono is None else self.mono.map(name, frame),
                self.confidence.of(self.cameras[name], frame.number),
                frame.recorded.get(name),
                several.get(name),
            )
            for name in names
        }

    def described(self, name: str, frame: Frame) -> dict[str, Any]:
        """What is recorded about a view besides how its prior was constructed."""
        return {
            "variant": self.settings.variant,
            "monocular": None if self.mono is None else self.mono.about,
            "several": None if self.multiview is None else self.multiview.about,
            "bounds": None if self.bounds is None else list(self.bounds),
            "settings": asdict(self.wanted),
            "camera": describe_camera(self.cameras[name]),
            "image": frame.hashes[name],
        }

    def say_replaced(self, old: Mapping[str, Any], folder: Path) -> None:
        """Warn, once, that priors are replaced, and by what they differ."""
        before = old.get("settings", {})
        given = asdict(self.wanted)
        other = [name for name in given if name in before and hash_of(given[name]) != hash_of(before[name])]
        why = " and ".join(other) or "images or maps, or by another version,"
        if why not in self.replaced:
            self.replaced.add(why)
            log.warning(
                "priors in %s that were built with other %s are replaced: to keep them, give those, or another folder",
                folder, why,
            )  # fmt: skip

    def keys(self, frame: Frame) -> dict[str, str]:
        """Per camera, the hash of everything that its prior depends on."""
        settings = self.settings
        maps = {} if self.mono is None else {name: self._mono_key(name, frame) for name in self.cameras}
        common = (
            CONSTRUCTION_VERSION,
            settings.variant,
            [settings.uncertainty, settings.conflict_sigmas, settings.most_vetoed, settings.tau_c],
            [settings.hanging_limit, settings.far, self.kind, settings.mono_along],
            asdict(settings.align),
            None if self.geometric is None else self.geometric.key(frame),
            None if self.multiview is None else self.multiview.key(frame),
            [settings.agreement, settings.color_limit, *maps.values()] if self.compared else None,
        )
        return {name: hash_of(*common, maps.get(name)) for name in self.cameras}

    def _mono_key(self, name: str, frame: Frame) -> str:
        confidence = self.confidence.of(self.cameras[name], frame.number)
        key = "none" if self.mono is None else self.mono.key(name, frame)
        return key if confidence is None else hash_of(key, digest(confidence))


def _geometric_source(
    recording: Recording,
    names: list[str],
    settings: PriorSettings,
    points: np.ndarray | None,
    cache: Path,
    notes: list[str],
) -> tuple[GeometricSource | None, DepthBounds | None]:
    """Depth on disk where there is any, else matching, or None where nothing is matched; and the depth range."""
    stereo, cameras = settings.stereo, [recording.cameras[name] for name in names]
    maps = find_depth_on_disk(recording, names, stereo)
    if maps is not None:
        notes.append(f"geometric depth: {maps.about}")
        chosen = _chosen_bounds(settings)
        confidence = ConfidenceMaps.beside(recording.path, OF_DEPTH, names)
        return DepthOnDisk(maps, cameras, chosen, stereo, cache, confidence), chosen
    if len(cameras) == 1 or stereo.matcher == NO_MATCHER:
        return None, None
    bounds = _chosen_bounds(settings) or _rounded(depth_bounds(cameras, points, stereo.max_angle))
    read = functools.partial(Frame.read, recording, names)
    return MatchedDepth(cameras, bounds, stereo, cache, recording.frames, read), bounds


def _variant(
    wanted: Variant,
    recording: Recording,
    names: list[str],
    network: MonoSource | MultiviewSource | None,
    geometric: GeometricSource | None,
    notes: list[str],
) -> Variant:
    """The variant that the sources at hand allow; what is left out is noted."""
    if geometric is not None and network is not None:
        return wanted
    if geometric is not None:
        if wanted != "mvs":
            notes.append("no monocular depth: geometric depth counts as verified without a second source")
        return "mvs"
    lacking = "one camera" if len(names) == 1 else "nothing matched"
    if network is None:
        raise D2Error(
            f"{recording.name} has no depth source ({lacking}): give a metric monocular network, a multi-view one, or "
            "cameras that see the same"
        )
    notes.append(f"{lacking}: no geometric depth, so nothing is verified but what several views agree on")
    return wanted


def _refuse_without_kernels() -> None:
    """Load the kernels before anything is computed."""
    try:
        filtering.library()
        cross_view.library()
    except NoCompiler as error:
        raise D2Error(
            f"priors are built by compiled kernels, which a platform wheel brings and a checkout compiles; {error}"
        ) from None


def _refuse_other_images(recording: Recording, names: list[str], output: Path) -> None:
    """Refuse a store none of whose images are those of this recording; where some are, the others were changed since.

    Reads one image where all is well: the first that is recorded and the same.
    """
    if not (output / "store.json").is_file():
        return
    store = PriorStore.described(output)
    shared = [number for number in recording.frames if number in set(store.frames)]
    views = [(name, number) for number in shared for name in names if name in store.cameras]
    recorded = [(view, record) for view in views if (record := _recorded(store, *view)) is not None]
    compared = recorded[:: max(len(recorded) // COMPARED, 1)]
    if compared and not any(view_digest(recording, *view) == record.get("image") for view, record in compared):
        given = describe_recording(recording)
        raise not_of(output, store.about, given, other_recording(store.about, given) or "their images differ")


def _recorded(store: PriorStore, name: str, number: int) -> dict[str, Any] | None:
    """The record of a prior, None where it has none or a damaged one, which is built again."""
    try:
        return store.record(name, number)
    except D2Error:
        return None


def _chosen_bounds(settings: PriorSettings) -> DepthBounds | None:
    return None if settings.depth_range is None else DepthBounds(*settings.depth_range, "setting depth_range")


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
