"""`d2 export-capture`: a recording in the input layout of another repository, with points to start from."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from d2_plugin.captures import Capture, open_capture, select_cameras
from d2_plugin.captures.export.export import export_capture
from d2_plugin.captures.export.ply import PointCloud
from d2_plugin.runs.start import MIN_POINTS, initial_points, scene_extent, triangulated_points

FORMATS = ("transforms", "n3dv", "multipleview", "colmap")


def main(arguments: Sequence[str]) -> None:
    """Run `d2 export-capture CAPTURE --format F --output DIR`."""
    options = _parser().parse_args(arguments)
    capture = open_capture(options.capture, frames=options.frames, downscale=options.downscale)
    train = options.train_cameras or tuple(name for name in capture.cameras if name not in options.test_cameras)
    capture = select_cameras(capture, [*train, *(name for name in options.test_cameras if name not in train)])
    cloud = start_cloud(capture, train, options.points, options.seed) if options.points > 0 else None
    export_capture(capture, options.format, options.output, test_cameras=options.test_cameras, cloud=cloud)
    points = "no" if cloud is None else len(cloud.positions)
    written = f"{len(capture.cameras)} cameras, {len(capture.frames)} frames, {points} initial points"
    sys.stdout.write(f"{written} in {options.output} ({options.format})\n")


def start_cloud(capture: Capture, cameras: Sequence[str], minimum: int = MIN_POINTS, seed: int = 0) -> PointCloud:
    """Points triangulated from the training cameras, filled up to `minimum` with random ones in what they see.

    The same start as `d2 train` has, so that another repository can be compared with the bundled backbones.
    """
    sparse = triangulated_points(capture, cameras)
    extent = scene_extent(capture, cameras, sparse.positions)
    start = initial_points(capture, cameras, sparse, extent, seed, minimum)
    return PointCloud(start.positions, start.colors, start.times)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="d2 export-capture",
        description="Write a recording in the input layout of another 4D Gaussian Splatting repository.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("capture", type=Path, help="folder of the recording, in any layout that d2 reads")
    parser.add_argument("--format", choices=FORMATS, required=True, help="layout to write; see docs/attach")
    parser.add_argument("--output", type=Path, required=True, help="folder that does not exist or is empty")
    parser.add_argument("--train-cameras", type=_names, default=(), help="joined by commas; default all not held out")
    parser.add_argument("--test-cameras", type=_names, default=(), help="held out, joined by commas")
    parser.add_argument("--frames", type=_frames, default=None, help="first:last or first:last:step; default all")
    parser.add_argument("--downscale", type=int, default=1, help="every block of so many by so many pixels becomes one")
    parser.add_argument("--points", type=int, default=MIN_POINTS, help="least number of initial points; 0 writes none")
    parser.add_argument("--seed", type=int, default=0, help="of the random points among them")
    return parser


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())


def _frames(text: str) -> tuple[int, ...]:
    try:
        first, last, *step = (int(part) for part in text.split(":"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is not first:last or first:last:step") from None
    return tuple(range(first, last + 1, *step))
