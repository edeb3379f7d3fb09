"""Any mutation of a file that was kept: it is read as it was written, or refused with one sentence; nothing else."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fuzzing import SEED, mutate_file

from d2_plugin.durable import write_table
from d2_plugin.errors import D2Error
from d2_plugin.priors.fuse import FusedPrior
from d2_plugin.protocol import Label
from d2_plugin.runs.saved import METRICS, RUN, load_checkpoint, read_metrics, read_run, save_checkpoint
from d2_plugin.runs.start import TimedPoints
from d2_plugin.store.store import PriorStore

FEW, MANY = 40, 2000


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


def in_store(*name: str) -> Callable[[Path], tuple[Path, Callable[[], Any]]]:
    """One file of a prior store."""

    def file(folder: Path) -> tuple[Path, Callable[[], Any]]:
        path, read = a_store(folder)
        return path.joinpath(*name), read

    return file


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


FILES = {
    "store": in_store("store.json"),
    "record": in_store("priors", "a", "00000.json"),
    "prior": in_store("priors", "b", "00000.npy"),
    "checkpoint": checkpoint,
    "points": points,
    "run": run_table,
    "scores": scores,
}


def survives(name: str, folder: Path, count: int, first: int = 0) -> int:
    """How many mutations were refused, the others being read as written; fails at the first that is neither."""
    path, read = FILES[name](folder)
    whole, expected, refused = path.read_bytes(), leaves(read()), 0
    for seed in range(count):
        path.write_bytes(whole)
        mutate_file(path, random.Random(f"{name} {first + seed}"))
        try:
            found = leaves(read())
        except D2Error as error:
            refused, sentence = refused + 1, str(error)
            assert "\n" not in sentence, (seed, sentence)
            assert len(sentence) < 1000, (seed, sentence)
        except Exception as error:
            raise AssertionError(f"seed {seed}: {error!r}") from error
        else:
            assert found == expected, seed
    return refused


@pytest.mark.parametrize("name", FILES)
def test_a_mutation_is_refused_or_means_the_same(name: str, tmp_path: Path) -> None:
    assert survives(name, tmp_path, FEW) > FEW // 2, "most mutations are seen"


@pytest.mark.slow
@pytest.mark.parametrize("name", FILES)
def test_two_thousand_mutations(name: str, tmp_path: Path) -> None:
    survives(name, tmp_path, MANY, (SEED - 1) * MANY)
