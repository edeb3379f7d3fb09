"""Geometric depth of a recording by matching, frame after frame: what did not change is carried over (`reuse`).

Frames come in blocks within which matches of static pixels are carried over, so a frame depends on the images before
it in its block and on no other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

from d2_plugin.priors.frame import Frame
from d2_plugin.priors.geometric_source import GeometricSource
from d2_plugin.priors.stereo.depth_range import DepthBounds
from d2_plugin.priors.stereo.filtering.filter import GeometricDepth
from d2_plugin.priors.stereo.geometric_depth import SCALES, geometric_depth
from d2_plugin.priors.stereo.reuse import MatchMemory
from d2_plugin.priors.stereo.settings import StereoSettings
from d2_plugin.recordings.recording import Camera


class MatchedDepth(GeometricSource):
    """Filtered geometric depth that is matched between the cameras.

    Args:
        settings: matching, filtering, carrying over.
        cache: folder below which depth is kept.
        frames: all frame numbers of the build, ascending.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        bounds: DepthBounds,
        settings: StereoSettings,
        cache: Path,
        frames: Sequence[int],
        read: Callable[[int], Frame],
    ) -> None:
        super().__init__(cameras, bounds, settings, "patchmatch", cache / "stereo")
        self.depth_range = bounds[:2]
        self.read = read
        self._before = {after: before for block in frame_blocks(frames, settings) for before, after in pairwise(block)}
        self._memories, self._remembered = _memories(), ""

    def _inputs(self, frame: Frame) -> str:
        """The key of the frame whose matches are carried over."""
        before = self._before.get(frame.number)
        if before is None:
            return ""
        if before not in self._keys:
            self.key(self.read(before))
        return self._keys[before]

    def _computed(self, frame: Frame) -> list[GeometricDepth]:
        """D^g per camera at one frame. A build that goes on within a block matches the frames before it again."""
        self.key(frame)
        missing = [frame.number]
        while (before := self._before.get(missing[-1])) is not None and self._remembered != self._keys[before]:
            missing.append(before)
        for number in missing[:0:-1]:
            self._matched(self.read(number))
        return self._matched(frame)

    def _matched(self, frame: Frame) -> list[GeometricDepth]:
        """The same once the frame before it, if it has one, was matched last."""
        if frame.number not in self._before:
            self._memories = _memories()
        images = [frame.images[camera.name] for camera in self.cameras]
        memories = self._memories if self.settings.reuse_static else None
        results = geometric_depth(images, self.cameras, self.depth_range, self.settings, memories)
        self._remembered = self._keys[frame.number]
        matched_share = 1.0 if memories is None else round(memories[0].matched_share, 6)
        return [replace(result, record=result.record | {"matched_share": matched_share}) for result in results]


def _memories() -> list[MatchMemory]:
    return [MatchMemory() for _ in SCALES]


def frame_blocks(frames: Sequence[int], settings: StereoSettings) -> list[tuple[int, ...]]:
    """Frames in the groups that must be built in order; single frames where nothing is carried over."""
    size = max(settings.reuse_block, 1) if settings.reuse_static else 1
    return [tuple(frames[start : start + size]) for start in range(0, len(frames), size)]
