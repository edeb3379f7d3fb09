"""Building the priors of a recording: choose the sources, construct D* frame by frame, keep what is there already."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from d2_plugin.errors import D2Error, unknown_name
from d2_plugin.priors.construct import CONSTRUCTION_VERSION, Construction
from d2_plugin.priors.depth_on_disk import FilteredDepthOnDisk, find_depth_on_disk
from d2_plugin.priors.disk.confidence import OF_DEPTH, OF_MONO, ConfidenceMaps
from d2_plugin.priors.frame import Frame, describe_camera, describe_recording, digest, hash_of, not_of, view_digest
from d2_plugin.priors.monocular.maps import mono_source
from d2_plugin.priors.settings import PriorSettings, Variant
from d2_plugin.priors.stereo.cache import DepthCache, GeometricSource
from d2_plugin.priors.stereo.depth_range import DepthBounds, depth_bounds
from d2_plugin.priors.stereo.match import MatchedDepth, frame_blocks
from d2_plugin.priors.stereo.settings import NO_MATCHER
from d2_plugin.priors.summary import PriorSummary
from d2_plugin.recordings.recording import Recording
from d2_plugin.store.store import PriorStore

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
    progress: Progress | None = None,
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
            recording, or a disk that is full, broken or not ours.
    """
    frames = _shard(recording.frames, settings, shard)
    builder = _Builder(recording, list(cameras), Path(output), settings, sparse_points)
    summary = PriorSummary(notes=builder.notes, folder=builder.store.path)
    total, done = len(frames) * len(builder.names), 0
    with builder.store.building(Path(output)):
        for number in frames:
            for camera, record, built in builder.build(number):
                summary.add(camera, number, record, built)
                done += 1
                if progress is not None:
                    share = f"{record['shares']['verified']:.0%} verified"
                    progress(done, total, f"camera {camera}, frame {number}: {share}")
    return summary


class _Builder:
    """The sources, the construction and the store of one build."""

    def __init__(
        self, recording: Recording, names: list[str], output: Path, settings: PriorSettings, points: np.ndarray | None
    ) -> None:
        _check(recording, names)
        _refuse_other_images(recording, names, output)
        self.recording, self.names, self.settings = recording, _ordered(names, output), settings
        self.notes: list[str] = []
        self._block_keys: dict[int, str] = {}
        self.cameras = {name: recording.cameras[name] for name in self.names}
        self.bounds: DepthBounds | None = None
        maps = output / "cache" / "mono"  # one for all sets of cameras: a map depends on its own image alone
        self.mono = None if settings.variant == "mvs" else mono_source(recording, settings, maps)
        cache = PriorStore.place(output, self.names) / "cache"
        self.source = self._geometric_source(points, cache / "matches")
        possible = replace(settings, variant=self._variant())
        self.confidence = ConfidenceMaps.beside(recording.path if settings.uncertainty else None, OF_MONO, self.names)
        self.store = PriorStore.create(output, self.names, recording.frames, describe_recording(recording))
        geometric = None if self.source is None else DepthCache(self.source, cache / "stereo")
        self.construction = Construction(self.cameras, self.mono, geometric, possible, self.confidence, self.block)

    def _geometric_source(self, points: np.ndarray | None, matches: Path) -> GeometricSource | None:
        """Depth on disk where there is any, else matching, or None where nothing is matched; sets the depth range."""
        stereo, cameras = self.settings.stereo, list(self.cameras.values())
        found = find_depth_on_disk(self.recording, self.names, stereo)
        if found is not None:
            self.notes.append(f"geometric depth: {found.about}")
            self.bounds = _chosen_bounds(self.settings)
            confidence = ConfidenceMaps.beside(self.recording.path, OF_DEPTH, self.names)
            return FilteredDepthOnDisk(found, cameras, self.bounds, stereo, confidence)
        if len(cameras) == 1 or stereo.matcher == NO_MATCHER:
            return None
        self.bounds = _chosen_bounds(self.settings) or _rounded(depth_bounds(cameras, points, stereo.max_angle))
        return MatchedDepth(cameras, self.bounds, stereo, matches, self.recording.frames, self.read)

    def _variant(self) -> Variant:
        """The variant that the sources at hand allow; what is left out is noted."""
        wanted = self.settings.variant
        if self.source is not None and self.mono is not None:
            return wanted
        if self.source is not None:
            if wanted != "mvs":
                self.notes.append("no monocular depth: geometric depth counts as verified without a second source")
            return "mvs"
        if self.mono is None:
            raise D2Error(
                f"{self.recording.name} has no depth source ({self._lacking}): give a metric monocular network, or "
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
        """The images of one frame."""
        return Frame.read(self.recording, self.names, number)

    def block(self, number: int) -> list[Frame]:
        """The images of all frames that are built in order with this one."""
        blocks = frame_blocks(self.recording.frames, self.settings.stereo)
        return [self.read(frame) for frame in next(block for block in blocks if number in block)]

    def build(self, number: int) -> Iterator[tuple[str, dict[str, Any], bool]]:
        """(camera, record, whether it was built now) for every camera of one frame."""
        frame = self.read(number)
        keys = self._keys(frame)
        missing = [name for name in self.names if not self.store.is_current(name, number, keys[name])]
        priors = self.construction.priors(frame, missing) if missing else {}
        for name in self.names:
            if name in missing:
                record = {**self._described(name, frame), **priors[name].record(), "key": keys[name]}
                self.store.write(name, number, priors[name].maps, record)
            yield name, self.store.record(name, number) or {}, name in missing

    def _described(self, name: str, frame: Frame) -> dict[str, Any]:
        """What is recorded about a view besides how its prior was constructed."""
        return {
            "variant": self.construction.settings.variant,
            "monocular": None if self.mono is None else self.mono.about,
            "bounds": None if self.bounds is None else list(self.bounds),
            "settings": asdict(self.settings),
            "camera": describe_camera(self.cameras[name]),
            "image": frame.hashes[name],
        }

    def _mono_key(self, name: str, frame: Frame) -> str:
        """Hash of a monocular map and of what it says of itself."""
        sure = self.confidence.of(self.cameras[name], frame.number)
        key = "none" if self.mono is None else self.mono.key(name, frame)
        return key if sure is None else hash_of(key, digest(sure))

    def _keys(self, frame: Frame) -> dict[str, str]:
        """Per camera, the hash of everything that its prior depends on."""
        settings = self.construction.settings
        geometric = None if self.source is None else self.source.key(frame)
        maps = {} if self.mono is None else {name: self._mono_key(name, frame) for name in self.names}
        common = (
            CONSTRUCTION_VERSION,
            settings.variant,
            [settings.uncertainty, settings.conflict_sigmas, settings.most_vetoed, settings.tau_c],
            [settings.z_far_factor, settings.hanging_limit, settings.far, settings.mono_along],
            asdict(settings.align),
            geometric,
            [settings.agreement, *maps.values()] if self.construction.agrees else None,
        )
        block = self._block_key(frame.number) if settings.align.together else None
        return {name: hash_of(*common, block, maps.get(name)) for name in self.names}

    def _block_key(self, number: int) -> str:
        """Hash of what the alignments of a block depend on, which those of each of its frames do."""
        if number not in self._block_keys:
            frames = self.block(number)
            stereo = [None if self.source is None else self.source.key(frame) for frame in frames]
            maps = [self._mono_key(name, frame) for frame in frames for name in self.names]
            self._block_keys |= dict.fromkeys((frame.number for frame in frames), hash_of(stereo, maps))
        return self._block_keys[number]


def _ordered(names: list[str], output: Path) -> list[str]:
    """The cameras in the order in which their store has them already, if it does: a prior may depend on the order."""
    place = PriorStore.place(output, names)
    return list(PriorStore.described(place).cameras) if (place / "store.json").is_file() else names


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
        raise not_of(output, store.about, describe_recording(recording), "their images differ")


def _recorded(store: PriorStore, name: str, number: int) -> dict[str, Any] | None:
    """The record of a prior, None where it has none or a damaged one, which is built again."""
    try:
        return store.record(name, number)
    except D2Error:
        return None


def _chosen_bounds(settings: PriorSettings) -> DepthBounds | None:
    """The depth range of the settings, None where they leave it open."""
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


def _check(recording: Recording, names: list[str]) -> None:
    if not names:
        raise D2Error("no camera was chosen for the priors: name at least one")
    for name in names:
        if name not in recording.cameras:
            raise unknown_name("camera", name, recording.cameras)
    if len(set(names)) < len(names):
        raise D2Error(f"a camera is named twice in {', '.join(names)}: name each once")
