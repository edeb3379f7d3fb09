"""What a run keeps: a damaged file is one sentence, a run that diverged stops, a second writer is refused."""

import io
import itertools
import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from refusals import refuses
from tiny import ALL_HOOKS, make_model, make_trainer

from d2_plugin.backbones import model
from d2_plugin.commands.cli import main
from d2_plugin.durable import read_table, write_archive
from d2_plugin.errors import D2Error
from d2_plugin.hooks.finite import Diverged
from d2_plugin.locks import only_writer
from d2_plugin.runs import run as run_module
from d2_plugin.runs.evaluation import renderer
from d2_plugin.runs.run import Run
from d2_plugin.runs.saved import load_checkpoint, read_metrics, save_checkpoint, watched, what_diverged
from d2_plugin.runs.settings import RunSettings
from d2_plugin.runs.shared import COST, share
from d2_plugin.runs.start import TimedPoints
from d2_plugin.store.store import PriorStore

pytest.importorskip("cv2")


@pytest.fixture(scope="module")
def scene(saved_room: Callable[..., Path]) -> Path:
    return saved_room(cameras=2, frames=2, width=48, height=27)


def bare(scene: Path, folder: Path, **changes: Any) -> Run:
    """A run of the backbone alone that takes a second."""
    run = Run(RunSettings(str(scene), ("train0", "train1"), **({"iterations": 4, "hooks": ()} | changes)), folder)
    if not (folder / "points.npz").exists():
        TimedPoints(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)).save(folder / "points.npz")
    return run


@pytest.fixture(scope="module")
def finished(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = bare(scene, tmp_path_factory.mktemp("runs") / "bare")
    run.train()
    run.evaluate(images=False)
    return run.folder


@pytest.fixture
def copied(finished: Path, tmp_path: Path) -> Path:
    """A finished run that a test may damage."""
    return Path(shutil.copytree(finished, tmp_path / "copied"))


def written(path: Path, values: dict[str, Any]) -> None:
    """Values in the way in which checkpoints and points are written."""
    content = io.BytesIO()
    torch.save(values, content) if path.suffix == ".pt" else np.savez(content, **values)
    write_archive(path, content)


class TestADamagedFile:
    def test_a_checkpoint_of_another_version_is_named(self, copied: Path) -> None:
        for state, found in (({"step": 4}, "None"), ({"format": 9}, "9")):
            written(copied / "checkpoint.pt", state)
            refuses(f"has format {found} but this version reads format 1", Run.load(copied).evaluate, images=False)

    @pytest.mark.parametrize("state", [{}, {"d2": None}, {"d2": 3, "step": "a"}, {"d2": None, "model": {}, "step": 1}])
    def test_a_checkpoint_of_another_shape_is_told(self, copied: Path, state: dict[str, Any]) -> None:
        save_checkpoint(copied / "checkpoint.pt", state)
        refuses("cannot read the checkpoint .*: remove the file", Run.load(copied).evaluate, images=False)

    def test_points_of_another_shape_version_or_with_nan_are_told(self, tmp_path: Path) -> None:
        path = tmp_path / "points.npz"
        zeros = np.zeros((3, 3))
        for positions, reason, form in (
            (np.zeros((3, 2)), "shapes.*: delete the file, it will be made again", {"format": 1}),
            (np.full((3, 3), np.nan), "not finite.*: delete the file, it will be made again", {"format": 1}),
            (np.zeros((3, 3), "U3"), "cannot read points from .*: delete the file", {"format": 1}),
            (np.zeros((3, 3), "O"), "cannot read points from .*: delete the file", {"format": 1}),
            (zeros, "format None, expected 1", {}),
        ):
            written(path, {"positions": positions, "colors": zeros, "times": np.zeros(3), **form})
            refuses(reason, TimedPoints.load, path)


class TestARunThatDiverges:
    def test_large_finite_numbers_are_no_divergence(self) -> None:
        model = make_model()
        model.gaussians["positions"].data.fill_(3e38)
        assert not what_diverged(model)
        assert what_diverged(model, torch.tensor(math.inf)) == "the loss is inf"
        assert what_diverged(model, torch.tensor(math.nan)) == "the loss is nan"

    def test_stops_at_the_step_with_the_parameter_and_the_checkpoint(self, tmp_path: Path) -> None:
        trainer = make_trainer(ALL_HOOKS)

        def poison(step: int, loss: float) -> None:
            if step == 4:
                trainer.model.gaussians["opacity_logits"].data[3] = math.nan

        trainer.run(2)
        kept = r"checkpoint.pt, step 2; lower"

        def trained() -> None:
            with watched(trainer, tmp_path / "checkpoint.pt") as check:
                trainer.run(20, lambda step, loss: (check(step, loss), poison(step, loss)))

        refuses(rf"diverged at step 5 \(.* of \S+ is NaN or infinite\): .*{kept}", trained, error=Diverged)

    def test_an_error_that_comes_of_it_is_reported_as_it(self, tmp_path: Path) -> None:
        def fails(trainer: SimpleNamespace, message: str) -> None:
            with watched(trainer, tmp_path / "checkpoint.pt"):
                raise RuntimeError(message)

        trainer = SimpleNamespace(model=make_model(), step=0)
        with pytest.raises(RuntimeError, match="out of memory"):
            fails(trainer, "out of memory")
        trainer.model.gaussians["positions"].data.fill_(math.nan)
        refuses("diverged at step 0 .*there is no checkpoint yet", fails, trainer, "contains nan", error=Diverged)

    def test_exits_with_one_sentence_and_is_not_saved(self, scene: Path, tmp_path: Path, refused, monkeypatch) -> None:
        monkeypatch.setattr(model, "TIME_RATE", math.inf)
        words = ["train", str(scene), "--train-cameras", "train0,train1", "--hooks", "none", "--iterations", "20"]
        told = refused(*words, "--plan.temporal", "true", "--output", str(tmp_path / "run")).splitlines()[-1]
        assert told.startswith("d2: training diverged at step ")
        assert not (tmp_path / "run" / "metrics.json").exists()
        state = load_checkpoint(tmp_path / "run" / "checkpoint.pt", "cpu")
        assert state is None or all(value.isfinite().all() for value in state["model"]["parameters"].values())

    def test_is_not_scored(self, copied: Path) -> None:
        state = load_checkpoint(copied / "checkpoint.pt", "cpu")
        state["model"]["parameters"]["positions"][1:] = math.nan
        save_checkpoint(copied / "checkpoint.pt", state)
        told = r"diverged before step 4 \(99.* of positions is NaN or infinite\)"
        refuses(told, Run.load(copied).evaluate, images=False)


def test_a_second_trainer_is_refused(scene: Path, tmp_path: Path) -> None:
    run = bare(scene, tmp_path / "run")
    with only_writer(run.folder):
        for second in (bare(scene, tmp_path / "run"), Run.load(run.folder)):
            refuses("another process is writing .*: wait until it has ended", second.train)
            refuses("another process is writing", second.evaluate)
    run.train()
    run.train()


class TestThePriorOfARun:
    """A relative map and one camera: nothing gives its scale, so no view has a prior."""

    def words(self, scene: Path, output: Path, *more: str) -> list[str]:
        one = ("--train-cameras", "train0", "--iterations", "4")
        return ["train", str(scene), *one, "--output", str(output), *more]

    def test_none_at_all_is_an_error(self, scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(self.words(scene, tmp_path / "run")) == 2
        captured = capsys.readouterr()
        assert "d2: no view has a usable prior (2x " in captured.err
        assert "--accept-empty-prior" in captured.err
        assert "0 priors built" not in captured.out
        assert "2 priors built, 0 kept\ncamera " in captured.out, "what the prior became is said before"
        assert not (tmp_path / "run" / "checkpoint.pt").exists()

    def test_unless_it_is_asked_for(self, scene: Path, tmp_path: Path, answered) -> None:
        last = answered(*self.words(scene, tmp_path / "run", "--accept-empty-prior")).splitlines()[-1]
        assert last.startswith("prior: 0 of 2 views are usable; none of camera train0; maps refused 2x ")
        prior = read_metrics(tmp_path / "run")["prior"]
        assert prior["headline"] == last
        assert [refusal["frame"] for refusal in prior["refused"]] == [0, 1]
        assert main(["eval", str(tmp_path / "run"), "--no-images"]) == 0
        assert read_metrics(tmp_path / "run")["prior"] == prior

    @pytest.fixture
    def second(self, monkeypatch: pytest.MonkeyPatch) -> Mock:
        """Called when the first of the two views is finished."""
        second, write = Mock(), PriorStore.write
        steps = itertools.cycle([lambda: None, second])
        monkeypatch.setattr(PriorStore, "write", lambda *given: (next(steps)(), write(*given)))
        return second

    def test_time_of_finished_views_outlives_a_process_that_is_killed(self, scene, tmp_path, second) -> None:
        settings = RunSettings(str(scene), ("train0",), hooks=("depth_loss",), accept_empty_prior=True)
        run, left = Run(settings, tmp_path / "run"), tmp_path / "left"
        second.side_effect = lambda: shutil.copytree(run.folder, left)  # a process that is killed leaves no more
        run.prepare()
        again = Run(settings, left)
        assert 0 < again.seconds["priors"] < run.seconds["priors"]
        assert 0 < again.cpu_seconds["priors"] < run.cpu_seconds["priors"]
        before = again.seconds["priors"]
        second.side_effect = None
        again.prepare()
        assert again.seconds["priors"] > before

    def test_time_of_a_shared_one_is_that_of_all_its_parts(self, scene, tmp_path, second) -> None:
        settings = RunSettings(str(scene), ("train0",))
        second.side_effect = KeyboardInterrupt
        with pytest.raises(KeyboardInterrupt):
            share(settings, tmp_path)
        points, first = (read_table(path, COST)["seconds"] for path in sorted(tmp_path.rglob("*.seconds.json")))
        second.side_effect = None
        assert share(settings, tmp_path).seconds > points + first

    def test_a_shared_one_that_another_process_makes_is_not_counted_in_part(self, scene, tmp_path) -> None:
        settings = RunSettings(str(scene), ("train0",))
        with only_writer(tmp_path):
            refuses("another process is writing", share, settings, tmp_path)
        share(settings, tmp_path)


def test_a_run_whose_prior_is_empty_goes_on_as_its_refusal_proposes(scene, tmp_path) -> None:
    settings = RunSettings(str(scene), ("train0",), iterations=2, hooks=("depth_loss",))
    refuses("by --accept-empty-prior", Run(settings, tmp_path / "run").train)
    Run(replace(settings, accept_empty_prior=True), tmp_path / "run").train()


def test_a_run_goes_on_from_the_checkpoint_before_one_that_cannot_be_written(scene, tmp_path, monkeypatch) -> None:
    run = bare(scene, tmp_path / "run", iterations=6)
    save, saved = run_module.saved.save_checkpoint, []

    def full(path: Path, state: Any) -> None:
        if len(saved) == 3:
            raise D2Error("cannot write")
        saved.append(state["step"])
        save(path, state)

    with monkeypatch.context() as patch:
        patch.setattr(run_module.saved, "save_checkpoint", full)
        saved[:] = [0, 0, 0]
        refuses("cannot write", run.train)
        assert bare(scene, run.folder, iterations=6).seconds["priors"] == run.seconds["priors"] > 0, "kept meanwhile"
        saved.clear()
        refuses("cannot write", run.train)
    assert load_checkpoint(run.folder / "checkpoint.pt", "cpu")["step"] == 3
    saved.clear()
    monkeypatch.setattr(run_module.saved, "save_checkpoint", lambda path, state: saved.append(state["step"]))
    bare(scene, tmp_path / "run", iterations=6).train()
    assert saved == [4, 5, 6], "it goes on from there"


def test_a_background_begins_with_the_colours_of_the_images(scene: Path, tmp_path: Path) -> None:
    run = bare(scene, tmp_path / "run")
    model, recording = run._trainer(TimedPoints.load(run.folder / "points.npz")).model, run.scene.recording
    for camera in ("train0", "train1"):
        shown = renderer(model, recording, "cpu")(camera, 0)[0]
        mean = torch.from_numpy(recording.image(camera, 0)).float().mean((0, 1)) / 255
        torch.testing.assert_close(shown.mean((0, 1)), mean, atol=0.1, rtol=0)
