"""A moving scene as `.4dgs` (4dgs.dev), through the package `fourdgs`, which states and checks its own error bounds.

Seconds, sRGB, linear scales, quaternions with w last; our axes are right, down, forward.
"""

from __future__ import annotations

import io
import math
from pathlib import Path

import torch

from d2_plugin.durable import write
from d2_plugin.errors import D2Error
from d2_plugin.extras import imported
from d2_plugin.gaussians.moving import LinearMotion
from d2_plugin.gaussians.slicing import MARGINAL_CUT
from d2_plugin.gaussians.spherical_harmonics import SH_C0
from d2_plugin.values import counted
from d2_plugin.viewing.export.coded import seen_rows
from d2_plugin.viewing.export.ply import scales_and_rotations
from d2_plugin.viewing.export.scene import ExportScene

SH_LOW, SH_SPAN = -4.0, 8.0
"""The format's range of harmonics above the constant one, in bytes."""


def write_4dgs(scene: ExportScene, path: Path) -> list[str]:
    """Write the scene; returns what a person should know about it.

    Raises:
        MissingExtra: the package is not installed.
        D2Error: no straight lines.
    """
    package = imported("fourdgs", "fourdgs", "formats", "writing .4dgs")
    notes = [f"written by fourdgs {package.__version__}, which checks the file against its own error bounds"]
    if scene.moving is None:
        raise D2Error("a .4dgs holds straight lines, this model moves by a network: choose --format html or ply")
    shown = scene.moving.select(seen_rows(scene.moving, scene.viewed.duration))
    always = torch.zeros_like(shown.opacities)
    motion = shown.motion or LinearMotion(torch.zeros_like(shown.positions), always, always + math.inf)
    scales, rotations = scales_and_rotations(shown.covariances)
    coefficients, count = shown.harmonics.without_time(), len(shown)
    colors = torch.cat([(SH_C0 * coefficients[:, 0] + 0.5).clamp(0, 1), shown.opacities[:, None]], 1)
    codes = ((coefficients[:, 1:] - SH_LOW) * (255 / SH_SPAN)).round().clamp(0, 255)
    arrays = (shown.positions, scales, rotations[:, [1, 2, 3, 0]], colors, *motion)
    gaussians = package.GaussianSet(
        *(part.float().numpy() for part in arrays),
        *((always + end).numpy() for end in (0.0, math.inf)),
        sh=codes.flatten(1).byte().numpy() if codes.shape[1] else None,
        sh_degree=shown.harmonics.degree,
    )
    options = package.WriteOptions("fine", MARGINAL_CUT, metadata={"color_space": "srgb-rec709-display"})
    content = io.BytesIO()
    package.write(content, gaussians, max(scene.viewed.duration, 1e-6), options=options)
    write(path, content.getvalue())
    return [*notes, f"{counted(count, 'Gaussian', ',')}; colours stand still, as they are at each one's mean time"]
