"""Geometric depth of a recording by matching, frame after frame: what did not change is carried over (`reuse`).

Frames come in blocks within which matches of static pixels are carried over, so a frame depends on the images before
it in its block and on no other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from itertools import pairwise
from pathlib import Path

from d2_plugin.priors.frame import Frame, describe_camera, hash_of
from d2_plugin.priors.stereo.depth_range import DepthBounds
from d2_plugin.priors.stereo.filtering.filter import GeometricDepth
from d2_plugin.priors.stereo.geometric_depth import WHOLE_IMAGES, choose_matcher, geometric_depth
from d2_plugin.priors.stereo.reuse import MatchMemory
from d2_plugin.priors.stereo.settings import StereoSettings
from d2_plugin.recordings.recording import Camera

MATCH_VERSION = 7  # raise it when matchers or filter change what they return, so that caches are not trusted


class MatchedDepth:
    """Filtered geometric depth that is matched between the cameras; a `GeometricSource` of the cache.

    Args:
        cameras: the cameras that are matched.
        bounds: depth range that is searched.
        settings: matching, filtering, carrying over.
        folder: where the matches of unfinished blocks are kept, so that a build that is killed goes on with them.
        frames: all frame numbers of the build, ascending.
        read: reads the images of one frame.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        bounds: DepthBounds,
        settings: StereoSettings,
        folder: Path,
        frames: Sequence[int],
        read: Callable[[int], Frame],
    ) -> None:
        self.matcher = choose_matcher(settings.matcher)
        if self.matcher in WHOLE_IMAGES:
            settings = replace(settings, reuse_static=False)
        self.cameras, self.bounds, self.settings = list(cameras), bounds, settings
        self.folder, self.read = folder, read
        self.blocks = frame_blocks(frames, settings)
        self._before = {after: before for block in self.blocks for before, after in pairwise(block)}
        self._keys: dict[int, str] = {}
        self._memory, self._remembered = MatchMemory(), ""

    @property
    def matched_share(self) -> float:
        """Share of the pixels of the last frame that were matched anew."""
        return self._memory.matched_share if self.settings.reuse_static else 1.0

    def key(self, frame: Frame) -> str:
        """Hash of images, cameras, range and settings: of all views, since each depends on all."""
        if frame.number not in self._keys:
            before = self._before.get(frame.number)
            if before is not None and before not in self._keys:
                self.key(self.read(before))
            self._keys[frame.number] = hash_of(
                MATCH_VERSION,
                self.matcher,
                asdict(self.settings),
                list(self.bounds[:2]),
                [describe_camera(camera) for camera in self.cameras],
                [frame.hashes[camera.name] for camera in self.cameras],
                "" if before is None else self._keys[before],
            )
        return self._keys[frame.number]

    def depths(self, frame: Frame) -> list[GeometricDepth]:
        """D^g per camera at one frame, after making sure that the memory is that of the frame before it."""
        key, before = self.key(frame), self._before.get(frame.number)
        if before is None:
            self._memory = MatchMemory()
        elif self._remembered != self._keys[before]:
            self._remember(before)
        images = [frame.images[camera.name] for camera in self.cameras]
        memory = self._memory if self.settings.reuse_static else None
        results = geometric_depth(images, self.cameras, self.bounds[:2], self.settings, self.matcher, memory)
        self._remembered = key
        if frame.number in self._before.values():
            self._memory.save(self._saved(frame.number), key)
        return results

    def _remember(self, number: int) -> None:
        """Make the memory that of this frame: as it was saved, or by matching again from the start of the block."""
        saved = MatchMemory.load(self._saved(number), self._keys[number], len(self.cameras))
        if saved is None:
            self.depths(self.read(number))
        else:
            self._memory = saved

    def _saved(self, number: int) -> Path:
        """Where the memory of a frame's block is kept."""
        return self.folder / f"{next(block[0] for block in self.blocks if number in block):05d}"


def frame_blocks(frames: Sequence[int], settings: StereoSettings) -> list[tuple[int, ...]]:
    """Frames in the groups that must be built in order; single frames where nothing is carried over."""
    size = max(settings.reuse_block, 1) if settings.reuse_static else 1
    return [tuple(frames[start : start + size]) for start in range(0, len(frames), size)]
