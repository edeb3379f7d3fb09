"""Gaussians on straight lines in the formats of existing players: `.splatv` and `.ftgs.ply`.

Both take time as 0..1 of the clip, so with a clip of T seconds: mu' = mu / T, sigma' = sigma / T, v' = v T.
`.splatv` (antimatter15/splaTV, gsplat.js): F = exp(-(dt / s)^2), s = sqrt(2) sigma', positions in 32-bit floats,
all else in 16-bit floats, one colour for every direction. `.ftgs.ply`: 3DGS columns with time, ln sigma' and v', all in
32-bit floats. Neither knows colours that change in time: each Gaussian gets that of its mean time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from d2_plugin.durable import write
from d2_plugin.errors import D2Error
from d2_plugin.gaussians.moving import Harmonics, LinearMotion, MovingGaussians
from d2_plugin.gaussians.spherical_harmonics import SH_C0
from d2_plugin.reading import json_text
from d2_plugin.recordings import Camera
from d2_plugin.runs.gaussian_ply import scales_and_rotations, write_ply
from d2_plugin.viewing.export.ply_files import covariances_from, read_columns, still_gaussians

SPLATV_MAGIC, SPLATV_WIDTH = 0x674B, 4096
FTGS_NAMES = ("time", "log_duration", "velocity_0", "velocity_1", "velocity_2")
FOREVER = 1e4
"""sigma' of a Gaussian that stands still and never fades: F differs from 1 by less than 1e-8; a half float holds it."""
SPLATV_ROW = np.dtype(
    [
        ("position", "<f4", 3),
        ("rotation", "<f2", 4),
        ("scale", "<f2", 3),
        ("spare", "<f2"),
        ("color", "u1", 4),
        ("motion", "<f2", 10),
        ("turning", "<f2", 4),
        ("fading", "<f2", 2),
    ]
)
"""64 bytes; x + m1 dt + m2 dt^2 + m3 dt^3 with m1 = motion[:3] and so on, the tenth not used."""


def write_splatv(
    path: Path,
    gaussians: MovingGaussians,
    duration: float,
    cameras: Sequence[Camera],
    bends: torch.Tensor | None = None,
) -> None:
    """Write the moving Gaussians as `.splatv`; `bends` [N, 2, 3] are m2 and m3 per clip, none if not given."""
    motion, span = _motion(gaussians), duration or 1.0
    rows = np.zeros(len(gaussians), SPLATV_ROW)
    scales, rotations = scales_and_rotations(gaussians.covariances)
    colors = SH_C0 * gaussians.harmonics.without_time()[:, 0] + 0.5
    shown = torch.cat([colors, gaussians.opacities[:, None]], 1)
    rows["position"], rows["rotation"], rows["scale"] = gaussians.positions, rotations, _half(scales.numpy())
    rows["color"] = np.clip(np.rint(shown.numpy() * 255), 0, 255)
    rows["motion"][:, :3] = _half((motion.velocities * span).numpy())
    if bends is not None:
        rows["motion"][:, 3:9] = _half(bends.flatten(1).numpy())
    widths = (math.sqrt(2) * motion.sigmas / span).clamp(6.2e-5, 6.5e4)  # the normal numbers among half floats
    rows["fading"] = _half(torch.stack([motion.times / span, widths], -1).numpy())
    texels = 4 * len(rows)
    height = max(-(-texels // SPLATV_WIDTH), 1)
    data = _words(rows).tobytes().ljust(16 * SPLATV_WIDTH * height, b"\0")
    chunk = {"type": "splat", "size": len(data), "texwidth": SPLATV_WIDTH, "texheight": height}
    described = [chunk | {"cameras": [_splatv_camera(i, camera) for i, camera in enumerate(cameras)]}]
    text = json_text(described, path.name).encode()
    write(path, np.array([SPLATV_MAGIC, len(text)], "<u4").tobytes(), text, data)


def read_splatv(path: Path, duration: float) -> MovingGaussians:
    """Read what `write_splatv` wrote; rows of padding, which have no opacity, are left out."""
    data = path.read_bytes()
    magic, length = np.frombuffer(data[:8], "<u4")
    if magic != SPLATV_MAGIC:
        raise D2Error(f"{path} is no .splatv file: it begins with {int(magic):#x}, expected {SPLATV_MAGIC:#x}")
    words = np.frombuffer(data[8 + int(length) :], "<u4").reshape(-1, 16)
    rows = _rows(words)
    rows = rows[rows["color"][:, 3] > 0]
    span = duration or 1.0
    parts = {name: torch.from_numpy(rows[name].astype(np.float64)) for name in rows.dtype.names or ()}
    times, widths = parts["fading"].unbind(-1)
    motion = LinearMotion(parts["motion"][:, :3] / span, times * span, widths * span / math.sqrt(2))
    coefficients = ((parts["color"][:, None, :3] / 255) - 0.5) / SH_C0
    covariances = covariances_from(parts["scale"], parts["rotation"])
    return MovingGaussians(
        parts["position"], covariances, parts["color"][:, 3] / 255, Harmonics(coefficients, 0), motion
    )


def write_ftgs(path: Path, gaussians: MovingGaussians, duration: float, frames: int) -> None:
    """Write the moving Gaussians as `.ftgs.ply`."""
    motion, span = _motion(gaussians), duration or 1.0
    coefficients = gaussians.harmonics.without_time()
    widths = (motion.sigmas / span).clamp(min=1e-12)
    columns = (motion.times / span, widths.log(), *(motion.velocities * span).unbind(-1))
    # A least width or opacity of the format would widen what is short and show what has faded.
    least = min(float(widths.min()), 1.0) if len(widths) else 1.0
    comments = ["ftgs_version 1", "time_units normalized", f"sh_degree {gaussians.harmonics.degree}", "use_velocity 1"]
    comments += [f"min_duration {least:.9g}", "opacity_floor 0", f"n_frames {frames}"]
    colors = SH_C0 * coefficients[:, 0] + 0.5
    parts = (gaussians.positions, gaussians.covariances, colors, gaussians.opacities, coefficients[:, 1:])
    write_ply(path, *parts, dict(zip(FTGS_NAMES, columns)), comments)


def read_ftgs(path: Path, duration: float) -> MovingGaussians:
    """Read what `write_ftgs` wrote."""
    columns = read_columns(path)
    if "log_duration" not in columns:
        raise D2Error(f"{path} has no column log_duration: it is no .ftgs.ply file")
    still, span = still_gaussians(columns), duration or 1.0
    times, widths, *velocity = (torch.from_numpy(columns[name].astype(np.float64)) for name in FTGS_NAMES)
    motion = LinearMotion(torch.stack(velocity, -1) / span, times * span, widths.exp() * span)
    return MovingGaussians(still.positions, still.covariances, still.opacities, still.harmonics, motion)


def _motion(gaussians: MovingGaussians) -> LinearMotion:
    """The motion, or that of Gaussians which stand still for ever."""
    if gaussians.motion is not None:
        return gaussians.motion
    count = len(gaussians)
    return LinearMotion(
        torch.zeros(count, 3).double(), torch.zeros(count).double(), torch.full((count,), FOREVER).double()
    )


def _half(values: np.ndarray) -> np.ndarray:
    return np.clip(values, -65504, 65504).astype("<f2")


def _words(rows: np.ndarray) -> np.ndarray:
    """The 16 words of 32 bits of each row."""
    return np.frombuffer(rows.tobytes(), "<u4").reshape(len(rows), 16)


def _rows(words: np.ndarray) -> np.ndarray:
    return np.frombuffer(words.tobytes(), SPLATV_ROW)


def _splatv_camera(index: int, camera: Camera) -> dict[str, Any]:
    """As cameras.json of 3D Gaussian Splatting has it: the rotation from camera to world."""
    rotation = camera.T_camera_world[:3, :3].T
    return {
        "id": index,
        "img_name": camera.name,
        "width": camera.width,
        "height": camera.height,
        "position": camera.centre.tolist(),
        "rotation": rotation.tolist(),
        "fx": float(camera.K[0, 0]),
        "fy": float(camera.K[1, 1]),
    }
