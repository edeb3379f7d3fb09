"""A background stands behind all Gaussians of the bundled backbones, D2 or not, and a finished run keeps its own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from tiny import make_model

from d2_plugin.backbones import yang4d
from d2_plugin.protocol import Label
from d2_plugin.recordings.export.folder import save_recording
from d2_plugin.recordings.synthetic.room import synthetic_recording
from d2_plugin.runs.evaluation import renderer
from d2_plugin.runs.run import Run
from d2_plugin.runs.settings import RunSettings
from d2_plugin.runs.start import TimedPoints
from d2_plugin.store.maps import FusedPrior
from d2_plugin.store.store import PriorStore

CAMERAS, FRAMES, HEIGHT, WIDTH = ("train0", "train1"), (0, 1), 54, 96
NO_POINTS = TimedPoints(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    recording = synthetic_recording(cameras=2, frames=2, width=WIDTH, height=HEIGHT)
    return save_recording(recording, tmp_path_factory.mktemp("scene") / "room")


def store(folder: Path, far_pixels: int = 0) -> Path:
    """A prior with so many far pixels in each image."""
    made = PriorStore.create(folder, list(CAMERAS), list(FRAMES), {"recording": "room"})
    for camera in CAMERAS:
        for frame in FRAMES:
            labels = np.full((HEIGHT, WIDTH), Label.VERIFIED, np.uint8)
            labels.flat[:far_pixels] = Label.FAR
            sigma = np.where(labels == Label.FAR, np.inf, 0.01).astype(np.float32)
            colors = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
            prior = FusedPrior(np.full((HEIGHT, WIDTH), 3, np.float32), labels, sigma, colors)
            made.write(camera, frame, prior, {"key": "k", "shares": prior.shares()})
    return folder


def run_of(scene: Path, folder: Path, priors: Path | None, **changes: object) -> Run:
    chosen = {"priors": None if priors is None else str(priors), "iterations": 4} | changes
    return Run(RunSettings(str(scene), CAMERAS, **chosen), folder)


def trainer_of(run: Run) -> object:
    return run._trainer(NO_POINTS)


def test_it_begins_with_the_colours_of_the_images(scene: Path, tmp_path: Path) -> None:
    run = run_of(scene, tmp_path / "run", None, hooks=())
    model, recording = trainer_of(run).model, run.scene.recording
    for camera in CAMERAS:
        shown = renderer(model, recording, "cpu")(camera, 0)[0]
        mean = torch.from_numpy(recording.image(camera, 0)).float().mean((0, 1)) / 255
        torch.testing.assert_close(shown.mean((0, 1)), mean, atol=0.1, rtol=0)


def test_a_backbone_of_somebody_else_is_not_asked_for_what_it_need_not_know(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = run_of(scene, tmp_path / "run", store(tmp_path / "priors"))
    given = []
    monkeypatch.setattr(yang4d, "create", lambda *points, **options: given.append(options) or make_model())
    trainer_of(run)
    assert given[0]["settings"] == {}


def test_a_finished_run_keeps_it_whatever_became_of_its_prior_and_renders_held_out_cameras_with_it(
    scene: Path, tmp_path: Path
) -> None:
    run = run_of(scene, tmp_path / "run", store(tmp_path / "priors", HEIGHT * WIDTH // 2))
    NO_POINTS.save(run.folder / "points.npz")
    trainer = trainer_of(run)
    trainer.run()
    run._save(trainer)
    (tmp_path / "priors" / "store.json").write_text('{"format": 0}')
    finished = Run.load(run.folder)
    assert finished.evaluate(images=False)["background"] is True
    model = finished.trained().model
    assert model.background.constant.detach().any()
    render = renderer(model, finished.scene.recording, "cpu")
    color, depth = render("test0", 0)
    model.background = None
    without, same_depth = render("test0", 0)
    assert not torch.equal(color, without)
    assert torch.equal(depth, same_depth)
