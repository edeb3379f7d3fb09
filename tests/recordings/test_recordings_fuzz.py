"""Every layout of recordings and every format of calibrations on damaged files: a valid result or one sentence.

In bounded time and memory; one file is damaged at a time.
"""

from __future__ import annotations

import random
import zlib  # noqa: F401  (pycolmap brings a zlib of its own that must not come first)
from collections.abc import Callable
from pathlib import Path

import pytest
from fuzzing import SEED, bounded_memory, expect_result_or_sentence, mutate_file
from small_layouts import write_layout

pytest.importorskip("cv2", reason="opencv is in the `image` extra")
pytest.importorskip("yaml", reason="pyyaml is in the `calibration` extra")
pytest.importorskip("pycolmap", reason="pycolmap is in the `calibration` extra")
pytest.importorskip("av", reason="PyAV is in the `video` extra")

from calibration_writers import CASES, rig

from d2_plugin.errors import D2Error
from d2_plugin.recordings import open_recording
from d2_plugin.recordings.cameras.calibration import read_calibration
from d2_plugin.recordings.cameras.formats.colmap import find_model, read_points

LAYOUTS = ("folder", "n3dv", "videos", "technicolor", "enerf", "transforms", "colmap", "colmap_text")
IMAGES = (".png", ".mp4")
FEW, MANY = 20, 2000


def layout(name: str, path: Path) -> Callable[[], object]:
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


def calibration(name: str, path: Path) -> Callable[[], object]:
    """A function that reads a calibration of one format."""
    path.mkdir()
    case = CASES[name]
    cameras = rig(case.coefficients, case.fisheye, case.names)
    file = case.write(path, cameras)
    sizes = None if case.sizes else {camera.name: camera.size for camera in cameras}
    return lambda: [camera.lens.bends for camera in read_calibration(file, sizes)]


TABLE = [*((layout, name) for name in LAYOUTS), *((calibration, name) for name in CASES)]


def fuzz(written: Callable, name: str, path: Path, count: int, seed: int) -> int:
    """Damage one file at a time, two in three times one that is no image; returns how many were still valid."""
    read = written(name, path)
    assert expect_result_or_sentence(read, "none"), "the files themselves are valid"
    files = sorted(file for file in path.rglob("*") if file.is_file())
    plain = [file for file in files if file.suffix not in IMAGES]
    valid = 0
    with bounded_memory():
        for number in range(count):
            rng = random.Random(f"{name} {seed} {number}")
            file = rng.choice(plain if rng.random() < 0.67 else files)
            before = file.read_bytes()
            mutate_file(file, rng)
            valid += expect_result_or_sentence(read, f"{name} {seed} {number} {file.name}")
            file.write_bytes(before)
    return valid


@pytest.mark.parametrize(("written", "name"), TABLE)
def test_what_is_damaged_is_valid_or_one_sentence(written: Callable, name: str, tmp_path: Path) -> None:
    assert fuzz(written, name, tmp_path / "files", FEW, 0) < FEW, "no mutation did any harm: the test would not notice"


@pytest.mark.slow
@pytest.mark.parametrize(("written", "name"), TABLE)
def test_two_thousand_damaged_files(written: Callable, name: str, tmp_path: Path) -> None:
    fuzz(written, name, tmp_path / "files", MANY, SEED)


@pytest.mark.parametrize(
    ("place", "number", "message"),
    [
        (4, "inf", r"has a K with a number that is not finite or larger than 1e\+09"),
        (4, "1e300", r"has a K with a number that is not finite or larger than 1e\+09"),
        (5, "1e-305", "has focal lengths .* and 1e-305, expected positive"),
    ],
)
def test_a_focal_length_that_cannot_be_is_named(place: int, number: str, message: str, tmp_path: Path) -> None:
    path = write_layout("colmap_text", tmp_path / "recording")
    cameras = path / "sparse" / "0" / "cameras.txt"
    *comments, first, last = cameras.read_text().splitlines()
    words = first.split()
    words[place] = number
    cameras.write_text("\n".join([*comments, " ".join(words), last]))
    with pytest.raises(D2Error, match=f"camera .* {message}"):
        open_recording(path)
