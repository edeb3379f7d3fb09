"""What moves in the image lives as long as its instant; what stands still lives as the backbone lets it."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tiny import DISTANCE, HEIGHT, WIDTH, make_adapter, make_model, make_views
from torch import Tensor

from d2_plugin.config import DensifyConfig
from d2_plugin.hooks.densify import CHANGED, Densify, MovingPixels
from d2_plugin.hooks.hook import Context
from d2_plugin.hooks.prior import PriorLoader
from d2_plugin.protocol import DepthPrior, Label, Points, View

INTERVAL = 0.1
BAR = 2
"""Width of what moves, pixels."""


def instants(count: int, camera: str = "cam0") -> list[View]:
    """Views of a camera that stands still."""
    view = make_views()[0]
    return [replace(view, camera=camera, frame=frame, time=frame * INTERVAL) for frame in range(count)]


class Crossing:
    """A grey plane, known everywhere, and a white bar that goes on by its own width from instant to instant."""

    def __init__(self, flicker: float = 0, colors: bool = True) -> None:
        self.flicker, self.colors = flicker, colors

    def prior(self, camera: str, frame: int) -> DepthPrior:
        """D* of any view."""
        labels = torch.full((HEIGHT, WIDTH), int(Label.VERIFIED), dtype=torch.uint8)
        return DepthPrior(torch.full((HEIGHT, WIDTH), DISTANCE), labels, self.image(frame) if self.colors else None)

    def image(self, frame: int) -> Tensor:
        """uint8 [H, W, 3]."""
        grey = 100 + (self.flicker if frame % 2 else 0)
        image = torch.full((HEIGHT, WIDTH, 3), grey)
        image[:, BAR * frame : BAR * (frame + 1)] = 255
        return image.to(torch.uint8)


def context_of(store: Crossing, known: list[View], count: int = 1) -> Context:
    """What the hooks see at an evaluation once `known` was trained on."""

    def of(camera: str) -> list[View]:
        return [view for view in known if view.camera == camera]

    model = make_model(count=count)
    with torch.no_grad():
        model.gaussians["positions"][:, 2] = 50.0
    numbers = torch.Generator().manual_seed(0)
    return Context(1, make_adapter(model), (), PriorLoader(store), numbers, lambda: known[:1], of)


def bar(frame: int) -> Tensor:
    """Where the bar stands, bool [H, W]."""
    mask = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    mask[:, BAR * frame : BAR * (frame + 1)] = True
    return mask


@pytest.mark.parametrize("frame", [0, 3, 6])
def test_what_moves_has_the_interval_and_the_rest_has_no_end(frame: int) -> None:
    known = instants(7)
    found = MovingPixels().intervals(known[frame], context_of(Crossing(), known))
    torch.testing.assert_close(found, torch.where(bar(frame), INTERVAL, torch.inf))


def test_the_interval_is_that_of_the_instants_that_are_trained_on() -> None:
    known = instants(7)[::2]
    found = MovingPixels().intervals(known[0], context_of(Crossing(), known))
    torch.testing.assert_close(found.min(), torch.tensor(2 * INTERVAL))


@pytest.mark.parametrize(
    ("store", "known"),
    [
        (Crossing(colors=False), instants(7)),
        (Crossing(), instants(2)),
        (Crossing(flicker=2 * CHANGED), instants(7)),
        (Crossing(), [replace(v, T_camera_world=v.T_camera_world + v.frame) for v in instants(7)]),
    ],
    ids=["no colours", "two instants", "light that changes", "a camera that moves"],
)
def test_where_nothing_can_be_known_nothing_is_said(store: Crossing, known: list[View]) -> None:
    assert MovingPixels().intervals(known[1], context_of(store, known)) is None


@given(noise=st.integers(0, CHANGED))
def test_noise_is_no_motion(noise: int) -> None:
    known = instants(7)
    found = MovingPixels().intervals(known[5], context_of(Crossing(flicker=noise), known))
    torch.testing.assert_close(found, torch.where(bar(5), INTERVAL, torch.inf))


def test_a_later_run_of_the_same_state_finds_the_same() -> None:
    """The median is of the first instants seen, which the state of the hooks keeps: a resumed run has it again."""
    known = instants(7)
    whole, context = MovingPixels(), context_of(Crossing(), known)
    whole.intervals(known[0], context_of(Crossing(), known[:4]))
    torch.testing.assert_close(whole.intervals(known[2], context), MovingPixels().intervals(known[2], context))


class TestInsertion:
    def inserted(self, **settings: float | None) -> Points:
        known = instants(7)
        return Densify(DensifyConfig(spacing=2, **settings)).edit(context_of(Crossing(), known)).insert

    def test_points_of_the_bar_are_brief(self) -> None:
        points = self.inserted(lifetime=1.5)
        white = points.colors[:, 0] == 1
        assert white.any()
        assert not white.all()
        torch.testing.assert_close(points.lifetimes[white], torch.full((int(white.sum()),), 1.5 * INTERVAL))
        assert points.lifetimes[~white].isinf().all()

    def test_off_leaves_time_to_the_backbone(self) -> None:
        assert self.inserted(lifetime=None).lifetimes is None

    def test_a_backbone_with_extents_in_time_takes_them(self) -> None:
        model = make_model(count=4)
        points = self.inserted()
        with torch.no_grad():
            make_adapter(model).insert(points)
        extents = model.gaussians["log_time_scales"][4:].exp()
        own = (model.duration / 5) ** 0.5
        torch.testing.assert_close(extents, points.lifetimes.clamp(max=own).to(extents))

    @pytest.mark.parametrize("backbone", ["yang4d", "mlp"])
    @pytest.mark.parametrize("temporal", [True, False])
    def test_a_backbone_without_them_inserts_all_the_same(self, backbone: str, temporal: bool) -> None:
        model = make_model(count=4, backbone=backbone, temporal=temporal)
        points = self.inserted()
        with torch.no_grad():
            make_adapter(model).insert(points)
        assert len(model) == 4 + len(points.positions)


class TestPoints:
    def some(self, count: int, lifetimes: bool) -> Points:
        numbers = torch.arange(float(count))
        three = numbers[:, None].expand(-1, 3)
        return Points(three, three, numbers, numbers, numbers, numbers + 1 if lifetimes else None)

    def test_joined_and_selected_again_they_are_what_they_were(self) -> None:
        first, second = self.some(3, True), self.some(2, True)
        together = Points.joined([first, second])
        for part, rows in ((first, slice(0, 3)), (second, slice(3, 5))):
            again = together.select(torch.arange(5)[rows])
            assert all(torch.equal(a, b) for a, b in zip(again, part, strict=True))

    def test_without_a_lifetime_beside_one_with_it_has_no_end(self) -> None:
        together = Points.joined([self.some(2, False), self.some(1, True)])
        assert together.lifetimes.tolist() == [torch.inf, torch.inf, 1.0]
        assert Points.joined([self.some(2, False), self.some(1, False)]).lifetimes is None
