"""Every file that is read, damaged at random: a valid result or one sentence, in bounded time and memory.

Of what the plugin itself keeps a valid result is the one that was written.
"""

import json
import random
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from calibration_writers import CASES as CALIBRATIONS
from calibration_writers import rig
from fuzzing import SEED, bounded_memory, expect_result_or_sentence, leaves, mutate_file
from prior_cases import write_dense_array
from recorded import write_video
from small_layouts import small_recording, write_layout
from tiny_onnx import mean_network

from benchmarks.report import EVERY
from d2_plugin.arrays import read_array
from d2_plugin.config import D2Config, for_iterations
from d2_plugin.durable import write_table
from d2_plugin.priors.colmap.workspace import read_dense_array
from d2_plugin.priors.depth_on_disk import SensorDepth
from d2_plugin.priors.monocular.network import MonocularModel
from d2_plugin.protocol import EXPORT_FILE, Label
from d2_plugin.reading import read_json
from d2_plugin.recordings import open_recording
from d2_plugin.recordings.cameras.calibration import open_calibration
from d2_plugin.recordings.cameras.formats.colmap import find_model, read_points
from d2_plugin.recordings.export.export import export_recording
from d2_plugin.recordings.images import image_size, read_image, write_png
from d2_plugin.recordings.importing.video import VideoFrames, read_video
from d2_plugin.recordings.recording import Camera
from d2_plugin.runs.report.report import collect, make_report
from d2_plugin.runs.saved import METRICS, RUN, load_checkpoint, read_metrics, read_run, save_checkpoint
from d2_plugin.runs.start import TimedPoints
from d2_plugin.store.exported import RenamedStore
from d2_plugin.store.maps import FusedPrior
from d2_plugin.store.store import PriorStore
from d2_plugin.viewing.camera_paths import read_camera_path
from d2_plugin.viewing.checkpoints import read_ply

cv2 = pytest.importorskip("cv2", reason="opencv is in the `image` extra")
pytest.importorskip("yaml", reason="pyyaml is in the `calibration` extra")
pytest.importorskip("pycolmap", reason="pycolmap is in the `calibration` extra")
pytest.importorskip("av", reason="PyAV is in the `video` extra")

MANY = 2000
MAP = np.linspace(0.5, 3, 48 * 32, dtype=np.float32).reshape(32, 48)
IMAGE = (np.stack([MAP, MAP[::-1], MAP * 0.3], axis=-1) * 80).astype(np.uint8)
LAYOUTS = ("folder", "n3dv", "videos", "technicolor", "enerf", "transforms", "colmap", "colmap_text")
IMAGES = (".png", ".mp4")


class Case(NamedTuple):
    """A file, how it is written and how it is read."""

    file: str
    write: Callable[[Path], object]
    read: Callable[[Path], Any]
    kept: bool = False
    """By the plugin itself: what is read is what was written."""


def depth_folder(path: Path) -> Path:
    return path.parent if path.name == "depth.json" else path.parent.parent


def sensor(path: Path) -> np.ndarray | None:
    camera = Camera("cam00", 48, 32, np.diag([40.0, 40, 1]), np.eye(4))
    return SensorDepth(depth_folder(path), ["cam00"]).depth(camera, 0)


def write_sensor(path: Path) -> None:
    folder = depth_folder(path)
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
    for line in (Path(__file__).parents[1] / "data" / "runs.jsonl").read_text().splitlines(keepends=True):
        found.setdefault(json.loads(line)["kind"], []).append(line)
    return [line for lines in found.values() for line in lines[:2]]


def write_three_images(path: Path) -> None:
    write_video(path, [IMAGE] * 3, [0, 1 / 24, 2 / 24])


def write_camera_path(path: Path) -> None:
    pose = {"camera_to_world": np.eye(4).ravel().tolist(), "fov": 50.0, "aspect": 1.5, "render_time": 0.5}
    table = {"camera_type": "perspective", "render_height": 54, "render_width": 96, "camera_path": [pose, pose]}
    path.write_text(json.dumps({**table, "fps": 24, "seconds": 2}))


def write_cloud(path: Path) -> None:
    names = ["x", "y", "z", "opacity", "scale_0", "rot_0", "f_dc_0"]
    head = ["ply", "format binary_little_endian 1.0", "element vertex 5", *(f"property float {n}" for n in names)]
    path.write_bytes("\n".join([*head, "end_header\n"]).encode() + np.zeros((5, 7), np.float32).tobytes())


def store_of(path: Path) -> Path:
    """The prior store that a file lies in."""
    return next(folder for folder in path.parents if folder.name == "store")


def write_store(path: Path) -> None:
    labels = np.full((9, 12), Label.VERIFIED, np.uint8)
    depth = np.linspace(1, 4, 108, dtype=np.float32).reshape(9, 12)
    maps = FusedPrior(depth, labels, np.full((9, 12), 0.02, np.float32), np.zeros((9, 12, 3), np.uint8))
    store = PriorStore.create(store_of(path), ["a", "b"], [0], {"recording": "room"})
    for camera in ("a", "b"):
        store.write(camera, 0, maps, {"key": "k", "shares": maps.shares(), "refused": ""})


def read_store(path: Path) -> list[Any]:
    opened = PriorStore.open(store_of(path))
    return [list(opened.cameras), [[opened.prior(c, 0), opened.record(c, 0)] for c in opened.cameras]]


STATE = {"step": 7, "model": {"positions": torch.randn(20, 3), "on": True}, "seconds": {"train": 1.5}}
SETTINGS = {"recording": "/x", "seed": 3, "overrides": {"d2": {"seed": 1}}}
SCORES = {
    "test": {"psnr": 25.5}, "seconds": {"train": 1.0}, "gaussians": 3, "iterations": 4, "recording": "room",
    "train_cameras": ["a"], "backbone": "b", "hooks": [], "made": {"commit": "c"},
}  # fmt: skip
POINTS = np.random.default_rng(0).random((8, 7))

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
    "video": Case("a.mp4", write_three_images, lambda p: VideoFrames({"a": read_video(p)}).image("a", 1)),
    "dense": Case("a.bin", lambda p: write_dense_array(p, MAP), read_dense_array),
    "sensor json": Case("depth.json", write_sensor, sensor),
    "sensor npy": Case("depth/cam00/0.npy", write_sensor, sensor),
    "sensor png": Case("depth/cam00/0.png", write_sensor, sensor),
    "rows": Case("runs.jsonl", lambda p: p.write_text("".join(some_rows())), report),
    "export": Case(
        f"export/{EXPORT_FILE}",
        lambda p: export_recording(small_recording(), "transforms", p.parent),
        lambda p: RenamedStore.of_export(None, p.parent),
    ),
    "onnx": Case("net.onnx", lambda p: mean_network(p, 32, 48), lambda p: MonocularModel(p, "relative").predict(IMAGE)),
    "store": Case("store/store.json", write_store, read_store, kept=True),
    "record": Case("store/priors/a/00000.json", write_store, read_store, kept=True),
    "prior": Case("store/priors/b/00000.npy", write_store, read_store, kept=True),
    "checkpoint": Case(
        "checkpoint.pt", lambda p: save_checkpoint(p, STATE), lambda p: load_checkpoint(p, "cpu"), kept=True
    ),
    "points": Case(
        "points.npz",
        lambda p: TimedPoints(POINTS[:, :3], POINTS[:, 3:6], POINTS[:, 6]).save(p),
        lambda p: vars(TimedPoints.load(p)),
        kept=True,
    ),
    "run": Case("run.json", lambda p: write_table(p, SETTINGS, RUN), lambda p: read_run(p.parent), kept=True),
    "scores": Case("metrics.json", lambda p: write_table(p, SCORES, METRICS), lambda p: read_metrics(p.parent), True),
}


def layout(path: Path, name: str) -> Callable[[], object]:
    """A function that opens a small recording and reads what its cameras have."""
    write_layout(name, path)

    def read() -> object:
        recording = open_recording(path)
        for camera in recording.cameras:
            for frame in recording.frames[:2]:
                recording.image(camera, frame)
                recording.depth(camera, frame)
                recording.mono(camera, frame)
        model = find_model(path)
        return read_points(model) if model is not None else recording

    return read


def calibration(path: Path, name: str) -> Callable[[], object]:
    """A function that reads a calibration of one format."""
    path.mkdir()
    case = CALIBRATIONS[name]
    cameras = rig(case.coefficients, case.fisheye, case.names)
    file = case.write(path, cameras)
    sizes = None if case.sizes else {camera.name: camera.size for camera in cameras}
    return lambda: [camera.lens.bends for camera in open_calibration(file, sizes).cameras]


class Damage(NamedTuple):
    """What is damaged, how often in the short round, and how it is read."""

    read: Callable[[], Any]
    files: list[Path]
    few: int
    kept: bool = False


def of_case(folder: Path, name: str) -> Damage:
    case = CASES[name]
    path = folder / case.file
    case.write(path)
    few = 10 if name == "rows" else 40 if case.kept else 50  # a report takes a while
    return Damage(lambda: case.read(path), [path], few, case.kept)


def of_folder(written: Callable[[Path, str], Callable[[], object]], folder: Path, name: str) -> Damage:
    """Two in three times a file that is no image."""
    read = written(folder / "files", name)
    files = sorted(file for file in (folder / "files").rglob("*") if file.is_file())
    plain = [file for file in files if file.suffix not in IMAGES]
    return Damage(read, files + plain * (2 * len(files) // len(plain)), 20)


TABLE = [
    *((of_case, name) for name in CASES),
    *((partial(of_folder, layout), name) for name in LAYOUTS),
    *((partial(of_folder, calibration), name) for name in CALIBRATIONS),
]


@pytest.mark.parametrize("many", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize(("written", "name"), TABLE, ids=[name for _, name in TABLE])
def test_a_damaged_file_is_valid_or_one_sentence(written, name, many, tmp_path) -> None:
    if name == "onnx":
        pytest.importorskip("onnxruntime", reason="onnxruntime is in the `mono` extra")
    read, files, few, kept = written(tmp_path, name)
    whole = read()
    expected = leaves(whole) if kept else None
    count, seed, valid = (MANY, SEED, 0) if many else (few, 0, 0)
    with bounded_memory():
        for number in range(count):
            rng = random.Random(f"{name} {seed} {number}")
            path = rng.choice(files)
            before = path.read_bytes()
            mutate_file(path, rng)
            valid += expect_result_or_sentence(read, f"{name} {seed} {number} {path.name}", expected)
            path.write_bytes(before)
    assert valid < (count / 2 if kept else count), "hardly a mutation did any harm: the test would not notice"
