"""The kinds of image that can be shown of one view, in one table: what each needs, and how it is drawn."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.priors.sheet import LABEL_COLORS, SURE, UNKNOWN, UNSURE, label_colors, sigma_colors
from d2_plugin.protocol import DepthPrior, Label, View
from d2_plugin.recordings.images import opencv
from d2_plugin.runs.drawing import Panel, color_scale, colorize
from d2_plugin.viewing.look import Look, gaussians_per_pixel, look
from d2_plugin.viewing.paths import Lens
from d2_plugin.viewing.subject import Subject

ERROR_SHOWN = 0.25
"""Absolute colour error, mean over channels, at the bright end of its scale."""
MOST_GAUSSIANS = 200.0
"""Gaussians per pixel at the bright end of their scale, which is logarithmic."""

Scale = tuple[float, float]


@dataclass(frozen=True, eq=False)
class Shot:
    """One view of one subject, with everything that a panel may ask for, computed when asked for."""

    subject: Subject
    view: View
    depths: Scale
    """Depths at both ends of the colours: the same for all images of a video, or it would flicker."""

    @cached_property
    def look(self) -> Look:
        """What the backbone shows."""
        return look(self.subject.backbone, self.view)

    @cached_property
    def truth(self) -> np.ndarray:
        """The recorded image, RGB uint8 [H, W, 3] at the view's size."""
        image = self.subject.recording.image(self.view.camera, self.view.frame)
        return fitted(image, self.view.width, self.view.height)

    @cached_property
    def prior(self) -> DepthPrior | None:
        """The depth prior of this view at its own size; None where the store has none."""
        store = self.subject.store
        known = store is not None and self.view.camera in store.cameras
        return store.prior(self.view.camera, self.view.frame) if known and store is not None else None


class Kind(NamedTuple):
    """One kind of image."""

    draw: Callable[[Shot], Panel]
    about: str
    needs: str = "gaussians"
    """`gaussians`; or `truth`, `prior`: also a camera and a frame of the recording."""


def rgb(shot: Shot) -> Panel:
    """The render."""
    return Panel("render", as_bytes(shot.look.color.numpy()))


def truth(shot: Shot) -> Panel:
    """The recorded image."""
    return Panel("recorded", shot.truth)


def depth(shot: Shot) -> Panel:
    """Rendered depth."""
    return _depth_panel("depth", shot.look.depth.numpy(), shot.depths)


def true_depth(shot: Shot) -> Panel:
    """The recording's true depth; black where it is unknown."""
    found = shot.subject.recording.depth(shot.view.camera, shot.view.frame)
    size = shot.view.width, shot.view.height
    exact = np.zeros(size[::-1], np.float32) if found is None else fitted(found, *size, nearest=True)
    return _depth_panel("true depth", exact, shot.depths)


def error(shot: Shot) -> Panel:
    """Absolute error of the render against the recorded image."""
    difference = np.abs(shot.look.color.numpy() - shot.truth / np.float32(255))
    scale = color_scale("inferno")
    noise = float(np.mean(difference**2))
    score = f"  {-10 * np.log10(noise):.1f} dB" if noise > 0 else ""
    return Panel(f"error 0..{ERROR_SHOWN:g}{score}", colorize(difference.mean(-1), 0, ERROR_SHOWN, scale), scale)


def alpha(shot: Shot) -> Panel:
    """Accumulated alpha."""
    scale = np.arange(256, dtype=np.uint8)[:, None].repeat(3, 1)
    return Panel("alpha 0..1", colorize(shot.look.alpha.numpy(), 0, 1, scale), scale)


def count(shot: Shot) -> Panel:
    """Gaussians per pixel."""
    found = gaussians_per_pixel(shot.look.splats, shot.view, shot.subject.backbone.settings).numpy()
    scale, most = color_scale("inferno"), np.log1p(MOST_GAUSSIANS)
    return Panel(f"Gaussians 0..{MOST_GAUSSIANS:g} (log)", colorize(np.log1p(found), 0, most, scale), scale)


def prior(shot: Shot) -> Panel:
    """The depth prior D*."""
    return _depth_panel("prior", _of_prior(shot, lambda found: found.depth.numpy()), shot.depths)


def sigma(shot: Shot) -> Panel:
    """How wrong the prior says it may be."""
    image = _of_prior(shot, lambda found: sigma_colors(_sigma_of(found), found.depth.numpy()))
    rows = np.geomspace(SURE, UNSURE, 256, dtype=np.float32)[None]
    bar = sigma_colors(rows, np.ones_like(rows))[0]
    return Panel(f"sigma {SURE:.1%}..{UNSURE:.0%}", image, bar)


def labels(shot: Shot) -> Panel:
    """What the prior knows about each pixel."""
    image = _of_prior(shot, lambda found: label_colors(found.labels.numpy()))
    shown = (Label.VERIFIED, Label.AGREED, Label.MONO, Label.FAR, Label.CONFLICT, Label.EMPTY)
    bar = np.array([LABEL_COLORS[label] for label in shown], np.uint8).repeat(64, axis=0)
    return Panel("verified agreed mono far conflict empty", image, bar)


KINDS = {
    "rgb": Kind(rgb, "the render"),
    "depth": Kind(depth, "rendered depth"),
    "alpha": Kind(alpha, "accumulated opacity"),
    "count": Kind(count, "Gaussians per pixel"),
    "truth": Kind(truth, "the recorded image", "truth"),
    "error": Kind(error, "absolute error against it", "truth"),
    "true-depth": Kind(true_depth, "the recording's own depth", "truth"),
    "prior": Kind(prior, "the depth prior", "prior"),
    "sigma": Kind(sigma, "how wrong the prior may be", "prior"),
    "labels": Kind(labels, "what the prior knows", "prior"),
}
"""By the name that --show takes."""


def fitted(array: np.ndarray, width: int, height: int, nearest: bool = False) -> np.ndarray:
    """An image or map at another size, as `Lens.fitted` has it: scaled to fill, cut alike on both sides.

    `nearest` picks one pixel instead of averaging several: for depths and labels, which have no mean across an edge.
    """
    if array.shape[:2] == (height, width):
        return array
    cv2 = opencv("an image of another size than the recording's")
    scale = Lens(np.eye(3), array.shape[1], array.shape[0]).fitted(width, height).K[0, 0]
    whole = max(round(array.shape[1] * scale), width), max(round(array.shape[0] * scale), height)
    how = cv2.INTER_NEAREST if nearest else cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    large = cv2.resize(array, whole, interpolation=how)
    left, top = (whole[0] - width) // 2, (whole[1] - height) // 2
    return large[top : top + height, left : left + width]


def depth_scale(depths: Sequence[np.ndarray]) -> Scale:
    """1st and 99th percentile of the known depths of several maps; (0, 1) where none is known."""
    known = np.concatenate([depth[np.isfinite(depth) & (depth > 0)] for depth in depths]) if depths else np.zeros(0)
    if not known.size:
        return 0.0, 1.0
    low, high = np.percentile(known, (1, 99))
    return float(low), float(high)


def depth_image(depth: np.ndarray, depths: Scale) -> np.ndarray:
    """RGB uint8 [H, W, 3], near is dark; black where nothing is known."""
    known = np.isfinite(depth) & (depth > 0)
    image = colorize(np.where(known, depth, 0), *depths, color_scale("viridis"))
    return np.where(known[..., None], image, np.uint8(0))


def as_bytes(image: np.ndarray) -> np.ndarray:
    """RGB uint8 of an image in 0..1."""
    return np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)


def _depth_panel(title: str, depth: np.ndarray, depths: Scale) -> Panel:
    low, high = depths
    return Panel(f"{title} {low:.3g}..{high:.3g}", depth_image(depth, depths), color_scale("viridis"))


def _of_prior(shot: Shot, draw: Callable[[DepthPrior], np.ndarray]) -> np.ndarray:
    """An image or map of the prior at the view's size."""
    if shot.prior is None:
        raise D2Error(
            f"there is no depth prior of camera {shot.view.camera}, frame {shot.view.frame}: leave prior, sigma and "
            "labels out of --show, or build the priors with `d2 priors`"
        )
    return fitted(draw(shot.prior), shot.view.width, shot.view.height, nearest=True)


def _sigma_of(found: DepthPrior) -> np.ndarray:
    return np.full(found.depth.shape, np.inf, np.float32) if found.sigma is None else found.sigma.numpy()


__all__ = ["KINDS", "UNKNOWN", "Kind", "Scale", "Shot", "as_bytes", "depth_image", "depth_scale", "fitted"]
