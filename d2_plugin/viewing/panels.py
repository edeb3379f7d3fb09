"""The kinds of image that can be shown of one view, by the names that --show takes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from torch import Tensor

from d2_plugin.protocol import View
from d2_plugin.recordings.images import color_bytes, opencv
from d2_plugin.runs.drawing import Panel, Scale, colorize, depth_panel, error_panel
from d2_plugin.runs.evaluation import what_counts
from d2_plugin.viewing.rendering import RenderedView, render_view
from d2_plugin.viewing.viewed import ViewedRun

GREYS = np.arange(256, dtype=np.uint8)[:, None].repeat(3, 1)


@dataclass(frozen=True, eq=False)
class Shot:
    """One view of one run, with everything that a panel may need, computed at first use."""

    viewed: ViewedRun
    view: View
    depths: Scale | None = None
    """Depths at both ends of the colours, the same for all images of a video, or it would flicker; by default those of
    this image."""
    marked: Tensor | None = None
    """See `render_view`."""

    @cached_property
    def rendered(self) -> RenderedView:
        """What the backbone shows."""
        recorded = self.viewed.recording.cameras.get(self.view.camera, self.viewed.training[0])
        return render_view(self.viewed.backbone, self.view, self.marked, float(self.view.K[0, 0] / recorded.K[0, 0]))

    @cached_property
    def truth(self) -> np.ndarray:
        """The recorded image, RGB uint8 [H, W, 3] at the view's size."""
        image = self.viewed.recording.image(self.view.camera, self.view.frame)
        return fitted(image, self.view.width, self.view.height)


def true_depth(shot: Shot) -> Panel:
    """The recording's true depth; black where it is unknown."""
    recorded = shot.viewed.recording.depth(shot.view.camera, shot.view.frame)
    size = shot.view.width, shot.view.height
    exact = np.zeros(size[::-1], np.float32) if recorded is None else fitted(recorded, *size, nearest=True)
    return depth_panel("true depth", exact, shot.depths)


def error(shot: Shot) -> Panel:
    """Absolute error of the render against the recorded image."""
    difference = np.abs(shot.rendered.color.numpy() - shot.truth / np.float32(255))
    counts = what_counts(shot.viewed.recording, shot.view.camera)
    scored = ... if counts is None else fitted(counts.astype(np.uint8), shot.view.width, shot.view.height, True) > 0
    noise = float(np.mean(difference[scored] ** 2))
    return error_panel(difference, f"  {-10 * np.log10(noise):.1f} dB" if noise > 0 else "")


KINDS: dict[str, Callable[[Shot], Panel]] = {
    "rgb": lambda shot: Panel("render", color_bytes(shot.rendered.color.numpy())),
    "depth": lambda shot: depth_panel("depth", shot.rendered.depth.numpy(), shot.depths),
    "alpha": lambda shot: Panel("alpha 0..1", colorize(shot.rendered.alpha.numpy(), 0, 1, GREYS), GREYS),
    "truth": lambda shot: Panel("recorded", shot.truth),
    "error": error,
    "true-depth": true_depth,
}
"""By the name that --show takes."""
RECORDED = ("truth", "error", "true-depth")
"""Those that exist at the recording's own cameras and frames only."""


def fitted(array: np.ndarray, width: int, height: int, nearest: bool = False) -> np.ndarray:
    """An image or map at another size, as `camera_paths.for_size` has it: scaled to fill, cut alike on both sides.

    `nearest` picks one pixel instead of averaging several: for depths and labels, which have no mean across an edge.
    """
    if array.shape[:2] == (height, width):
        return array
    cv2 = opencv("an image of another size than the recording's")
    scale = max(width / array.shape[1], height / array.shape[0])
    whole = max(round(array.shape[1] * scale), width), max(round(array.shape[0] * scale), height)
    how = cv2.INTER_NEAREST if nearest else cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    large = cv2.resize(array, whole, interpolation=how)
    left, top = (whole[0] - width) // 2, (whole[1] - height) // 2
    return large[top : top + height, left : left + width]
