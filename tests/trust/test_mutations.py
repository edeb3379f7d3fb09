"""Any mutation of a file that was kept: it is read as it was written, or refused with one sentence; nothing else."""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from d2_plugin.durable import write_table
from d2_plugin.errors import D2Error
from d2_plugin.priors.fuse import FusedPrior
from d2_plugin.protocol import Label
from d2_plugin.runs.saved.checkpoint import load_checkpoint, save_checkpoint
from d2_plugin.runs.saved.kinds import METRICS, RUN, read_metrics, read_run
from d2_plugin.runs.start import TimedPoints
from d2_plugin.store.store import PriorStore

FEW, MANY = 40, 2000


def flipped(data: bytes, draw: random.Random) -> bytes:
    changed = bytearray(data)
    for _ in range(draw.choice((1, 1, 1, 4))):
        changed[draw.randrange(len(changed))] ^= 1 << draw.randrange(8)
    return bytes(changed)


def cut(data: bytes, draw: random.Random) -> bytes:
    return data[: draw.randrange(len(data))]


def overwritten(data: bytes, draw: random.Random) -> bytes:
    start = draw.randrange(len(data))
    length = draw.randrange(1, 64)
    filling = draw.choice((b"\0" * length, b"\xff" * length, draw.randbytes(length), b"9" * length, b"[" * length))
    return data[:start] + filling + data[start + length :]


def moved(data: bytes, draw: random.Random) -> bytes:
    first, second = sorted(draw.randrange(len(data)) for _ in range(2))
    return data[:first] + data[second:] + data[first:second] if draw.random() < 0.5 else data[:second] + data[first:]


def other_values(data: bytes, draw: random.Random) -> bytes:
    """A valid JSON object in which one value is another, or a name is gone; noise where the file is no JSON."""
    try:
        table = json.loads(data)
    except ValueError:
        return draw.randbytes(len(data))
    name = draw.choice(sorted(table))
    values = (None, -1, 1e300, "", "x", [], {}, True, [[1]], {"a": {}})
    if draw.random() < 0.3:
        del table[name]
    else:
        table[name] = draw.choice(values)
    return json.dumps(table).encode()


MUTATIONS = (flipped, flipped, cut, overwritten, moved, other_values)


def leaves(value: Any) -> list[Any]:
    """What a value holds, to be compared."""
    if isinstance(value, dict):
        return [leaf for name in sorted(value, key=str) for leaf in (str(name), *leaves(value[name]))]
    if isinstance(value, list | tuple):
        return [leaf for item in value for leaf in leaves(item)]
    if isinstance(value, torch.Tensor | np.ndarray):
        return [str(value.dtype), tuple(value.shape), np.asarray(value).tobytes()]
    return [value]


def a_store(folder: Path) -> tuple[Path, Callable[[], Any]]:
    labels = np.full((9, 12), Label.VERIFIED, np.uint8)
    maps = FusedPrior(
        np.linspace(1, 4, 108, dtype=np.float32).reshape(9, 12),
        labels,
        np.full((9, 12), 0.02, np.float32),
        np.zeros((9, 12, 3), np.uint8),
    )
    store = PriorStore.create(folder / "store", ["a", "b"], [0], {"recording": "room"})
    for camera in ("a", "b"):
        store.write(camera, 0, maps, {"key": "k", "shares": maps.shares(), "refused": ""})

    def read() -> Any:
        opened = PriorStore.open(folder / "store")
        return [list(opened.cameras), [[opened.prior(c, 0), opened.record(c, 0)] for c in opened.cameras]]

    return store.path, read


def store_table(folder: Path) -> tuple[Path, Callable[[], Any]]:
    path, read = a_store(folder)
    return path / "store.json", read


def record(folder: Path) -> tuple[Path, Callable[[], Any]]:
    path, read = a_store(folder)
    return path / "priors" / "a" / "00000.json", read


def prior_map(folder: Path) -> tuple[Path, Callable[[], Any]]:
    path, read = a_store(folder)
    return path / "priors" / "b" / "00000.npy", read


def checkpoint(folder: Path) -> tuple[Path, Callable[[], Any]]:
    path = folder / "checkpoint.pt"
    state = {"step": 7, "model": {"positions": torch.randn(20, 3), "on": True}, "seconds": {"train": 1.5}}
    save_checkpoint(path, state)
    return path, lambda: load_checkpoint(path, "cpu")


def points(folder: Path) -> tuple[Path, Callable[[], Any]]:
    path, draw = folder / "points.npz", np.random.default_rng(0)
    TimedPoints(draw.random((8, 3)), draw.random((8, 3)), draw.random(8)).save(path)

    def read() -> Any:
        found = TimedPoints.load(path)
        return [found.positions, found.colors, found.times]

    return path, read


def run_table(folder: Path) -> tuple[Path, Callable[[], Any]]:
    write_table(folder / "run.json", {"recording": "/x", "seed": 3, "overrides": {"d2": {"seed": 1}}}, RUN)
    return folder / "run.json", lambda: read_run(folder)


def scores(folder: Path) -> tuple[Path, Callable[[], Any]]:
    table = {"test": {"psnr": 25.5}, "seconds": {"train": 1.0}, "gaussians": 3, "iterations": 4, "recording": "room"}
    table |= {"train_cameras": ["a"], "backbone": "b", "hooks": [], "made": {"commit": "c"}}
    write_table(folder / "metrics.json", table, METRICS)
    return folder / "metrics.json", lambda: read_metrics(folder)


FILES = (store_table, record, prior_map, checkpoint, points, run_table, scores)


def survives(file: Callable[[Path], tuple[Path, Callable[[], Any]]], folder: Path, count: int) -> tuple[int, int]:
    """(refused, read as written) of so many mutations; fails at the first that does anything else, and names it."""
    path, read = file(folder)
    whole, expected, refused = path.read_bytes(), leaves(read()), 0
    for seed in range(count):
        draw = random.Random(f"{file.__name__} {seed}")
        mutation = draw.choice(MUTATIONS)
        path.write_bytes(mutation(whole, draw))
        try:
            found = leaves(read())
        except D2Error as error:
            refused += 1
            told = str(error)
            assert "\n" not in told, (seed, mutation.__name__, told)
            assert len(told) < 1000, (seed, mutation.__name__, told)
        except Exception as error:
            raise AssertionError(f"seed {seed}, {mutation.__name__}: {error!r}") from error
        else:
            assert found == expected, (seed, mutation.__name__)
    return refused, count - refused


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.__name__)
def test_a_mutation_is_refused_or_means_the_same(file: Any, tmp_path: Path) -> None:
    refused, same = survives(file, tmp_path, FEW)
    assert refused > FEW // 2, "most mutations are seen"
    assert refused + same == FEW


@pytest.mark.slow
@pytest.mark.parametrize("file", FILES, ids=lambda file: file.__name__)
def test_two_thousand_mutations(file: Any, tmp_path: Path) -> None:
    assert sum(survives(file, tmp_path, MANY)) == MANY
