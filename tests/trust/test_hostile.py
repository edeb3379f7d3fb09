"""A hostile user on the command line: each case is one sentence and exit code 2, never silence or a traceback."""

from __future__ import annotations

import json
import os
import shutil
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from d2_plugin.commands.cli import main

pytestmark = pytest.mark.slow

Change = Callable[[Path], object]

FLAGS = """
--densify.scale -1 | --densify.opacity 2 | --densify.budget-per-view -5 | --densify.budget -5
--depth-loss.tau-v nan | --depth-loss.weight 1e308 | --prune.patience 0 | --d2.views-per-evaluation -3
--d2.finite-every -1 | --d2.finite-every 1.5 | --plan.temporal maybe | --seed -1 | --seed 99999999999999999999999
--frames 0:3000000000 | --frames x | --frames 3:1 | --iterations 0 | --iterations 1e400 | --iterations nan
--downscale 0 | --downscale 1e9 | --hooks all,none | --hooks densfy | --device tpu | --backbone ../x
--priors.stereo.depth-range 1,2,3 | --backbone.densify.every -1 | --config /dev/null | --config /nope
--train-cameras a,b | --train-cameras train0,train0 | --test-cameras train0 | --mono-onnx /nope | --mono-kind purple
--output /proc/x/y | --output /dev/null/x
"""
TABLES = {
    "no such choice": '[plan]\ntemporal="maybe"',
    "no table": "densify=3",
    "unknown": "[densify]\nnope=1",
    "cut off": "x=[",
    "nan": "[densify]\nscale=nan",
    "a zero byte": "\x00",
    "beyond all numbers": "[d2]\nseed=1e999",
    "deep": "a=" + "[" * 5000,
}
CAMERA = {
    "no focal length": {"fx": 0},
    "a tiny focal length": {"fx": 1e-30},
    "a huge focal length": {"fx": 1e30},
    "far away": {"t": [1e30, 0, 0]},
    "a short t": {"t": [1]},
    "R a word": {"R": "x"},
    "R zeros": {"R": [[0] * 3] * 3},
    "a negative width": {"width": -1},
    "a huge width": {"width": 1e300},
    "an infinite width": {"width": float("inf")},
    "a comma in its name": {"name": "a,b"},
    "the folder above as its name": {"name": ".."},
    "no name": {"name": None},
    "markup as its name": {"name": "<script>"},
}
CALIBRATIONS = {
    "empty": b"",
    "a list": b"[]",
    "deep": b"[" * 100000,
    "a long number": b'{"fps":' + b"9" * 5000 + b"}",
    "NaN": b'{"cameras":NaN}',
    "noise": bytes(range(256)),
    "a name twice": b'{"a":1,"a":2}',
    "nothing": b"null",
    "half a letter": b'{"a":"\\ud800"}',
}
HEADER = (
    b"\x93NUMPY\x01\x00v\x00{'descr': '<f8', 'fortran_order': False, 'shape': (1000000, 1000000), }".ljust(128) + b"\n"
)
DEPTHS = {"a zip": b"PK\x03\x04zz", "empty": b"", "terabytes": HEADER}
ARRAYS = {"0x0": np.zeros((0, 0)), "words": np.array(["a"]), "structured": np.zeros(3, [("a", "f4")])}


def camera_with(values: dict[str, Any]) -> Change:
    """The first camera says something else."""

    def change(recording: Path) -> None:
        table = json.loads((recording / "cameras.json").read_text())
        assert {"fx", "t", "R", "width", "name"} <= set(table["cameras"][0])
        table["cameras"][0].update(values)
        (recording / "cameras.json").write_text(json.dumps(table))

    return change


def image(recording: Path) -> Path:
    return sorted((recording / "images").rglob("*.png"))[0]


def fifo(recording: Path) -> None:
    path = image(recording)
    path.unlink()
    os.mkfifo(path)


def enormous(recording: Path) -> None:
    data = bytearray(image(recording).read_bytes())
    data[16:24] = struct.pack(">II", 100000, 100000)
    data[29:33] = struct.pack(">I", zlib.crc32(bytes(data[12:29])))
    image(recording).write_bytes(bytes(data))


def depths_with(write: Callable[[Path], object]) -> Change:
    return lambda recording: [write(path) for path in (recording / "depth").rglob("*.np*")]


def saved(array: np.ndarray) -> Callable[[Path], object]:
    def write(path: Path) -> None:
        with path.open("wb") as file:
            np.save(file, array)

    return write


CHANGES: dict[str, Change] = {
    **{f"a camera with {name}": camera_with(values) for name, values in CAMERA.items()},
    **{
        f"cameras.json is {name}": (lambda recording, data=data: (recording / "cameras.json").write_bytes(data))
        for name, data in CALIBRATIONS.items()
    },
    "an image is empty": lambda recording: image(recording).write_bytes(b""),
    "an image is cut off": lambda recording: image(recording).write_bytes(image(recording).read_bytes()[:200]),
    "an image is a pipe": fifo,
    "an image says that it is enormous": enormous,
    **{
        f"depth is {name}": depths_with(lambda path, data=data: path.write_bytes(data)) for name, data in DEPTHS.items()
    },
    **{f"depth is {name}": depths_with(saved(array)) for name, array in ARRAYS.items()},
}


def refused(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """What is wrong with the way in which a command line was refused; nothing where one sentence said why."""
    capsys.readouterr()
    try:
        code = main(words)
    except BaseException as error:  # whatever leaves the boundary of the command line is the fault that is looked for
        return repr(error)
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("d2: ")]
    if code != 2 or len(said) != 1:
        return f"exit code {code}, {said}"
    return f"it is called our fault: {said[0]}" if "fault of d2" in said[0] else ""


def train(recording: Path, output: Path) -> list[str]:
    words = ["train", str(recording), "--train-cameras", "train0,train1", "--iterations", "3"]
    return [*words, "--priors.stereo.matcher", "sweep", "--output", str(output)]


def test_flags(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cases = [case.split() for line in FLAGS.strip().splitlines() for case in line.split(" | ")]
    wrong = {" ".join(case): refused([*train(recording, tmp_path / "run"), *case], capsys) for case in cases}
    assert len(cases) > 35
    assert {name: found for name, found in wrong.items() if found} == {}


def test_configurations(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wrong = {}
    for name, text in TABLES.items():
        (tmp_path / "c.toml").write_text(text)
        words = [*train(recording, tmp_path / "run"), "--config", str(tmp_path / "c.toml")]
        wrong[name] = refused(words, capsys)
    assert {name: found for name, found in wrong.items() if found} == {}


def test_recordings(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wrong = {}
    for index, (name, change) in enumerate(CHANGES.items()):
        spoiled = shutil.copytree(recording, tmp_path / f"recording{index}")
        change(spoiled)
        wrong[name] = refused([*train(spoiled, tmp_path / f"run{index}"), "--hooks", "none"], capsys)
    assert {name: found for name, found in wrong.items() if found} == {}
