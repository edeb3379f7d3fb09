"""Every file format that is read, damaged at random: valid content or one sentence, in bounded time and memory."""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from fuzzing import SEED, bounded_memory, expect_result_or_sentence, mutate_file
from prior_cases import write_dense_array
from small_layouts import small_recording
from tiny_onnx import mean_network

from benchmarks.report import EVERY
from d2_plugin.arrays import read_array
from d2_plugin.config import D2Config, for_iterations
from d2_plugin.priors.colmap.workspace import read_dense_array
from d2_plugin.priors.depth_on_disk import SensorDepth
from d2_plugin.priors.monocular.network import MonocularModel
from d2_plugin.protocol import EXPORT_FILE
from d2_plugin.reading import read_json
from d2_plugin.recordings.export.export import export_recording
from d2_plugin.recordings.images import image_size, read_image, write_png
from d2_plugin.recordings.importing.video import VideoFrames, read_video
from d2_plugin.recordings.recording import Camera
from d2_plugin.runs.report.report import collect, make_report
from d2_plugin.store.exported import RenamedStore
from d2_plugin.viewing.camera_paths import read_camera_path
from d2_plugin.viewing.checkpoints import read_ply

cv2 = pytest.importorskip("cv2", reason="opencv is in the `image` extra")

FEW, MANY = 50, 2000
MAP = np.linspace(0.5, 3, 48 * 32, dtype=np.float32).reshape(32, 48)
IMAGE = (np.stack([MAP, MAP[::-1], MAP * 0.3], axis=-1) * 80).astype(np.uint8)


class Case(NamedTuple):
    """A file, how it is written and how it is read."""

    file: str
    write: Callable[[Path], object]
    read: Callable[[Path], Any]


def sensor(path: Path) -> np.ndarray | None:
    camera = Camera("cam00", 48, 32, np.diag([40.0, 40, 1]), np.eye(4))
    return SensorDepth(path.parent if path.name == "depth.json" else path.parent.parent, ["cam00"]).depth(camera, 0)


def write_sensor(path: Path) -> None:
    folder = path.parent if path.name == "depth.json" else path.parent.parent
    (folder / "cam00").mkdir(parents=True, exist_ok=True)
    (folder / "depth.json").write_text('{"unit": "mm"}')
    if path.suffix == ".npy":
        np.save(path, MAP * 1000)
    else:
        cv2.imwrite(str(folder / "cam00" / "0.png"), (MAP * 1000).astype(np.uint16))


def report(path: Path) -> object:
    rows, images = collect([path])
    return make_report(rows, path.parent / "report", images, EVERY)


def some_rows() -> list[str]:
    """Two rows of each kind: a report of all of them takes a while."""
    found: dict[str, list[str]] = {}
    for line in (Path(__file__).parent / "data" / "runs.jsonl").read_text().splitlines(keepends=True):
        found.setdefault(json.loads(line)["kind"], []).append(line)
    return [line for lines in found.values() for line in lines[:2]]


def network(path: Path) -> np.ndarray:
    return MonocularModel(path, "relative")(IMAGE)


def video(path: Path) -> np.ndarray:
    return VideoFrames({"a": read_video(path)}).image("a", 1)


def write_video(path: Path) -> None:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 24, (48, 32))
    for _ in range(3):
        writer.write(IMAGE)
    writer.release()


def write_camera_path(path: Path) -> None:
    pose = {"camera_to_world": np.eye(4).ravel().tolist(), "fov": 50.0, "aspect": 1.5, "render_time": 0.5}
    table = {"camera_type": "perspective", "render_height": 54, "render_width": 96, "camera_path": [pose, pose]}
    path.write_text(json.dumps({**table, "fps": 24, "seconds": 2}))


def write_cloud(path: Path) -> None:
    names = ["x", "y", "z", "opacity", "scale_0", "rot_0", "f_dc_0"]
    head = ["ply", "format binary_little_endian 1.0", "element vertex 5", *(f"property float {n}" for n in names)]
    path.write_bytes("\n".join([*head, "end_header\n"]).encode() + np.zeros((5, 7), np.float32).tobytes())


CASES = {
    "camera path": Case("camera_path.json", write_camera_path, read_camera_path),
    "point cloud": Case("cloud.ply", write_cloud, read_ply),
    "json": Case("a.json", lambda p: p.write_text(json.dumps({"a": [1, {"b": 2.5}], "c": "d"})), read_json),
    "toml": Case(
        "d2.toml",
        lambda p: p.write_text(for_iterations(("densify", "prune", "depth_loss"), 100).to_toml()),
        D2Config.from_toml,
    ),
    "npy": Case("a.npy", lambda p: np.save(p, MAP), read_array),
    "npz": Case("a.npz", lambda p: np.savez_compressed(p, depth=MAP), lambda p: read_array(p, key="depth")),
    "png": Case("a.png", lambda p: write_png(p, IMAGE), lambda p: (image_size(p), read_image(p))),
    "jpeg": Case("a.jpg", lambda p: cv2.imwrite(str(p), IMAGE), lambda p: (image_size(p), read_image(p))),
    "video": Case("a.mp4", write_video, video),
    "dense": Case("a.bin", lambda p: write_dense_array(p, MAP), read_dense_array),
    "sensor json": Case("depth.json", write_sensor, sensor),
    "sensor npy": Case("depth/cam00/0.npy", write_sensor, sensor),
    "sensor png": Case("depth/cam00/0.png", write_sensor, sensor),
    "rows": Case(
        "runs.jsonl",
        lambda p: p.write_text("".join(some_rows())),
        report,
    ),
    "export": Case(
        f"export/{EXPORT_FILE}",
        lambda p: export_recording(small_recording(), "transforms", p.parent),
        lambda p: RenamedStore.of_export(None, p.parent),
    ),
    "onnx": Case("net.onnx", lambda p: mean_network(p, 32, 48), network),
}


def fuzz(case: Case, folder: Path, count: int, seed: int) -> int:
    path = folder / case.file
    path.parent.mkdir(parents=True, exist_ok=True)
    if case.file.startswith("export"):
        path.parent.rmdir()
    case.write(path)
    assert expect_result_or_sentence(lambda: case.read(path), "none"), "the file itself is valid"
    before, valid = path.read_bytes(), 0
    with bounded_memory():
        for number in range(count):
            mutate_file(path, random.Random(f"{case.file} {seed} {number}"))
            valid += expect_result_or_sentence(lambda: case.read(path), f"{case.file} {seed} {number}")
            path.write_bytes(before)
    return valid


@pytest.mark.parametrize("count", [FEW, pytest.param(MANY, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", CASES)
def test_a_damaged_file_is_valid_or_one_sentence(name: str, count: int, tmp_path: Path) -> None:
    if name == "onnx":
        pytest.importorskip("onnxruntime", reason="onnxruntime is in the `mono` extra")
    count = 10 if name == "rows" and count == FEW else count  # a report takes a while
    seed = 0 if count < MANY else SEED
    assert fuzz(CASES[name], tmp_path, count, seed) < count, "no mutation did any harm: the test would not notice"
