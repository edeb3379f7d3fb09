"""A moving scene as `.splatv`, for splaTV (antimatter15) and gsplat.js.

Time is 0..1 of the clip: with a clip of T seconds mu' = mu / T, sigma' = sigma / T, v' = v T. Each Gaussian moves on
a cubic curve and fades by F = exp(-(dt / s)^2), s = sqrt(2) sigma'. Positions are 32-bit floats, all else 16-bit
floats, with one colour for every direction. Colours cannot change in time: each Gaussian gets that of its mean time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from d2_plugin.durable import write
from d2_plugin.gaussians.moving import LinearMotion, MovingGaussians
from d2_plugin.gaussians.spherical_harmonics import SH_C0
from d2_plugin.reading import json_text
from d2_plugin.recordings import Camera
from d2_plugin.viewing.export.keys import Offset, covariances_of, distance, state_at
from d2_plugin.viewing.export.ply import ALPHA_MIN, scales_and_rotations
from d2_plugin.viewing.export.scene import ExportScene

MAGIC, TEXELS_A_ROW = 0x674B, 4096
FOREVER = 1e4
"""sigma' of a Gaussian that never fades: F differs from 1 by less than 1e-8; a half float holds it."""
INSTANTS = 24
"""At most so many frames, spread over the clip, are fitted by curves."""
ROW = np.dtype(
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


class Curves(NamedTuple):
    """x(u) = position + velocity T u + bends[:, 0] u^2 + bends[:, 1] u^3 with u = t / T - 1/2."""

    gaussians: MovingGaussians
    bends: Tensor  # [N, 2, 3]
    offset: Offset  # how far off the curves are


def write_splatv(
    path: Path, gaussians: MovingGaussians, duration: float, cameras: Sequence[Camera], bends: Tensor | None = None
) -> None:
    """Write the moving Gaussians; `bends` [N, 2, 3] are m2 and m3 per clip, none if not given."""
    count, span, motion = len(gaussians), duration or 1.0, gaussians.motion
    if motion is None:
        zeros = torch.zeros(count, 3).double()
        motion = LinearMotion(zeros, zeros[:, 0], torch.full((count,), FOREVER).double())
    rows = np.zeros(count, ROW)
    scales, rotations = scales_and_rotations(gaussians.covariances)
    colors = SH_C0 * gaussians.harmonics.without_time()[:, 0] + 0.5
    shown = torch.cat([colors, gaussians.opacities[:, None]], 1)
    rows["position"], rows["rotation"], rows["scale"] = gaussians.positions, rotations, _half(scales)
    rows["color"] = np.clip(np.rint(shown.numpy() * 255), 0, 255)
    rows["motion"][:, :3] = _half(motion.velocities * span)
    if bends is not None:
        rows["motion"][:, 3:9] = _half(bends.flatten(1))
    widths = (math.sqrt(2) * motion.sigmas / span).clamp(6.2e-5, 6.5e4)  # the normal numbers among half floats
    rows["fading"] = _half(torch.stack([motion.times / span, widths], -1))
    height = max(-(-4 * count // TEXELS_A_ROW), 1)
    data = rows.tobytes().ljust(16 * TEXELS_A_ROW * height, b"\0")
    chunk = {"type": "splat", "size": len(data), "texwidth": TEXELS_A_ROW, "texheight": height}
    described = [chunk | {"cameras": [_camera(i, camera) for i, camera in enumerate(cameras)]}]
    text = json_text(described, path.name).encode()
    write(path, np.array([MAGIC, len(text)], "<u4").tobytes(), text, data)


def fit_curves(scene: ExportScene) -> Curves:
    """One cubic curve for each Gaussian of any model, by least squares over the frames.

    Shape and opacity are the means over the frames in which a Gaussian is drawn.
    """
    times = scene.seconds[:: -(-len(scene.seconds) // INSTANTS)]
    span = scene.duration or 1.0
    states = [state_at(scene, times[0])]
    for time in times[1:]:
        states.append(state_at(scene, time, states[-1]))
    opacities = torch.stack([state.opacities for state in states])
    kept = (opacities.amax(0) >= ALPHA_MIN).nonzero()[:, 0]
    states = [state.select(kept) for state in states]
    powers = torch.tensor([[(time / span - 0.5) ** k for k in range(4)] for time in times]).double()[:, : len(times)]
    paths = torch.stack([state.positions for state in states])
    fitted = torch.linalg.lstsq(powers, paths.flatten(1)).solution.unflatten(1, (len(kept), 3))
    fitted = torch.cat([fitted, fitted.new_zeros(4 - len(fitted), len(kept), 3)])
    weights = opacities[:, kept] / opacities[:, kept].sum(0)
    factors = sum(weight[:, None] * state.factors for weight, state in zip(weights, states))
    off = torch.zeros(len(kept)).double()
    for row, state in zip(powers, states):
        on_curve = torch.einsum("k,knc->nc", row, fitted[: len(row)])
        apart = distance(torch.cat([on_curve, factors], 1), torch.cat(state[:2], 1))
        pixels = apart * scene.pixels_per_unit(on_curve)
        off = torch.maximum(off, torch.where(state.opacities >= ALPHA_MIN, pixels, 0))
    middle = torch.full((len(kept),), span / 2).double()
    motion = LinearMotion(fitted[1] / span, middle, torch.full_like(middle, FOREVER * span))
    harmonics = scene.harmonics._replace(coefficients=scene.harmonics.coefficients[kept])
    shown = MovingGaussians(fitted[0], covariances_of(factors), opacities[:, kept].mean(0), harmonics, motion)
    return Curves(shown, fitted[2:].transpose(0, 1).contiguous(), Offset.of(off))


def _half(values: Tensor) -> np.ndarray:
    return np.clip(values.numpy(), -65504, 65504).astype("<f2")


def _camera(index: int, camera: Camera) -> dict[str, Any]:
    """As cameras.json of 3D Gaussian Splatting has it: the rotation from camera to world."""
    return {
        "id": index,
        "img_name": camera.name,
        "width": camera.width,
        "height": camera.height,
        "position": camera.centre.tolist(),
        "rotation": camera.T_camera_world[:3, :3].T.tolist(),
        "fx": float(camera.K[0, 0]),
        "fy": float(camera.K[1, 1]),
    }
