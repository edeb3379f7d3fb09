"""A background stands behind all Gaussians of the bundled backbones, D2 or not, and a finished run keeps its own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from tiny import make_model

from d2_plugin.backbones import yang4d
from d2_plugin.priors.fuse import FusedPrior
from d2_plugin.protocol import Label
from d2_plugin.recordings.export.folder import save_recording
from d2_plugin.recordings.synthetic.room import synthetic_recording
from d2_plugin.runs.evaluation import renderer
from d2_plugin.runs.run import Run
from d2_plugin.runs.settings import RunSettings
from d2_plugin.runs.start import TimedPoints
from d2_plugin.store.store import PriorStore

CAMERAS, FRAMES, HEIGHT, WIDTH = ("train0", "train1"), (0, 1), 54, 96
PIXELS = HEIGHT * WIDTH
NO_POINTS = TimedPoints(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    recording = synthetic_recording(cameras=2, frames=2, width=WIDTH, height=HEIGHT)
    return save_recording(recording, tmp_path_factory.mktemp("scene") / "room")


def store(folder: Path, far_pixels: dict[str, int], frames: tuple[int, ...] = FRAMES) -> Path:
    """A prior with so many far pixels in each camera's images."""
    made = PriorStore.create(folder, list(far_pixels), list(FRAMES), {"recording": "room"})
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
    return run._trainer(NO_POINTS)


@pytest.mark.parametrize("hooks", [(), ("prior", "depth_loss")], ids=["bare", "with D2"])
def test_there_is_one_with_and_without_d2_so_that_runs_compare(
    scene: Path, tmp_path: Path, hooks: tuple[str, ...]
) -> None:
    run = run_of(scene, tmp_path / "run", store(tmp_path / "priors", dict.fromkeys(CAMERAS, 0)), hooks=hooks)
    assert trainer_of(run).model.background is not None


def test_it_begins_with_the_colours_of_the_images(scene: Path, tmp_path: Path) -> None:
    run = run_of(scene, tmp_path / "run", None, hooks=())
    model, recording = trainer_of(run).model, run.scene.recording
    for camera in CAMERAS:
        shown = renderer(model, recording, "cpu")(camera, 0)[0]
        mean = torch.from_numpy(recording.image(camera, 0)).float().mean((0, 1)) / 255
        torch.testing.assert_close(shown.mean((0, 1)), mean, atol=0.1, rtol=0)


def test_a_user_decides_otherwise(scene: Path, tmp_path: Path) -> None:
    off = run_of(scene, tmp_path / "off", None, hooks=(), overrides={"backbone": {"background": False}})
    assert trainer_of(off).model.background is None


def test_a_backbone_of_somebody_else_is_not_asked_for_what_it_need_not_know(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = run_of(scene, tmp_path / "run", store(tmp_path / "priors", dict.fromkeys(CAMERAS, 0)))
    given = []
    monkeypatch.setattr(yang4d, "create", lambda *points, **options: given.append(options) or make_model())
    trainer_of(run)
    assert given[0]["settings"] == {}


class TestAFinishedRun:
    @pytest.fixture
    def trained(self, scene: Path, tmp_path: Path) -> Run:
        """Trained with a sky, and its prior damaged afterwards."""
        run = run_of(scene, tmp_path / "run", store(tmp_path / "priors", dict.fromkeys(CAMERAS, PIXELS // 2)))
        NO_POINTS.save(run.folder / "points.npz")
        trainer = trainer_of(run)
        trainer.run()
        run._save(trainer)
        (tmp_path / "priors" / "store.json").write_text('{"format": 0}')
        return Run.load(run.folder)

    def test_the_checkpoint_says_whether_there_is_a_background(self, trained: Run) -> None:
        model = trained.trained().model
        assert model.background is not None
        assert trained.evaluate(images=False)["background"] is True
        assert model.background.constant.detach().any()

    def test_a_held_out_camera_is_rendered_with_it(self, trained: Run) -> None:
        model = trained.trained().model
        render = renderer(model, trained.scene.recording, "cpu")
        color, depth = render("test0", 0)
        model.background = None
        without, same_depth = render("test0", 0)
        assert not torch.equal(color, without)
        assert torch.equal(depth, same_depth)
