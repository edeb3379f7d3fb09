"""Declared against true error: what share of D* lies within sigma and 2 sigma of the true depth.

A normal error lies within sigma at 68 % and within 2 sigma at 95 % of the pixels. Real errors have longer tails, so
60 to 80 % and at least 90 % count as honest here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.protocol import Label
from d2_plugin.recordings.recording import Recording
from d2_plugin.recordings.selection import spread
from d2_plugin.store.store import PriorStore
from d2_plugin.values import checked_arguments, counted

DECLARED = (Label.VERIFIED, Label.AGREED, Label.MONO)
"""Labels whose sigma is held against the truth; far pixels claim only a lower bound of depth."""

LEAST_VALUES, COME_BACK, NEARLY_WHOLE = 20, 30, 0.05
"""A true depth map is rounded where it has this many values, each comes back so many times, and so near to whole steps
lie between nearly all of them."""


@dataclass(frozen=True)
class LabelErrors:
    """How the pixels of one label compare with the truth."""

    pixels: int
    """Pixels with this label at which the true depth is known and sigma is finite."""
    share: float
    """Of all pixels of the views that have a true depth map."""
    within: float
    """Share of |log(D / true)| within sigma."""
    within_two: float
    """The same within 2 sigma."""
    sigma: float
    """Median declared sigma."""
    error: float
    """Median of |log(D / true)|."""
    pairs: np.ndarray = field(repr=False, compare=False)
    """|log(D / true)| and sigma of each pixel [2, K]."""


@dataclass(frozen=True)
class DeclaredErrors:
    """D* of one recording held against its true depth."""

    views: int
    """Images that have both a prior and a true depth map."""
    labels: dict[Label, LabelErrors]
    """The labels that some pixel carries."""
    sky_found: float
    """Share of the pixels without a true depth that are labelled far; NaN where there are none."""
    false_far: float
    """Share of the pixels with a true depth that are labelled far."""

    def __str__(self) -> str:
        header = f"{'label':10}{'share':>9}{'within sigma':>15}{'2 sigma':>10}{'sigma':>9}{'error':>9}"
        lines = [f"held against the true depth of {counted(self.views, 'view')}:"]
        lines.append(header if self.labels else "no pixel with a true depth has a finite sigma")
        for label, errors in self.labels.items():
            shares = f"{errors.share:9.1%}{errors.within:15.1%}{errors.within_two:10.1%}"
            lines.append(f"{label_name(label):10}{shares}{errors.sigma:9.4f}{errors.error:9.4f}")
        if self.sky_found > 0 or self.false_far > 0:
            sky = f"{self.sky_found:.1%}" if np.isfinite(self.sky_found) else "none"
            lines.append(f"far: {sky} of the pixels without a true depth, {self.false_far:.1%} of the others")
        return "\n".join(lines)


def frames_with_truth(recording: Recording, cameras: Sequence[str], most: int | None = None) -> list[int]:
    """The frames at which one of these cameras at least has a true depth map; `most` of them, spread, where given."""
    frames = [f for f in recording.frames if any(recording.depth(camera, f) is not None for camera in cameras)]
    return frames if most is None or len(frames) <= most else spread(frames, most)


@checked_arguments
def held_against_truth(
    store: PriorStore, recording: Recording, frames: Sequence[int] | None = None
) -> DeclaredErrors | None:
    """Compare D* with the true depth of the recording, None where it has none.

    Pixels of an infinite sigma declare nothing and are left out. Where the truth
    itself is rounded, what rounding may do to it is added to sigma (see `truth_rounding`).

    Args:
        store: the priors.
        recording: the recording they were built for; 0 in a true depth map is a place without depth, such as sky.
        frames: all of the store where None.

    Raises:
        D2Error: a recording of another size than the priors'.
    """
    collected: dict[Label, list[np.ndarray]] = {label: [] for label in DECLARED}
    views = pixels = sky = sky_far = surface_far = 0
    for frame in store.frames if frames is None else frames:
        for camera in store.cameras:
            truth = recording.depth(camera, frame)
            prior = None if truth is None else store.prior(camera, frame)
            if truth is None or prior is None or prior.sigma is None:
                continue
            if prior.depth.shape != truth.shape:
                (rows, columns), (true_rows, true_columns) = prior.depth.shape, truth.shape
                raise D2Error(
                    f"the prior of camera {camera} has {columns}x{rows} pixels and its true depth "
                    f"{true_columns}x{true_rows}: open the recording with the downscale of the prior"
                )
            depth, labels, sigma = prior.depth.numpy(), prior.labels.numpy(), prior.sigma.numpy()
            known, far = np.isfinite(truth) & (truth > 0), labels == Label.FAR
            rounding = truth_rounding(truth)
            views, pixels, sky = views + 1, pixels + truth.size, sky + int((~known).sum())
            sky_far, surface_far = sky_far + int((far & ~known).sum()), surface_far + int((far & known).sum())
            for label, pairs in collected.items():
                mask = known & (labels == label) & np.isfinite(sigma)
                error = np.abs(np.log(depth[mask] / truth[mask].astype(np.float64)))
                pairs.append(np.stack([error, np.hypot(sigma[mask], rounding[mask])]))
    if not views:
        return None
    by_label = {label: np.concatenate(pairs, axis=1) for label, pairs in collected.items()}
    return DeclaredErrors(
        views,
        {label: _label_errors(pairs, pixels) for label, pairs in by_label.items() if pairs.size},
        sky_far / sky if sky else float("nan"),
        surface_far / max(pixels - sky, 1),
    )


def truth_rounding(truth: np.ndarray) -> np.ndarray:
    """Relative standard deviation of a true depth map [H, W] from the steps it is stored in; 0 where it is unknown.

    A disparity that was rounded to a third of a pixel, as in Middlebury's maps, puts the depth off by .1 % where
    matching is as exact as that. Rounding shows: a few values of inverse depth come back many times, and whole
    multiples of one step lie between them. Its errors are uniform, so their standard deviation is step / sqrt(12).
    """
    known = np.isfinite(truth) & (truth > 0)
    values = np.unique(1 / truth[known].astype(np.float64))
    rounding = np.zeros(truth.shape)
    if values.size < LEAST_VALUES or known.sum() < COME_BACK * values.size:
        return rounding
    step = float(np.median(np.diff(values)))
    multiples = np.diff(values) / step
    if np.mean(np.abs(multiples - np.rint(multiples)) < NEARLY_WHOLE) > 1 - NEARLY_WHOLE:
        rounding[known] = truth[known] * step / np.sqrt(12)
    return rounding


def _label_errors(pairs: np.ndarray, pixels: int) -> LabelErrors:
    """Of errors and sigmas [2, K] of one label, out of so many `pixels` in all."""
    error, sigma = pairs
    within, within_two = (float((error <= times * sigma).mean()) for times in (1, 2))
    medians = float(np.median(sigma)), float(np.median(error))
    return LabelErrors(error.size, error.size / pixels, within, within_two, *medians, pairs)


def label_name(label: Label) -> str:
    """The label as a person reads it."""
    return "mono only" if label == Label.MONO else label.name.lower()
