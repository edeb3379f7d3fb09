"""`python -m benchmarks priors`: declared against true error of the depth prior, on every recording that has true
depth.

The prior is built with the default settings, as `d2 priors` does, and every finite sigma is held against the error that
the pixel has. A normal error lies within sigma at 68 % and within 2 sigma at 95 % of the pixels; 60 to 80 % and at
least 90 % count as calibrated. Of rendered rigs scene flow and what lies between two instants are held against truth as
well. `python -m benchmarks report` draws the reliability diagram of the rows.
"""

import logging
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import torch

from benchmarks.priors_motion import motion_errors
from benchmarks.rows import begin_rows, told
from benchmarks.stereo_rigs import ARCS, RENDERED
from d2_plugin.errors import D2Error, refuse_unknown
from d2_plugin.priors.build import build_priors
from d2_plugin.priors.declared_error import DeclaredErrors, frames_with_truth, held_against_truth, label_name
from d2_plugin.priors.settings import PriorSettings
from d2_plugin.recordings import Recording, open_recording
from d2_plugin.recordings.synthetic.room import synthetic_recording
from d2_plugin.runs.rows import Row, append_rows, command_line, make_row
from d2_plugin.runs.start import triangulated_points
from d2_plugin.settings import AtATime, Count, Positional, Range, Settings
from d2_plugin.store.store import PriorStore

logger = logging.getLogger(__name__)

RENDERED_FRAMES = 24

NORMAL_SHARE = 0.6827
"""Share of normal errors that lie within one standard deviation."""
BINS_PER_DECADE = 4
"""Bins of the curve: the declared sigma within one differs by a factor of 1.8 at most."""
LEAST_SHARE, LEAST_PIXELS = 0.01, 30
"""A bin counts where it holds this share of the label's pixels, and this many: fewer say nothing about a quantile."""


class CurvePoint(NamedTuple):
    """One bin of the reliability curve; on the diagonal, error = sigma, it is honest."""

    sigma: float
    """Median declared sigma of the bin."""
    error: float
    """What `NORMAL_SHARE` of |log(D / true)| in the bin lies within."""
    pixels: int


@dataclass(frozen=True)
class PriorsBench(Settings):
    """Settings of `python -m benchmarks priors`."""

    recordings: Annotated[tuple[str, ...], Positional()] = ()
    """Folders of recordings with true depth; the rendered rig of four cameras if none is named."""
    rigs: tuple[str, ...] = ()
    """Rendered rooms to measure as well: synthetic2, synthetic3, synthetic4."""
    train_cameras: tuple[str, ...] = ()
    """Cameras that the prior is built for, in every recording that has them all; all cameras in the others."""
    frames: tuple[Count, ...] = ()
    """Numbers of the frames, in every recording; the first and the last with a true depth if none is named."""
    mono_onnx: str | None = None
    """ONNX model of monocular depth, for every recording; the maps beside the images if none is named."""
    mono_kind: Literal["relative", "metric"] | None = None
    """What the model returns."""
    width: Annotated[int, Range(32, unit="pixels")] = 320
    """Width of rendered images, which are 16:9, pixels."""
    threads: AtATime = 1
    """CPU threads."""
    output: Path = Path("runs.jsonl")
    """File that the rows are added to."""


class Case(NamedTuple):
    """A recording, cut to the frames that are measured."""

    name: str
    recording: Recording
    cameras: tuple[str, ...]


def run(settings: PriorsBench) -> str:
    """Measure and add the rows; a table per recording, and where the rows lie."""
    begin_rows(settings.output)
    torch.set_num_threads(settings.threads)
    command, shown_text = command_line("python -m benchmarks priors", settings), []
    prior_settings = PriorSettings(mono_onnx=settings.mono_onnx, mono_kind=settings.mono_kind)
    for case in cases(settings):
        found, seconds = measure(case, prior_settings)
        rows = rows_of(case, found, seconds, command)
        shown_text.append(f"{case.name}, {seconds:.2f} s per image, {found}")
        if case.recording.name in RENDERED:
            views = RENDERED[case.recording.name]
            motion = motion_errors(views, settings.width, ARCS[views], prior_settings)
            shown_text[-1] += f"\n{motion}"
            about: dict[str, Any] = {f"motion_{name}": float(value) for name, value in motion._asdict().items()}
            about |= {"seconds": seconds, "command": command}
            rows.append(make_row("priors", case.name, "motion", error=1 - motion.right, **about))
        append_rows(settings.output, rows)
        logger.info("the prior of %s is measured", case.name)
    return told([], settings.output, *shown_text)


def cases(settings: PriorsBench) -> list[Case]:
    """What is measured, opened and checked before anything is built.

    Raises:
        D2Error: a recording that is not there or has no true depth, an unknown rig, a camera that no recording has.
    """
    rigs = settings.rigs or (() if settings.recordings else tuple(RENDERED)[-1:])
    opened = [open_recording(path) for path in settings.recordings] + [_rendered(name, settings.width) for name in rigs]
    known = {camera for recording in opened for camera in recording.cameras}
    refuse_unknown("camera", settings.train_cameras, known)
    return [_case(recording, settings) for recording in opened]


def _rendered(name: str, width: int) -> Recording:
    """The room of `d2 demo`, with emulated maps, from as many cameras as the name says."""
    refuse_unknown("rig", [name], RENDERED)
    views, height = RENDERED[name], round(width * 9 / 16)
    room = synthetic_recording(views, 0, RENDERED_FRAMES, width, height, arc_degrees=ARCS[views])
    return replace(room, name=name)


def _case(recording: Recording, settings: PriorsBench) -> Case:
    wanted = settings.train_cameras
    cameras = wanted if wanted and set(wanted) <= recording.cameras.keys() else tuple(recording.cameras)
    known = frames_with_truth(recording, cameras)
    chosen = [frame for frame in settings.frames or (*known[:1], *known[1:][-1:]) if frame in known]
    if not known:
        raise D2Error(f"{recording.name} has no true depth, so no error is known: name recordings that have one")
    if not chosen:
        raise D2Error(
            f"{recording.name} has no true depth at {_listed(settings.frames)}: choose --frames from {_listed(known)}"
        )
    return Case(f"{recording.name}, {len(cameras)} views", replace(recording, frames=tuple(chosen)), cameras)


def _listed(frames: Sequence[int]) -> str:
    return f"frame{'s' if len(frames) > 1 else ''} {', '.join(map(str, frames[:8]))}"


def measure(case: Case, settings: PriorSettings) -> tuple[DeclaredErrors, float]:
    """How the prior compares with the truth, and the seconds that it takes per image."""
    points = triangulated_points(case.recording, case.cameras).positions
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        build_priors(case.recording, case.cameras, folder, settings, sparse_points=points)
        seconds = time.perf_counter() - start
        found = held_against_truth(PriorStore.open(folder), case.recording)
    if found is None:
        raise D2Error(f"no prior of {case.name} has both a sigma and a true depth: choose other cameras or frames")
    return found, seconds / (len(case.cameras) * len(case.recording.frames))


def rows_of(case: Case, found: DeclaredErrors, seconds: float, command: str = "") -> list[Row]:
    """A row per label that a pixel carries, and one about far pixels."""
    about: dict[str, Any] = {
        "command": command,
        "seconds": seconds,
        "cameras": list(case.cameras),
        "frames": list(case.recording.frames),
        "mono_emulated": case.recording.mono_emulated,
        "compared_views": found.views,
    }
    rows = [
        make_row(
            *("priors", case.name, label_name(label)),
            error=abs(held.within - NORMAL_SHARE),
            share=held.share,
            within=held.within,
            within_two=held.within_two,
            median_sigma=held.sigma,
            median_error=held.error,
            curve=[list(point) for point in reliability_curve(*held.pairs)],
            **about,
        )
        for label, held in found.labels.items()
    ]
    far: dict[str, Any] = {"sky_found": found.sky_found, "false_far": found.false_far}
    return [*rows, make_row("priors", case.name, "far", error=found.false_far, **far, **about)]


def reliability_curve(error: np.ndarray, sigma: np.ndarray) -> tuple[CurvePoint, ...]:
    """True against declared error in logarithmic bins of the declared one; the bins' edges are 10^(k / 4).

    Args:
        error: |log(D / true)| [K].
        sigma: declared relative standard deviation [K]. A sigma of 0 has no place on a logarithmic axis.

    Returns:
        The bins that hold pixels enough, by ascending sigma.
    """
    error, sigma = error[sigma > 0], sigma[sigma > 0]
    bins = np.floor(BINS_PER_DECADE * np.log10(sigma)).astype(int)
    least = max(LEAST_PIXELS, LEAST_SHARE * sigma.size)
    inside = [bins == place for place, pixels in zip(*np.unique(bins, return_counts=True)) if pixels >= least]
    return tuple(
        CurvePoint(float(np.median(sigma[mask])), float(np.quantile(error[mask], NORMAL_SHARE)), int(mask.sum()))
        for mask in inside
    )
