"""Cameras whose clocks are off: the shift is found, what is off costs nothing, and a resumed run is the same."""

from __future__ import annotations

import io
from dataclasses import replace

import pytest
import torch
from tiny import ALL_HOOKS, BACKBONES, DISTANCE, HEIGHT, WIDTH, make_model, make_trainer, make_views, parameters, same

from d2_plugin.backbones.clocks import Clocks, ClockSettings
from d2_plugin.backbones.trainer import Trainer, TrainSettings
from d2_plugin.protocol import View

FRAMES, LATE = 9, {"cam0": 0.0, "cam1": 0.0, "cam2": 1.0}
"""How many frames later than they are named the images of a camera were taken."""
LEARN = ClockSettings(learn=True, rate=0.02)


def views() -> list[View]:
    """The tiny cameras at nine instants within half a second."""
    cameras = make_views()[:3]
    step = 0.5 / (FRAMES - 1)
    return [replace(view, frame=frame, time=frame * step) for frame in range(FRAMES) for view in cameras]


class Moving:
    """A bright ball that crosses the textured plane, seen by cameras of which one is late."""

    def __init__(self) -> None:
        self.views = views()

    def image(self, index: int) -> torch.Tensor:
        """[H, W, 3] of the plane z = 3."""
        view = self.views[index]
        time = view.time + LATE[view.camera] * 0.5 / (FRAMES - 1)
        rows, columns = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
        x = (columns - view.K[0, 2]) / view.K[0, 0] * DISTANCE - view.T_camera_world[0, 3]
        y = (rows - view.K[1, 2]) / view.K[1, 1] * DISTANCE
        plane = torch.stack([torch.sin(3 * x), torch.cos(4 * y), torch.sin(2 * x + y)], -1) * 0.15 + 0.3
        ball = torch.exp(-((x - (4 * time - 1)) ** 2 + (y - 0.2) ** 2) / 0.08)
        return plane + 0.6 * ball[..., None]


def make_moving(iterations: int = 700, seed: int = 3, **model: object) -> Trainer:
    return Trainer(make_model(150, **model), Moving(), TrainSettings(iterations=iterations, seed=seed))


@pytest.mark.parametrize("backbone", BACKBONES)
def test_the_derivative_by_time_is_that_of_the_loss(backbone: str) -> None:
    model = make_model(150, backbone=backbone, clocks=LEARN, background=False)
    if backbone != "yang4d":
        model.deforms = True
        for value in model.field.parameters():  # a field that moves something
            value.data += 0.02 * torch.randn(value.shape, generator=torch.Generator().manual_seed(value.numel()))
    seen = views()
    model.look_at(seen, lambda index: torch.zeros(HEIGHT, WIDTH, 3))
    view = seen[13]
    goal = Moving().image(13)

    def loss(time: float) -> torch.Tensor:
        return (model.render(replace(view, time=time)).color - goal).square().sum()

    loss(view.time).backward()
    model.accumulate(view)
    felt = model.clocks.shifts[view.camera].grad.item() / model.clocks.frame
    step = 5e-4
    expected = (loss(view.time + step) - loss(view.time - step)).item() / (2 * step)
    assert felt == pytest.approx(expected, rel=0.1, abs=0.05)


def test_a_camera_that_is_a_frame_late_is_found() -> None:
    """So few Gaussians follow the ball that one run may find half a frame and another one a third too many."""
    late, apart = [], []
    for seed in range(3, 7):
        trainer = make_moving(seed=seed, clocks=LEARN)
        trainer.run()
        found = trainer.model.clocks.in_frames()
        late.append(found["cam2"] - (found["cam0"] + found["cam1"]) / 2)
        apart.append(abs(found["cam0"] - found["cam1"]))
    assert min(late) > 0.25
    assert sum(late) / len(late) == pytest.approx(1.0, abs=0.3)
    assert sum(apart) / len(apart) < 0.3


def test_clocks_that_agree_stay() -> None:
    trainer = make_moving(600, clocks=LEARN)
    trainer.frames.image = lambda index: Moving.image(StandIn(trainer.frames.views), index)
    trainer.run()
    assert max(map(abs, trainer.model.clocks.in_frames().values())) < 0.3


class StandIn:
    """The same views, all as `cam0` has its clock."""

    def __init__(self, seen: list[View]) -> None:
        self.views = [replace(view, camera="cam0") for view in seen]


@pytest.mark.parametrize("backbone", BACKBONES)
def test_a_resumed_run_is_bitwise_the_uninterrupted_one(backbone: str) -> None:
    chosen = {"backbone": backbone, "clocks": replace(LEARN, begin=0.0)}
    whole, first = (make_trainer(ALL_HOOKS, **chosen) for _ in range(2))
    whole.run()
    first.run(until=17)
    buffer = io.BytesIO()
    torch.save(first.state_dict(), buffer)
    buffer.seek(0)
    second = make_trainer(ALL_HOOKS, seed=99, **chosen)
    second.load_state_dict(torch.load(buffer, weights_only=True))
    second.run()
    assert same(parameters(whole), parameters(second))
    assert whole.model.clocks.in_frames() == second.model.clocks.in_frames()
    assert any(whole.model.clocks.in_frames().values())


def test_clocks_that_have_not_begun_change_nothing() -> None:
    bare, waiting = make_trainer(ALL_HOOKS), make_trainer(ALL_HOOKS, clocks=replace(LEARN, begin=1.0))
    for trainer in (bare, waiting):
        trainer.run()
    assert same(parameters(bare), parameters(waiting))


def test_the_median_camera_keeps_its_clock_and_a_held_out_one_too() -> None:
    clocks = Clocks(LEARN)
    clocks.look_at(views())
    for camera, frames in {"cam0": 0.5, "cam1": 0.4, "cam2": 1.6}.items():
        clocks.shifts[camera].data.fill_(frames)
    assert clocks.in_frames() == pytest.approx({"cam0": 0.0, "cam1": -0.1, "cam2": 1.1})
    view = views()[0]
    assert clocks.time_of(replace(view, camera="held out")) == view.time
    assert clocks.time_of(replace(view, camera="cam2")) == pytest.approx(1.1 * 0.5 / (FRAMES - 1))
