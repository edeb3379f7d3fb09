"""`d2 train` gives the backbone a background exactly where the depth prior found far pixels."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
import torch

from d2_plugin.backbones.yang4d import Yang4D
from d2_plugin.captures.synthetic.room import synthetic_capture
from d2_plugin.captures.export.folder import save_capture
from d2_plugin.errors import D2Error
from d2_plugin.priors.fuse import FusedPrior
from d2_plugin.priors.store import PriorStore
from d2_plugin.protocol import Label
from d2_plugin.runs.gaussian_ply import write_ply
from d2_plugin.runs.run import FAR_SHARE, Run
from d2_plugin.runs.settings import RunSettings
from d2_plugin.runs.start import TimedPoints

CAMERAS, FRAMES, HEIGHT, WIDTH = ("train0", "train1"), (0, 1), 54, 96
PIXELS = HEIGHT * WIDTH


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    capture = synthetic_capture(cameras=2, frames=2, width=WIDTH, height=HEIGHT)
    return save_capture(capture, tmp_path_factory.mktemp("scene") / "room")


def store(folder: Path, far_pixels: dict[str, int], frames: tuple[int, ...] = FRAMES) -> Path:
    """A prior with so many far pixels in each camera's pictures."""
    made = PriorStore.create(folder, list(far_pixels), list(FRAMES), {"capture": "room"})
    for camera, count in far_pixels.items():
        for frame in frames:
            labels = np.full((HEIGHT, WIDTH), Label.VERIFIED, np.uint8)
            labels.flat[:count] = Label.FAR
            sigma = np.where(labels == Label.FAR, np.inf, 0.01).astype(np.float32)
            colors = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
            prior = FusedPrior(np.full((HEIGHT, WIDTH), 3, np.float32), labels, sigma, colors)
            made.write(camera, frame, prior, {"key": "k", "shares": prior.shares()})
    return folder


def run_of(scene: Path, folder: Path, priors: Path | None, **changes: object) -> Run:
    chosen = {"priors": None if priors is None else str(priors), "iterations": 4} | changes
    return Run(RunSettings(str(scene), CAMERAS, **chosen), folder)


def trainer_of(run: Run) -> object:
    return run._trainer(TimedPoints(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)), attach=False)


@pytest.mark.parametrize(
    ("far", "expected"),
    [
        ({"train0": 0, "train1": 0}, False),
        ({"train0": int(FAR_SHARE * PIXELS), "train1": int(FAR_SHARE * PIXELS)}, False),
        ({"train0": int(2.1 * FAR_SHARE * PIXELS) + 1, "train1": 0}, True),
        ({"train0": PIXELS, "train1": PIXELS}, True),
    ],
    ids=["no sky", "too little", "one camera sees it", "nothing else"],
)
def test_the_mean_share_of_far_pixels_decides(
    scene: Path, tmp_path: Path, far: dict[str, int], expected: bool
) -> None:
    run = run_of(scene, tmp_path / "run", store(tmp_path / "priors", far))
    assert run._sees_far() is expected
    assert (trainer_of(run).model.background is not None) is expected


def test_only_training_cameras_count(scene: Path, tmp_path: Path) -> None:
    priors = store(tmp_path / "priors", {"train0": 0, "train1": 0, "test0": PIXELS})
    assert not run_of(scene, tmp_path / "run", priors)._sees_far()


def test_frames_without_a_prior_are_no_evidence(scene: Path, tmp_path: Path) -> None:
    priors = store(tmp_path / "priors", dict.fromkeys(CAMERAS, PIXELS // 100), frames=(1,))
    assert run_of(scene, tmp_path / "run", priors)._sees_far()
    nothing = store(tmp_path / "empty", dict.fromkeys(CAMERAS, PIXELS), frames=())
    assert not run_of(scene, tmp_path / "other", nothing)._sees_far()


def test_a_store_for_other_cameras_or_frames_is_asked_for_what_it_has(scene: Path, tmp_path: Path) -> None:
    priors = store(tmp_path / "priors", {"train0": PIXELS})
    assert run_of(scene, tmp_path / "run", priors, train_cameras=("train0",))._sees_far()


def test_without_a_prior_there_is_none(scene: Path, tmp_path: Path) -> None:
    run = run_of(scene, tmp_path / "run", None, hooks=())
    assert not run._sees_far()
    assert trainer_of(run).model.background is None


def test_a_user_decides_otherwise(scene: Path, tmp_path: Path) -> None:
    sky = store(tmp_path / "sky", dict.fromkeys(CAMERAS, PIXELS))
    off = run_of(scene, tmp_path / "off", sky, overrides={"backbone": {"background": False}})
    on = run_of(scene, tmp_path / "on", None, overrides={"backbone": {"background": True}})
    assert trainer_of(off).model.background is None
    assert trainer_of(on).model.background is not None
