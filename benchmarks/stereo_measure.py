"""What is measured about geometric depth: which settings, and how good their maps are after the common filter."""

import time
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from benchmarks.stereo_rigs import Rig
from d2_plugin.errors import D2Error
from d2_plugin.priors.settings import StereoSettings
from d2_plugin.priors.stereo.filtering.filter import GeometricDepth, filter_depths
from d2_plugin.priors.stereo.geometric_depth import gray
from d2_plugin.priors.stereo.patchmatch import patchmatch

VARIANTS = {"default": StereoSettings(), "2 sources": StereoSettings(patchmatch_sources=2)}
"""What is measured of the matcher: the default first."""


class Run(NamedTuple):
    """Filtered depth of a rig's views, and what it took."""

    depths: list[GeometricDepth]
    cpu: float  # seconds per view, matching alone, over all threads
    wall: float  # seconds per view, matching alone


def run(settings: StereoSettings, rig: Rig, depth_range: tuple[float, float]) -> Run:
    """Match and filter one rig.

    Raises:
        D2Error: this rig cannot be matched.
    """
    grays = [gray(image) for image in rig.images]
    start_cpu, start = time.process_time(), time.perf_counter()
    raw = patchmatch(grays, rig.cameras, depth_range, settings)
    cpu, wall = time.process_time() - start_cpu, time.perf_counter() - start
    depths, costs = zip(*raw, strict=True)
    filtered = filter_depths(grays, rig.cameras, depths, costs, settings)
    views = len(rig.cameras)
    return Run(filtered, cpu / views, wall / views)


class Score(NamedTuple):
    """How good filtered depth is, over all views with truth of one or more rigs; shares are 0..1."""

    completeness: float  # of the co-visible pixels, those with a depth
    f1: float  # harmonic mean of: surviving depths within 1 %, co-visible pixels with a depth within 1 %
    median: float  # relative error of the surviving depths; None of them: NaN
    within: float  # surviving depths with a relative error below 1 %
    wrong: float  # surviving depths with a relative error above 5 %
    pixels: int  # co-visible ones


def score(depths: Iterable[np.ndarray], truths: Iterable[np.ndarray | None], covisible: Iterable[np.ndarray]) -> Score:
    """Compare maps [H, W] (0 = no depth) with the truth (0 = unknown, None = not published)."""
    errors, found, right, pixels = [], 0, 0, 0
    for depth, truth, seen in zip(depths, truths, covisible):
        if truth is None:
            continue
        judged = (depth > 0) & (truth > 0)
        error = np.abs(depth - truth)[judged] / truth[judged]
        errors.append(error)
        pixels += int(np.count_nonzero(seen))
        found += int(np.count_nonzero(judged & seen))
        right += int(np.count_nonzero(error[seen[judged]] < 0.01))
    every = np.concatenate(errors) if errors else np.zeros(0)
    if every.size == 0 or pixels == 0:
        return Score(0.0, 0.0, float("nan"), float("nan"), float("nan"), pixels)
    precision, recall = float(np.mean(every < 0.01)), right / pixels
    f1 = 2 * precision * recall / max(precision + recall, 1e-12)
    return Score(found / pixels, f1, float(np.median(every)), precision, float(np.mean(every > 0.05)), pixels)


def measure(setting: str, settings: StereoSettings, rigs: Sequence[Rig], widen: float = 1.0) -> dict[str, Any]:
    """One row: scores and times over the rigs of one name, or `failed` with the matcher's own words.

    `widen` divides the near and multiplies the far end of the depth range.
    """
    row: dict[str, Any] = {
        "method": "patchmatch",
        "setting": setting,
        "rig": rigs[0].name,
        "views": len(rigs[0].cameras),
    }
    row |= {"width": rigs[0].cameras[0].width, "height": rigs[0].cameras[0].height, "failed": None}
    try:
        runs = [run(settings, rig, (rig.depth_range[0] / widen, rig.depth_range[1] * widen)) for rig in rigs]
    except D2Error as error:
        return {**row, "failed": str(error)}
    found = score(
        [result.depth for each in runs for result in each.depths],
        [truth for rig in rigs for truth in rig.truths],
        [seen for rig in rigs for seen in rig.covisible],
    )
    times = {name: float(np.mean([getattr(each, name) for each in runs])) for name in ("cpu", "wall")}
    pixels = rigs[0].cameras[0].width * rigs[0].cameras[0].height
    numbers = {name: None if value != value else value for name, value in found._asdict().items()}
    return {**row, **numbers, **times, "microseconds_per_pixel": times["cpu"] / pixels * 1e6}
