"""`d2 train` gives the backbone a background exactly where the depth prior found far pixels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from tiny import make_model

from d2_plugin.backbones import yang4d
from d2_plugin.captures.export.folder import save_capture
from d2_plugin.captures.synthetic.room import synthetic_capture
from d2_plugin.errors import D2Error
from d2_plugin.priors.fuse import FusedPrior
from d2_plugin.priors.store import PriorStore
from d2_plugin.protocol import Label
from d2_plugin.runs.run import FAR_SHARE, Run
from d2_plugin.runs.settings import RunSettings
from d2_plugin.runs.start import TimedPoints

CAMERAS, FRAMES, HEIGHT, WIDTH = ("train0", "train1"), (0, 1), 54, 96
PIXELS = HEIGHT * WIDTH
NO_POINTS = TimedPoints(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))


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
    return run._trainer(NO_POINTS)


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
def test_the_mean_share_of_far_pixels_decides(scene: Path, tmp_path: Path, far: dict[str, int], expected: bool) -> None:
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


def test_cameras_that_the_prior_does_not_know_are_no_evidence(scene: Path, tmp_path: Path) -> None:
    priors = store(tmp_path / "priors", {"train0": PIXELS})
    assert run_of(scene, tmp_path / "run", priors)._sees_far()


def test_without_a_prior_there_is_none(scene: Path, tmp_path: Path) -> None:
    run = run_of(scene, tmp_path / "run", None, hooks=())
    assert not run._sees_far()
    assert trainer_of(run).model.background is None


def test_a_user_decides_otherwise(scene: Path, tmp_path: Path) -> None:
    sky = store(tmp_path / "sky", dict.fromkeys(CAMERAS, PIXELS))
    off = run_of(scene, tmp_path / "off", sky, overrides={"backbone": {"background": False}})
    on = run_of(scene, tmp_path / "on", None, hooks=(), overrides={"backbone": {"background": True}})
    assert trainer_of(off).model.background is None
    assert trainer_of(on).model.background is not None


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
        with pytest.raises(D2Error, match="has format 0"):
            trained._sees_far()
        model = trained.trained().model
        assert model.background is not None
        assert trained.evaluate(pictures=False)["background"] is True
        assert model.background.constant.detach().any()

    def test_the_exported_files_hold_the_gaussians_alone(self, trained: Run) -> None:
        paths = trained.export_ply()
        assert [path.name for path in paths] == ["frame_00000.ply", "frame_00001.ply"]
        count = len(trained.trained().model)
        assert all(b"element vertex" in path.read_bytes()[:200] for path in paths)
        assert all(path.stat().st_size < 17 * 4 * count + 1000 for path in paths)

    def test_a_held_out_camera_is_rendered_with_it(self, trained: Run) -> None:
        model = trained.trained().model
        color, depth = trained._renderer(model)("test0", 0)
        model.background = None
        without, same_depth = trained._renderer(model)("test0", 0)
        assert not torch.equal(color, without)
        assert torch.equal(depth, same_depth)
