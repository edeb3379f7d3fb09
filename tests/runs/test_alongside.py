"""A prior that is built in step with training: nothing is trained on before its time, and the clock decides nothing."""

from __future__ import annotations

import math
import multiprocessing
import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tiny import make_trainer, parameters, same

from d2_plugin.config import D2Config
from d2_plugin.errors import D2Error
from d2_plugin.recordings.export.folder import save_recording
from d2_plugin.recordings.synthetic.room import synthetic_recording
from d2_plugin.runs.prior.alongside import MOST_FIRST, OPEN_BY, PriorAlongside, frames_open
from d2_plugin.runs.run import Run
from d2_plugin.runs.settings import RunSettings
from d2_plugin.runs.start import TrainingFrames
from d2_plugin.store.store import PriorStore

CAMERAS, FRAMES, STEPS = ("train0", "train1"), 4, 20


class TestTheSchedule:
    @given(iterations=st.integers(1, 10**6), frames=st.integers(1, 3000), at=st.floats(0, 1))
    def test_frames_join_and_none_leaves(self, iterations: int, frames: int, at: float) -> None:
        step = 1 + int(at * (iterations - 1))
        now, later = (frames_open(s, iterations, frames) for s in (step, step + 1))
        assert 1 <= frames_open(1, iterations, frames) <= now <= later <= frames

    @given(iterations=st.integers(1, 10**6), frames=st.integers(1, 3000))
    def test_all_have_joined_after_a_fifth_of_the_steps(self, iterations: int, frames: int) -> None:
        assert frames_open(math.ceil(OPEN_BY * iterations), iterations, frames) == frames

    def test_a_long_recording_begins_with_one_block(self) -> None:
        assert frames_open(1, 30_000, 3000) == MOST_FIRST
        assert frames_open(1, 30_000, 1) == 1


class Opening:
    """What stands in for the frames of a trainer: the first `first` views until `step`, all of them from then on."""

    def __init__(self, trainer: object, first: int, step: int) -> None:
        self.frames, self.first, self.step = trainer.frames, first, step
        self.views, self.drawn = trainer.frames.views, []

    def opened(self, step: int) -> int:
        return self.first if step < self.step else len(self.views)

    def image(self, index: int) -> torch.Tensor:
        self.drawn.append(index)
        return self.frames.image(index)


class TestTheTrainer:
    def test_draws_from_what_is_open_and_begins_a_round_with_what_joins(self) -> None:
        trainer = make_trainer(D2Config(), iterations=40)
        frames = trainer.frames = Opening(trainer, first=2, step=8)
        trainer.run(7)
        assert set(frames.drawn) == {0, 1}
        frames.drawn.clear()
        trainer.run(7 + len(frames.views))
        assert sorted(frames.drawn) == list(range(len(frames.views)))

    def test_with_everything_open_is_the_one_that_never_asks(self) -> None:
        asking, plain = make_trainer(D2Config(), iterations=12), make_trainer(D2Config(), iterations=12)
        asking.frames = Opening(asking, first=len(asking.frames.views), step=0)
        asking.run()
        plain.run()
        assert same(parameters(asking), parameters(plain))


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("cv2", reason="opencv is in the `image` extra")
    pytest.importorskip("pycolmap", reason="pycolmap is in the `stereo` extra")
    recording = synthetic_recording(cameras=2, held_out=1, frames=FRAMES, width=96, height=54, arc_degrees=20)
    return save_recording(recording, tmp_path_factory.mktemp("recording") / "room")


def run_of(room: Path, folder: Path, **changes: object) -> Run:
    return Run(RunSettings(str(room), CAMERAS, **({"iterations": STEPS, "priors_in_step": True} | changes)), folder)


def model_of(run: Run) -> dict[str, torch.Tensor]:
    return torch.load(run.folder / "checkpoint.pt", weights_only=True)["model"]["parameters"]


@pytest.fixture(scope="module")
def finished(room: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    run = run_of(room, tmp_path_factory.mktemp("runs") / "in_step")
    run.train()
    return run


class TestARun:
    def test_has_the_prior_that_is_built_first(self, room: Path, finished: Run, tmp_path: Path) -> None:
        first = run_of(room, tmp_path / "first", priors_in_step=False)
        first.prepare()
        stores = [PriorStore.open(run.priors) for run in (first, finished)]
        for camera in CAMERAS:
            for frame in range(FRAMES):
                both = [store.prior(camera, frame) for store in stores]
                assert all(torch.equal(a, b) for a, b in zip(*both) if a is not None)
        assert finished.prior == first.prior
        assert finished.seconds["priors"] > 0
        assert finished.cpu_seconds["priors"] > 0

    def test_continues_bitwise_where_it_was_cut_off(self, room: Path, finished: Run, tmp_path: Path) -> None:
        class Cut(Exception):
            pass

        def watch(trainer: object) -> Callable[[int, float], None]:
            def look(step: int, loss: float) -> None:
                if step == 3:  # a frame joins in the next
                    raise Cut

            return look

        priors = str(finished.folder / "priors")
        with pytest.raises(Cut):
            run_of(room, tmp_path / "cut", priors=priors).train(watch=watch)
        assert not multiprocessing.active_children()
        resumed = run_of(room, tmp_path / "cut", priors=priors)
        resumed.train()
        assert same(model_of(finished), model_of(resumed))

    def test_without_a_usable_prior_is_refused(self, tmp_path: Path) -> None:
        pytest.importorskip("pycolmap", reason="pycolmap is in the `stereo` extra")
        blind = save_recording(synthetic_recording(cameras=2, frames=2, width=64, height=36), tmp_path / "blind")
        settings = RunSettings(str(blind), ("train0", "train1"), iterations=STEPS, priors_in_step=True)
        run = Run(settings, tmp_path / "run")
        with pytest.raises(D2Error, match="no view has a usable prior"):
            run.train()
        assert not multiprocessing.active_children()


class TestTheProcess:
    def building(self, room: Path, folder: Path, **changes: object) -> PriorAlongside:
        run = run_of(room, folder / "run", **changes)
        return PriorAlongside(run.settings, run.scene, folder / "priors", run._points().positions)

    def test_that_is_killed_is_one_sentence(self, room: Path, tmp_path: Path) -> None:
        building = self.building(room, tmp_path)
        os.kill(building._process.pid, signal.SIGKILL)
        with pytest.raises(D2Error, match=r"ended with code -9: the same command goes on where it stopped"):
            building.finish()

    def test_tells_what_the_build_refuses(self, room: Path, tmp_path: Path) -> None:
        (tmp_path / "priors").mkdir()
        (tmp_path / "priors" / "notes.txt").write_text("mine")
        building = self.building(room, tmp_path)
        with pytest.raises(D2Error, match="is not empty and holds no prior store"):
            building.wait(1)
        building.end()


class Awaited:
    def __init__(self) -> None:
        self.asked: list[int] = []

    def opened(self, step: int) -> int:
        return 1

    def wait_for(self, frame: int) -> None:
        self.asked.append(frame)


def test_a_trainer_that_draws_without_asking_waits_for_the_frame() -> None:
    frames = TrainingFrames(synthetic_recording(cameras=2, frames=3, width=32, height=18), ("train0", "train1"))
    frames.image(4)
    frames.awaited = Awaited()
    assert frames.opened(1) == 1
    frames.image(5)
    assert frames.awaited.asked == [frames.views[5].frame]
