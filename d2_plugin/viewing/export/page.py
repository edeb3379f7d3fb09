"""One HTML file that plays the moving scene without a network: data, player and worker stand in it as text."""

from __future__ import annotations

import base64
import html
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
import torch

import d2_plugin
from d2_plugin.durable import write_text
from d2_plugin.gaussians.slicing import MARGINAL_CUT
from d2_plugin.gaussians.spherical_harmonics import colors
from d2_plugin.reading import json_text
from d2_plugin.recordings import Camera
from d2_plugin.runs.drawing import color_scale
from d2_plugin.viewing.export.coded import BLOCK, MARGINAL_REACH, CodedScene, code_keys, code_lines, packed
from d2_plugin.viewing.export.keys import SAMPLE, bake
from d2_plugin.viewing.export.scene import ExportScene

GENERATOR = "d2-4dgs"
TEXT_PER_BYTE = 4 / 3
"""Base64."""
BYTES_AT_REST, BYTES_OF_POSITION, BYTES_OF_SHAPE = 28, 6, 16
"""Per Gaussian, with 16-bit codes and before compression, without harmonics."""
RASTER = ("near", "blur", "alpha_max", "alpha_min", "fov_clamp")
"""Settings of the rasterizer that the player's shaders obey."""
PAGE_SCRIPTS = ("scene.js", "shaders.js", "renderer.js", "controls.js", "pace.js", "player.js")
WORKER_SCRIPTS = ("scene.js", "sorter.js")


def write_page(scene: ExportScene, path: Path, megabytes: float = 40.0) -> list[str]:
    """Write the page in about `megabytes`; returns what the page says of itself.

    Straight lines round their harmonics to fit if need be, any other scene is baked at as many key times as fit.
    """
    coded = _coded(scene, megabytes)
    contents, data = packed(coded.arrays)
    about = _about(scene, coded)
    write_text(path, _assembled(scene.name, _header(scene, coded) | {"arrays": contents, "about": about}, data))
    return about


def _coded(scene: ExportScene, megabytes: float) -> CodedScene:
    most_bytes = (megabytes * 1e6 - len(_assembled("", {}, b""))) / TEXT_PER_BYTE
    if scene.moving is not None:
        return code_lines(scene.moving, scene.duration, most_bytes)
    coefficients = scene.harmonics.coefficients
    at_rest = len(coefficients) * (BYTES_AT_REST + 3 * (coefficients.shape[1] - 1))

    def most_keys(moving: int, changing: int) -> int:
        each = moving * BYTES_OF_POSITION + changing * BYTES_OF_SHAPE
        return max(int((most_bytes - at_rest) / max(1.05 * each, 1)), 2)

    return code_keys(bake(scene, most_keys), scene.harmonics)


def _about(scene: ExportScene, coded: CodedScene) -> list[str]:
    count, keys = len(scene.frames), coded.keys
    lines = [f"{len(coded.rows):,} Gaussians, {count} frame{'s' * (count > 1)} at {scene.fps:g} per second"]
    bits = {array.name: array.bits for array in coded.arrays}.get("harmonics", 8)
    if bits < 8:
        off = _color_error(scene, coded)
        lines.append(
            f"harmonics in {bits} bits, so that the page is no larger: colours off by {off:.1f} of 255 in the mean"
        )
    if keys is not None:
        lines.append(
            f"a deformation field at {len(keys.times)} key times, straight in between: off by {keys.offset}; "
            f"{keys.moving:,} Gaussians move, {keys.changing:,} of them change their shape"
        )
    elif coded.motion == "lines":
        lines.append("every Gaussian moves on a straight line and fades in time, exactly as it was trained")
    if scene.background is not None:
        lines.append("behind the Gaussians the learnt background, in every direction; its colours are not rounded")
    return [*lines, f"made by d2-4dgs {d2_plugin.__version__}; no network is used"]


def _color_error(scene: ExportScene, coded: CodedScene) -> float:
    """Mean difference of the colours that the first training camera sees, of 255; of up to `SAMPLE` Gaussians."""
    assert scene.moving is not None
    every = -(-len(coded.rows) // SAMPLE)
    [decoded] = [array.decoded for array in coded.arrays if array.decoded is not None and array.name == "harmonics"]
    true = coded.harmonics.coefficients[::every]
    rounded = torch.cat([true[:, :1], decoded[::every].unflatten(1, (-1, 3))], 1)
    toward = scene.moving.positions[coded.rows[::every]] - torch.as_tensor(scene.train_cameras[0].centre)
    phase = torch.zeros(len(true)).double()
    degrees = coded.harmonics.degree, coded.harmonics.time_degree
    seen = [colors(part, toward, phase, *degrees) for part in (true, rounded)]
    return 255 * float((seen[0] - seen[1]).abs().mean())


def _header(scene: ExportScene, coded: CodedScene) -> dict[str, Any]:
    raster, keys = scene.raster, coded.keys
    return {
        "count": len(coded.rows),
        "motion": coded.motion,
        "keys": None if keys is None else {"times": keys.times, "moving": keys.moving, "changing": keys.changing},
        "degree": coded.harmonics.degree,
        "time_degree": coded.harmonics.time_degree,
        "name": scene.name,
        "block": BLOCK,
        "frames": scene.frames,
        "seconds": scene.seconds,
        "duration": scene.duration,
        "fps": scene.fps,
        "marginal_cut": MARGINAL_CUT,
        "marginal_reach": MARGINAL_REACH,
        "raster": {name: min(getattr(raster, name), 1e6) for name in RASTER},
        "cameras": [
            *(_camera(camera, held_out=False) for camera in scene.train_cameras),
            *(_camera(camera, held_out=True) for camera in scene.test_cameras),
        ],
        "background": None if scene.background is None else scene.background.tolist(),
        "palette": color_scale("viridis").tobytes().hex(),
        **scene.outlook(),
    }


def _camera(camera: Camera, held_out: bool) -> dict[str, Any]:
    pose, K = np.asarray(camera.T_camera_world, float), np.asarray(camera.K, float)
    return {
        "name": camera.name,
        "held_out": held_out,
        "width": camera.width,
        "height": camera.height,
        "focal": [K[0, 0], K[1, 1]],
        "principal": [K[0, 2], K[1, 2]],
        "rotation": pose[:3, :3].flatten().tolist(),
        "translation": pose[:3, 3].tolist(),
    }


def _assembled(name: str, header: dict[str, Any], data: bytes) -> str:
    return Template(_text_of("page.html")).substitute(
        title=html.escape(name),
        generator=html.escape(f"{GENERATOR} {d2_plugin.__version__}"),
        style=_text_of("style.css"),
        header=to_json(header),
        data=base64.b64encode(data).decode("ascii"),
        worker=_text_of(*WORKER_SCRIPTS),
        script=_text_of(*PAGE_SCRIPTS),
    )


def _text_of(*names: str) -> str:
    return "\n".join((files(__package__) / "player" / name).read_text(encoding="utf-8") for name in names)


def to_json(table: Any) -> str:
    """JSON that may stand inside an HTML <script>: no '<', so no name in it can close the element or open one."""
    text = json_text(table, "the page", separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
