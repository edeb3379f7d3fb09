"""Point clouds as the PLY files that Gaussian Splatting trainers start from."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.recordings.images import color_bytes


class PointCloud(NamedTuple):
    """Where Gaussians start."""

    positions: np.ndarray  # [P, 3] world
    colors: np.ndarray  # [P, 3] in 0..1
    times: np.ndarray | None = None  # [P] in the unit of the trainer's cameras

    def check(self) -> None:
        """Raise `D2Error` for arrays that do not fit together or numbers that are not finite."""
        count = len(self.positions)
        expected = [(count, 3), (count, 3)] + ([] if self.times is None else [(count,)])
        parts = [self.positions, self.colors] + ([] if self.times is None else [self.times])
        shapes = [np.shape(part) for part in parts]
        if shapes != expected:
            raise D2Error(f"the initial points have shapes {shapes}, expected {expected}: give a row for each point")
        if not all(np.isfinite(part).all() for part in parts):
            raise D2Error("the initial points have numbers that are not finite: leave those points out")


_NORMALS = ("nx", "ny", "nz")
_CHANNELS = ("red", "green", "blue", "alpha")


def write_point_cloud(path: Path, cloud: PointCloud) -> None:
    """Write `cloud` as binary PLY: x y z nx ny nz (float), red green blue alpha (uchar) and, where it has times, time.

    These are the properties that the Inria family's `fetchPly` asks for; normals are zero, as in its own `storePly`.
    fudan-zvg/4d-gaussian-splatting reads `time` and makes a tensor of that column without a copy, which takes records
    of a whole number of floats: hence alpha. The others ignore both.
    """
    count = len(cloud.positions)
    layout = [(axis, "<f4") for axis in ("x", "y", "z", *_NORMALS)] + [(c, "u1") for c in _CHANNELS]
    layout += [("time", "<f4")] if cloud.times is not None else []
    rows = np.zeros(count, layout)
    for axis, values in zip("xyz", np.asarray(cloud.positions).T):
        rows[axis] = values
    for channel, values in zip(_CHANNELS, color_bytes(cloud.colors).T):
        rows[channel] = values
    rows["alpha"] = 255
    if cloud.times is not None:
        rows["time"] = cloud.times
    kinds = {"<f4": "float", "u1": "uchar"}
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    lines += [f"property {kinds[kind]} {name}" for name, kind in layout]
    path.write_bytes(("\n".join([*lines, "end_header"]) + "\n").encode() + rows.tobytes())
