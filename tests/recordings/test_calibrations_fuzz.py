"""Every calibration format on damaged files: cameras or one sentence, in bounded time and memory."""

from __future__ import annotations

import random
import zlib  # noqa: F401  (pycolmap brings a zlib of its own that must not come first)
from pathlib import Path

import pytest
from fuzzing import bounded_memory, expect_result_or_sentence, mutate_file

pytest.importorskip("cv2", reason="opencv is in the `calibration` extra")
pytest.importorskip("yaml", reason="pyyaml is in the `calibration` extra")
pytest.importorskip("pycolmap", reason="pycolmap is in the `calibration` extra")

from calibration_writers import CASES, rig

from d2_plugin.recordings.cameras.calibration import read_calibration

FEW, MANY = 20, 2000


def fuzz(name: str, folder: Path, count: int, seed: int) -> int:
    case = CASES[name]
    cameras = rig(case.coefficients, case.fisheye, case.names)
    path = case.write(folder, cameras)
    sizes = None if case.sizes else {camera.name: camera.size for camera in cameras}
    assert expect_result_or_sentence(lambda: read_calibration(path, sizes), "none"), "the file itself is valid"
    files, valid = sorted(file for file in folder.rglob("*") if file.is_file()), 0
    with bounded_memory():
        for number in range(count):
            rng = random.Random(f"{name} {seed} {number}")
            file = rng.choice(files)
            before = file.read_bytes()
            mutate_file(file, rng)

            def read() -> object:
                return [camera.lens.bends for camera in read_calibration(path, sizes)]

            valid += expect_result_or_sentence(read, f"{name} {seed} {number}")
            file.write_bytes(before)
    return valid


@pytest.mark.parametrize("name", CASES)
def test_a_damaged_calibration_is_valid_or_one_sentence(name: str, tmp_path: Path) -> None:
    assert fuzz(name, tmp_path, FEW, 0) < FEW, "no mutation did any harm: the test would not notice"


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_two_thousand_damaged_calibrations(name: str, tmp_path: Path) -> None:
    fuzz(name, tmp_path, MANY, 1)
