"""A moving scene as `.4dgs` (4dgs.dev), through the package `fourdgs`, which states and checks its own error bounds.

Seconds, sRGB, linear scales, quaternions with w last; our axes are right, down, forward. A deformation field becomes
straight lines from key to key: each Gaussian that moves is written once for each interval, with the interval as its
window, and keeps the shape and the opacity of its middle.
"""

from __future__ import annotations

import io
import itertools
import math
from pathlib import Path
from types import ModuleType

import torch
from torch import Tensor

from d2_plugin.durable import write
from d2_plugin.errors import missing_extra
from d2_plugin.gaussians.moving import LinearMotion, MovingGaussians
from d2_plugin.gaussians.slicing import MARGINAL_CUT
from d2_plugin.gaussians.spherical_harmonics import SH_C0
from d2_plugin.viewing.export.coded import seen_rows
from d2_plugin.viewing.export.keys import Keys, bake, covariances_of
from d2_plugin.viewing.export.ply import scales_and_rotations
from d2_plugin.viewing.export.scene import ExportScene

SH_LOW, SH_SPAN = -4.0, 8.0
"""The format's range of harmonics above the constant one, in bytes."""
MOST_KEYS = 32
"""Of a deformation field."""


def write_4dgs(scene: ExportScene, path: Path) -> list[str]:
    """Write the scene; returns what a person should know about it.

    Raises:
        MissingExtra: the package is not installed.
    """
    package = _package()
    notes = [f"written by fourdgs {package.__version__}, which checks the file against its own error bounds"]
    if scene.moving is not None:
        shown = scene.moving.select(seen_rows(scene.moving, scene.duration))
        windows = torch.tensor([0.0, math.inf]).double().expand(len(shown), 2)
    else:
        keys = bake(scene, lambda moving, changing: MOST_KEYS)
        shown, windows = _pieces(scene, keys)
        notes.append(f"a deformation field at {len(keys.times)} key times, straight in between: off by {keys.offset}")
    motion = shown.motion or LinearMotion(
        torch.zeros_like(shown.positions), shown.opacities * 0, torch.full_like(shown.opacities, torch.inf)
    )
    scales, rotations = scales_and_rotations(shown.covariances)
    coefficients, count = shown.harmonics.without_time(), len(shown)
    colors = torch.cat([(SH_C0 * coefficients[:, 0] + 0.5).clamp(0, 1), shown.opacities[:, None]], 1)
    codes = ((coefficients[:, 1:] - SH_LOW) * (255 / SH_SPAN)).round().clamp(0, 255)
    arrays = (shown.positions, scales, rotations[:, [1, 2, 3, 0]], colors, *motion)
    gaussians = package.GaussianSet(
        *(part.float().numpy() for part in arrays),
        *windows.numpy().T.copy(),
        sh=codes.flatten(1).byte().numpy() if codes.shape[1] else None,
        sh_degree=shown.harmonics.degree,
    )
    options = package.WriteOptions(cutoff=MARGINAL_CUT, metadata={"color_space": "srgb-rec709-display"})
    content = io.BytesIO()
    package.write(content, gaussians, max(scene.duration, 1e-6), options=options)
    write(path, content.getvalue())
    return [*notes, f"{count:,} Gaussians; colours stand still, as they are at each one's mean time"]


def _pieces(scene: ExportScene, keys: Keys) -> tuple[MovingGaussians, Tensor]:
    """Straight lines between keys, and the window [N, 2] in which each is seen; what stands still is there once."""
    parts, windows = [], []
    spans = list(itertools.pairwise(keys.times)) or [(keys.times[0], keys.times[0] + 1)]
    coefficients = scene.harmonics.coefficients[keys.rows]
    for i, (begin, end) in enumerate(spans):
        first, last, rows = keys.at(begin), keys.at(end), slice(None if i == 0 else keys.moving)
        middle = keys.at((begin + end) / 2)
        velocities = (last.positions - first.positions) / (end - begin)
        parts.append((first.positions, covariances_of(middle.factors), middle.opacities, velocities, coefficients))
        parts[-1] = tuple(part[rows] for part in parts[-1])
        windows.append(
            torch.tensor([begin, end if i + 1 < len(spans) else math.inf]).double().repeat(len(parts[-1][0]), 1)
        )
        windows[-1][keys.moving :] = torch.tensor([0, math.inf]).double()
    positions, covariances, opacities, velocities, coefficients = (torch.cat(part) for part in zip(*parts))
    window = torch.cat(windows)
    motion = LinearMotion(velocities, window[:, 0], torch.full_like(opacities, math.inf))
    harmonics = scene.harmonics._replace(coefficients=coefficients)
    return MovingGaussians(positions, covariances, opacities, harmonics, motion), window


def _package() -> ModuleType:
    try:
        import fourdgs
    except ImportError:
        raise missing_extra("fourdgs", "formats", "writing .4dgs") from None
    return fourdgs
