"""One HTML file that plays one moving scene or compares two, without a network: data and player stand in it as text."""

from __future__ import annotations

import base64
import gzip
import html
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

import d2_plugin
from d2_plugin.durable import refuse_foreign, write_text
from d2_plugin.errors import D2Error
from d2_plugin.gaussians.slicing import MARGINAL_CUT
from d2_plugin.reading import json_text
from d2_plugin.recordings import Camera
from d2_plugin.recordings.images import opencv
from d2_plugin.recordings.selection import spread
from d2_plugin.runs.drawing import color_scale
from d2_plugin.values import counted
from d2_plugin.viewing.export.coded import BLOCK, MARGINAL_REACH, CodedScene, code_keys, code_lines
from d2_plugin.viewing.export.keys import bake
from d2_plugin.viewing.export.scene import ExportScene
from d2_plugin.viewing.panels import fitted

GENERATOR = "d2-4dgs"
COMPRESSION = 6
RASTER = ("near", "blur", "alpha_max", "alpha_min", "fov_clamp")
"""Settings of the rasterizer that the player's shaders obey."""
PAGE_SCRIPTS = ("controls.js", "scene.js", "shaders.js", "renderer.js", "pace.js", "player.js")
WORKER_SCRIPTS = ("scene.js", "sorter.js")
RECORDED_BYTES, RECORDED_HEIGHT, RECORDED_QUALITY = 2.5e6, 360, 80
"""Of the recorded images in a page: all together, at most so many pixels high, quality of WebP."""


def _placed(data: bytearray, part: bytes) -> int:
    """Append a part to the data of a page; returns where it begins."""
    data += part
    return len(data) - len(part)


def write_page(scenes: Sequence[ExportScene], path: Path) -> list[str]:
    """Write the page of one scene, or of two of one recording to compare; returns what it says of itself.

    Raises:
        D2Error: scenes with other cameras or frames, or a file that `d2 export` did not write.
    """
    refuse_foreign(path, f'content="{GENERATOR} ', "d2 export")
    last, data = scenes[-1], bytearray()
    for scene in scenes:
        where = [[camera.name for camera in one.cameras] for one in (scene, last)]
        if scene.viewed.recording.frames != last.viewed.recording.frames or sorted(where[0]) != sorted(where[1]):
            raise D2Error(
                f"{scene.viewed.name} and {last.viewed.name} have not the same cameras and frames: compare runs of one "
                "recording with the same --frames"
            )
    images = _recorded(last, data)
    models, about = [], []
    for scene in scenes:
        moving = scene.moving
        coded = code_keys(bake(scene), scene.harmonics) if moving is None else code_lines(moving, scene.viewed.duration)
        models.append(_model(scene, coded, data))
        about += [f"{scene.viewed.name}: {line}" if len(scenes) > 1 else line for line in _about(scene, coded)]
    if images:
        count, size = sum(map(len, images.values())), sum(length for kept in images.values() for _, _, length in kept)
        about.append(f"{count} recorded images of the cameras {', '.join(images)}: {size / 1e6:.1f} MB of the page")
    about += [
        f"{counted(len(last.viewed.recording.frames), 'frame')} at {last.viewed.recording.rate:g} per second",
        f"made by d2-4dgs {d2_plugin.__version__}; no network is used",
    ]
    header = _header(last) | {"models": models, "recorded": images, "about": about}
    write_text(path, _assembled(last.viewed.recording.name, header, bytes(data)))
    return about


def _recorded(scene: ExportScene, data: bytearray) -> dict[str, list[tuple[float, int, int]]]:
    """Images of the held-out cameras: of each when it was taken, where it stands and its length."""
    recording, names = scene.viewed.recording, scene.viewed.test_cameras or scene.viewed.train_cameras
    cameras = [recording.cameras[name] for name in names]
    cv2 = opencv("a page with recorded images")

    def image(camera: Camera, place: int) -> bytes:
        pixels = recording.image(camera.name, recording.frames[place])
        height = min(pixels.shape[0], RECORDED_HEIGHT)
        pixels = fitted(pixels, round(pixels.shape[1] * height / pixels.shape[0]), height)
        quality = [cv2.IMWRITE_WEBP_QUALITY, RECORDED_QUALITY]
        return bytes(cv2.imencode(".webp", pixels[..., ::-1], quality)[1])

    most = max(int(RECORDED_BYTES / sum(len(image(camera, 0)) for camera in cameras)), 1)
    places = spread(range(len(recording.frames)), most)
    kept: dict[str, list[tuple[float, int, int]]] = {}
    for camera in cameras:
        for place in places:
            written = image(camera, place)
            taken = recording.seconds(recording.frames[place], camera.name)
            kept.setdefault(camera.name, []).append((taken, _placed(data, written), len(written)))
    return kept


def _about(scene: ExportScene, coded: CodedScene) -> list[str]:
    keys, lines = coded.keys, [*scene.viewed.note.splitlines(), counted(coded.gaussians, "Gaussian", ",")]
    if keys is not None:
        lines.append(
            f"a deformation field at {len(keys.times)} key times, straight in between: off by {keys.offset}; "
            f"{keys.moving:,} Gaussians move, {keys.changing:,} of them change their shape"
        )
    elif coded.motion == "lines":
        lines.append("every Gaussian moves on a straight line and fades in time, exactly as it was trained")
    if scene.background is not None:
        lines.append("behind the Gaussians the learnt background, in every direction; its colours are not rounded")
    return lines


def _model(scene: ExportScene, coded: CodedScene, data: bytearray) -> dict[str, Any]:
    """The table of one scene; its arrays go into `data`."""
    kept = ("name", "rows", "columns", "bits")
    return {
        "name": scene.viewed.name,
        "scores": scene.viewed.scores,
        "count": coded.gaussians,
        "motion": coded.motion,
        "keys": None if coded.keys is None else coded.keys.times,
        "degree": scene.harmonics.degree,
        "time_degree": scene.harmonics.time_degree,
        "raster": {name: min(getattr(scene.viewed.backbone.settings, name), 1e6) for name in RASTER},
        "background": None if scene.background is None else scene.background.tolist(),
        "arrays": [{name: getattr(a, name) for name in kept} | {"offset": _placed(data, a.data)} for a in coded.arrays],
    }


def _header(scene: ExportScene) -> dict[str, Any]:
    outlook = scene.outlook()
    return {
        "name": scene.viewed.recording.name,
        "block": BLOCK,
        "frames": scene.viewed.recording.frames,
        "seconds": scene.seconds,
        "duration": scene.viewed.duration,
        "marginal_cut": MARGINAL_CUT,
        "marginal_reach": MARGINAL_REACH,
        "cameras": [_camera(camera, camera.name in scene.viewed.test_cameras) for camera in scene.cameras],
        "palette": color_scale("viridis").tobytes().hex(),
        **outlook,
        "home": _camera(outlook["home"], False),
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
    coded = base64.b64encode(gzip.compress(data, COMPRESSION, mtime=0)).decode("ascii")
    return Template(_text_of("page.html")).substitute(
        title=html.escape(name),
        generator=html.escape(f"{GENERATOR} {d2_plugin.__version__}"),
        style=_text_of("style.css"),
        header=to_json(header),
        data=coded,
        length=max(len(coded), 1),
        worker=_text_of(*WORKER_SCRIPTS),
        script=_text_of(*PAGE_SCRIPTS),
    )


def _text_of(*names: str) -> str:
    return "\n".join((files(__package__) / "player" / name).read_text(encoding="utf-8") for name in names)


def to_json(table: Any) -> str:
    """JSON that may stand inside an HTML <script>: no '<', so no name in it can close the element or open one."""
    text = json_text(table, "the page", separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
