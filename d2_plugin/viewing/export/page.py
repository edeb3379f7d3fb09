"""One HTML file that plays the moving scene without a network: data, player and worker stand in it as text."""

from __future__ import annotations

import base64
import html
import re
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any, NamedTuple

import numpy as np
import torch

import d2_plugin
from d2_plugin.durable import write_text
from d2_plugin.errors import D2Error
from d2_plugin.gaussians.slicing import MARGINAL_CUT
from d2_plugin.gaussians.spherical_harmonics import colors
from d2_plugin.reading import parse_json, parsing, read_text
from d2_plugin.recordings import Camera
from d2_plugin.runs.drawing import color_scale
from d2_plugin.values import checked_arguments, shown
from d2_plugin.viewing.export.coded_scene import (
    MARGINAL_REACH,
    CodedScene,
    code_keys,
    code_lines,
    read_harmonics,
    read_state,
)
from d2_plugin.viewing.export.codes import BLOCK, decode, packed, to_json, unpacked
from d2_plugin.viewing.export.keys import SAMPLE, Keys, Offset, State, bake
from d2_plugin.viewing.export.outlook import look_around
from d2_plugin.viewing.export.rounding import rounding, states_of
from d2_plugin.viewing.export.scene import ExportScene

VERSION = 1
EXPORT = "export it anew"
MOST_PAGE = 1 << 31
"""Bytes of a page, at most."""
TEXT_PER_BYTE = 4 / 3
"""Base64."""
BYTES_AT_REST, BYTES_OF_POSITION, BYTES_OF_SHAPE = 28, 6, 16
"""Per Gaussian, with 16-bit codes and before compression, without harmonics."""
PAGE_SCRIPTS = ("scene.js", "shaders.js", "renderer.js", "controls.js", "pace.js", "player.js")
WORKER_SCRIPTS = ("scene.js", "sorter.js")


class Page(NamedTuple):
    """What was written, and what it says of itself."""

    size: int
    about: tuple[str, ...]


def write_page(scene: ExportScene, path: Path, megabytes: float = 40.0) -> Page:
    """Write the page in about `megabytes`: straight lines round their harmonics to fit if need be, any other scene is
    baked at as many key times as fit."""
    coded, keys = _coded(scene, megabytes)
    contents, data = packed(coded.arrays)
    # What a reader of this data finds; harmonics are large and do not move.
    arrays = unpacked(contents, data, without=("harmonics",))
    about = _about(scene, coded, keys, _rounding(scene, coded, keys, arrays))
    header = _header(scene, coded) | {"arrays": contents, "about": about}
    write_text(path, _assembled(scene.name, header, data))
    return Page(path.stat().st_size, tuple(about))


class ReadPage(NamedTuple):
    """The scene of a page, read back."""

    header: dict[str, Any]
    arrays: dict[str, np.ndarray]

    def at(self, time: float) -> State:
        """The Gaussians that the player draws at `time`, opacity 0 for those that it does not draw."""
        return read_state(self.arrays, self.header, self.header["duration"], time)

    @property
    def coefficients(self) -> torch.Tensor:
        """Of the colours, [N, C, 3]."""
        return read_harmonics(self.arrays, self.header).coefficients


@checked_arguments
def read_page(path: Path) -> ReadPage:
    """Read what `write_page` wrote.

    Raises:
        D2Error: the file is no such page, or one of another version.
    """
    text = read_text(path, EXPORT, MOST_PAGE)
    found = [re.search(rf'<script id="{name}" type="[^"]*">(.*?)</script>', text, re.S) for name in ("header", "data")]
    if found[0] is None or found[1] is None:
        raise D2Error(f"{path} is no page of `d2 export --format html`: it holds no scene")
    header = parse_json(found[0].group(1), f"the header of {path}", EXPORT)
    version = header.get("version") if isinstance(header, dict) else None
    if version != VERSION:
        raise D2Error(f"{path} is a page of version {shown(version)}, and this d2-4dgs reads {VERSION}: {EXPORT}")
    with parsing(f"the data of {path}", EXPORT):
        return ReadPage(header, unpacked(header["arrays"], base64.b64decode(found[1].group(1))))


def _coded(scene: ExportScene, megabytes: float) -> tuple[CodedScene, Keys | None]:
    if scene.moving is not None:
        return code_lines(scene.moving, scene.clip.duration, _bytes_for_data(megabytes)), None
    count = len(scene.harmonics.coefficients)
    at_rest = count * (BYTES_AT_REST + 3 * (scene.harmonics.coefficients.shape[1] - 1))

    def most_keys(moving: int, changing: int) -> int:
        each = moving * BYTES_OF_POSITION + changing * BYTES_OF_SHAPE
        return max(int((_bytes_for_data(megabytes) - at_rest) / max(1.05 * each, 1)), 2)

    keys = bake(scene.splats_at, count, scene.clip.seconds, scene.pixels_per_unit, most_keys)
    return code_keys(keys, scene.harmonics), keys


def _bytes_for_data(megabytes: float) -> float:
    """What a page of this size leaves for its arrays, beside the player."""
    return (megabytes * 1e6 - len(_assembled("", {}, b""))) / TEXT_PER_BYTE


def _rounding(scene: ExportScene, coded: CodedScene, keys: Keys | None, arrays: Mapping[str, np.ndarray]) -> Offset:
    if keys is None:
        assert scene.moving is not None
        true_at = states_of(scene.moving.select(coded.rows))
    else:
        true_at = keys.at
    return rounding(scene, true_at, lambda time: read_state(arrays, coded.facts, scene.clip.duration, time))


def _about(scene: ExportScene, coded: CodedScene, keys: Keys | None, rounding: Offset) -> list[str]:
    frames = len(scene.clip.frames)
    plural = "s" if frames > 1 else ""
    lines = [
        f"{coded.facts['count']:,} Gaussians, {frames} frame{plural} at {scene.clip.fps:g} per second",
        f"16-bit codes: off by {rounding}",
    ]
    bits = {array.name: array.bits for array in coded.arrays}.get("harmonics", 8)
    if bits < 8:
        off = _color_error(scene, coded)
        lines.append(
            f"harmonics in {bits} bits, so that the page is no larger: colours off by {off:.1f} of 255 in the mean"
        )
    if keys is not None:
        times, moving, changing = len(keys.times), keys.moving, keys.changing
        lines.append(
            f"a deformation field at {times} key times, straight in between: off by {keys.offset}; "
            f"{moving:,} Gaussians move, {changing:,} of them change their shape"
        )
    elif coded.facts["motion"] == "lines":
        lines.append("every Gaussian moves on a straight line and fades in time, exactly as it was trained")
    if scene.background is not None:
        lines.append("behind the Gaussians the learnt background, in every direction; its colours are not rounded")
    return [*lines, f"made by d2-4dgs {d2_plugin.__version__}; no network is used"]


def _color_error(scene: ExportScene, coded: CodedScene) -> float:
    """Mean difference of the colours that the first training camera sees, of 255; of up to `SAMPLE` Gaussians."""
    assert scene.moving is not None
    every = -(-len(coded.rows) // SAMPLE)
    [told] = [decode(array) for array in coded.arrays if array.name == "harmonics"]
    chosen = scene.moving.select(coded.rows[::every])
    true, harmonics = chosen.harmonics.coefficients, chosen.harmonics
    rounded = torch.cat([true[:, :1], torch.from_numpy(told[::every]).unflatten(1, (-1, 3))], 1)
    toward = chosen.positions - torch.as_tensor(scene.train_cameras[0].centre)
    phase = torch.zeros(len(true)).double()
    seen = [colors(part, toward, phase, harmonics.degree, harmonics.time_degree) for part in (true, rounded)]
    return 255 * float((seen[0] - seen[1]).abs().mean())


def _header(scene: ExportScene, coded: CodedScene) -> dict[str, Any]:
    outlook = look_around(scene)
    held_out = {camera.name for camera in scene.test_cameras}
    raster = scene.raster
    return coded.facts | {
        "version": VERSION,
        "name": scene.name,
        "block": BLOCK,
        "frames": list(scene.clip.frames),
        "seconds": list(scene.clip.seconds),
        "duration": scene.clip.duration,
        "fps": scene.clip.fps,
        "marginal_cut": MARGINAL_CUT,
        "marginal_reach": MARGINAL_REACH,
        "raster": {
            "near": raster.near,
            "blur": raster.blur,
            "alpha_max": raster.alpha_max,
            "alpha_min": raster.alpha_min,
            "fov_clamp": min(raster.fov_clamp, 1e6),
        },
        "cameras": [_camera(camera, camera.name in held_out) for camera in (*scene.train_cameras, *scene.test_cameras)],
        "background": None if scene.background is None else scene.background.tolist(),
        "palette": color_scale("viridis").tobytes().hex(),
        "depth_range": list(outlook.depth_range),
        "focus": outlook.focus,
        "up": outlook.up,
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
    return Template(_asset("page.html")).substitute(
        title=html.escape(name),
        generator=html.escape(f"d2-4dgs {d2_plugin.__version__}"),
        style=_asset("style.css"),
        header=to_json(header),
        data=base64.b64encode(data).decode("ascii"),
        worker=_scripts(WORKER_SCRIPTS),
        script=_scripts(PAGE_SCRIPTS),
    )


def _scripts(names: Sequence[str]) -> str:
    return "\n".join(_asset(name) for name in names)


def _asset(name: str) -> str:
    return (files(__package__) / "player" / name).read_text(encoding="utf-8")
