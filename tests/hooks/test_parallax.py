"""Parallax: what two cameras know is seen on the way from one to the other, unless something known hides it."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from test_motion import model_far_away
from tiny import WIDTH, TinyFrames, TinyStore, make_adapter, make_model, make_trainer, make_views, parameters, same
from torch import Tensor

from d2_plugin.backbones.model import SplatModel
from d2_plugin.config import D2Config, ParallaxConfig
from d2_plugin.hooks import parallax
from d2_plugin.hooks.hook import Context
from d2_plugin.hooks.parallax import Parallax, Side, in_sight, on_the_way
from d2_plugin.hooks.prior import PriorLoader
from d2_plugin.protocol import DepthPrior, Label, View

LEFT, MIDDLE, RIGHT = make_views()[:3]
"""The middle one is halfway between the others; from camera to camera the plane moves by four pixels."""
STEP = 4
KNOWN = WIDTH // 2
"""Columns of each view that are verified."""


def prior_of(view: View) -> DepthPrior:
    prior = TinyStore().prior(view.camera, view.frame)
    return prior._replace(depth=prior.depth.clone())


def seen_columns(own: DepthPrior, other: DepthPrior) -> list[int]:
    """The columns of the left view's first row that are seen halfway to the right one."""
    pixels, _ = in_sight(MIDDLE, Side(LEFT, own), Side(RIGHT, other))
    return [int(pixel) for pixel in pixels if pixel < WIDTH]


def context_of(adapter: object, views: list[View], store: object | None = None, step: int = 4) -> Context:
    """Of a loss for the left view, once the given ones were trained on."""
    loader, generator = PriorLoader(store or TinyStore()), torch.Generator().manual_seed(0)
    return Context(step, adapter, [LEFT], loader, generator, beside=lambda view: views)


def loss_of(adapter: object, views: list[View], store: object | None = None, **changes: float) -> Tensor | None:
    return Parallax(ParallaxConfig(**changes)).loss(context_of(adapter, views, store))


def without_background(model: SplatModel) -> object:
    """The adapter of a trainer whose background is not known."""
    adapter = make_adapter(model)
    adapter.behind = None
    return adapter


def turned(degrees: float, x: float) -> View:
    """The left view at another place, turned about its vertical axis."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    pose = torch.eye(4)
    pose[:3, :3] = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    pose[:3, 3] = -pose[:3, :3] @ torch.tensor([float(x), 0, 0])
    return replace(LEFT, camera="turned", T_camera_world=pose)


def test_the_way_leads_from_one_camera_to_the_other() -> None:
    start, end = turned(0, -0.4), turned(90, 0.8)
    for part, angle, x in ((0, 0, -0.4), (0.5, 45, 0.2), (1, 90, 0.8)):
        pose = on_the_way(start, end, part).T_camera_world
        torch.testing.assert_close(pose, turned(angle, x).T_camera_world, atol=1e-6, rtol=0)
    assert on_the_way(LEFT, RIGHT, 0.5).camera == LEFT.camera  # its colours are those that this camera sees


@pytest.mark.parametrize("degrees", [0, 90, 179.99, 180])
def test_a_pose_on_the_way_is_a_rotation_however_far_apart_the_cameras_look(degrees: float) -> None:
    rotation = on_the_way(turned(0, 0), turned(degrees, 0), 0.5).T_camera_world[:3, :3]
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3), atol=1e-5, rtol=0)
    assert torch.linalg.det(rotation) > 0


def test_a_plane_that_both_know_is_seen_where_it_lies_from_there() -> None:
    pixels, places = in_sight(MIDDLE, Side(LEFT, prior_of(LEFT)), Side(RIGHT, prior_of(RIGHT)))
    columns, rows = pixels % WIDTH, pixels // WIDTH
    # Of the 16 columns that the left camera knows, the right one sees those from the eighth on, eight further left.
    assert columns.unique().tolist() == list(range(2 * STEP, KNOWN))
    assert rows.unique().tolist() == list(range(LEFT.height))
    torch.testing.assert_close(places, torch.stack([columns + 0.5 - STEP, rows + 0.5]), atol=1e-4, rtol=0)


def test_mono_only_pixels_are_not_taken_for_known() -> None:
    other = prior_of(RIGHT)
    other.labels[:] = Label.MONO
    assert not seen_columns(prior_of(LEFT), other)


def test_what_either_camera_knows_to_stand_before_it_hides_it() -> None:
    own, other = prior_of(LEFT), prior_of(RIGHT)
    own.depth[0, 15] /= 2  # moves by eight pixels from camera to camera: column 7 of the middle view
    assert seen_columns(own, other) == [8, 9, 13, 14]
    other.depth[0, 0] /= 2  # before the plane's column 8, and in column 8 of the middle view, before its 12
    assert seen_columns(prior_of(LEFT), other) == [9, 10, 14, 15]


def test_what_moves_may_hide_whatever_lies_behind_its_rays() -> None:
    """A person before the wall whose depth neither camera knows: he covers columns 8 to 11 from the middle."""
    moving = [torch.zeros(LEFT.height, WIDTH, dtype=torch.bool) for _ in range(2)]
    away = round(30 * 0.4 / 1.5)  # pixels that he moves by from camera to camera, at half the distance of the wall
    moving[0][:, 8 + away : 12 + away], moving[1][:, 8 - away : 12 - away] = True, True
    sides = [Side(view, prior_of(view), moved) for view, moved in zip((LEFT, RIGHT), moving)]
    pixels, places = in_sight(MIDDLE, *sides)
    columns = places[0].floor().unique().tolist()
    assert not {8, 9, 10, 11} & set(columns)
    assert {4, 5} <= set(columns)  # beside him
    everything, _ = in_sight(MIDDLE, *(side._replace(moving=None) for side in sides))
    assert len(pixels) < len(everything)
    one = [sides[0], sides[1]._replace(moving=torch.zeros_like(moving[1]))]
    assert len(in_sight(MIDDLE, *one)[0]) == len(everything)  # what one camera alone sees moving is not there


@pytest.mark.parametrize("cut", range(4))
def test_images_may_have_any_number_of_rows_and_columns(cut: int) -> None:
    """What moves is looked for in blocks of pixels: of 362 columns the last two stand in none that is whole."""
    left, middle, right = (replace(view, height=24 - cut, width=WIDTH - cut) for view in (LEFT, MIDDLE, RIGHT))
    seen = []
    for moves in (False, True):
        sides = []
        for view in (left, right):
            maps = [map_ if map_ is None else map_[: view.height, : view.width] for map_ in prior_of(view)]
            sides.append(Side(view, DepthPrior(*maps), torch.full((view.height, view.width), moves)))
        pixels, _ = in_sight(middle, *sides)
        (number,) = set(torch.bincount(pixels // left.width, minlength=left.height).tolist())  # of each row
        seen.append(number)
    assert seen[0] >= 2 * seen[1], "a person may stand before half of it"


@pytest.mark.parametrize(("share", "seen"), [(1.0, True), (1.3, True), (1.8, False), (0.9, False)])
def test_both_cameras_place_a_surface_within_a_pixel_or_so_of_each_other(share: float, seen: bool) -> None:
    other = prior_of(RIGHT)._replace(depth=share * prior_of(RIGHT).depth)
    assert bool(seen_columns(prior_of(LEFT), other)) == seen


@pytest.mark.parametrize("size", [1e-4, 1.0, 1e6])
@pytest.mark.parametrize("away", [0.0, 1e3])
def test_the_size_of_the_world_and_its_origin_do_not_matter(size: float, away: float) -> None:
    def moved(view: View) -> View:
        pose = view.T_camera_world.clone()
        pose[:3, 3] = size * (pose[:3, 3] - away)
        return replace(view, T_camera_world=pose)

    priors = [prior_of(view)._replace(depth=size * prior_of(view).depth) for view in (LEFT, RIGHT)]
    aside = on_the_way(moved(LEFT), moved(RIGHT), 0.5)
    pixels, places = in_sight(aside, Side(moved(LEFT), priors[0]), Side(moved(RIGHT), priors[1]))
    expected, there = in_sight(MIDDLE, Side(LEFT, prior_of(LEFT)), Side(RIGHT, prior_of(RIGHT)))
    common = torch.isin(pixels, expected)
    assert common.sum() > 0.8 * len(expected)  # float32 may lose a column at the edge
    torch.testing.assert_close(places[:, common], there[:, torch.isin(expected, pixels)], atol=0.02, rtol=0)


def test_views_in_float64_are_as_good() -> None:
    left, right = (replace(v, K=v.K.double(), T_camera_world=v.T_camera_world.double()) for v in (LEFT, RIGHT))
    adapter, context = make_adapter(make_model()), context_of(make_adapter(make_model()), [LEFT, RIGHT])
    doubled = replace(context, views=[left], beside=lambda view: [left, right], backbone=adapter)
    losses = [Parallax(ParallaxConfig()).loss(one) for one in (context, doubled)]
    torch.testing.assert_close(*losses, atol=1e-5, rtol=0)


def test_from_the_same_place_all_that_both_know_is_seen() -> None:
    twin = replace(LEFT, camera="twin")
    pixels, _ = in_sight(on_the_way(LEFT, twin, 0.5), Side(LEFT, prior_of(LEFT)), Side(twin, prior_of(LEFT)))
    assert len(pixels) == LEFT.height * KNOWN


def test_where_nothing_is_drawn_before_an_unknown_background_nothing_is_lost() -> None:
    adapter = without_background(model_far_away())
    assert float(loss_of(adapter, [LEFT, RIGHT]).detach()) == pytest.approx(0, abs=1e-6)


def test_what_floats_before_a_surface_gets_fainter() -> None:
    model = make_model(count=1, background=False)
    with torch.no_grad():
        model.gaussians["positions"][:] = torch.tensor([[-0.4, 0.0, 1.5]])  # in no known pixel of the left view
        model.gaussians["log_scales"].fill_(math.log(0.2))
        model.gaussians["base_colors"].fill_(1.7)
    loss = loss_of(without_background(model), [LEFT, RIGHT])
    loss.backward()
    assert float(loss.detach()) > 0.01
    assert model.gaussians["opacity_logits"].grad > 0


def test_a_background_learns_nothing_from_it() -> None:
    """It would take the colours of surfaces into directions that no camera sees: that cost one of studio 2 dB."""
    model = make_model()
    loss_of(make_adapter(model), [LEFT, RIGHT]).backward()
    assert model.gaussians["base_colors"].grad.any()
    assert model.background.constant.grad is None


def test_it_has_the_weight_that_was_asked_for() -> None:
    adapter = make_adapter(make_model())
    torch.testing.assert_close(loss_of(adapter, [LEFT, RIGHT], weight=6.0), 3 * loss_of(adapter, [LEFT, RIGHT]))
    assert loss_of(adapter, [LEFT, RIGHT], weight=0.0) is None


def test_all_other_cameras_come_in_turn() -> None:
    adapter, hook = make_adapter(make_model()), Parallax(ParallaxConfig(every=1))
    losses = {float(hook.loss(context_of(adapter, [LEFT, MIDDLE, RIGHT], step=step)).detach()) for step in range(8)}
    assert len(losses) == 4  # two cameras at two places on the way


def test_what_is_kept_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    trained = []
    for kept in (parallax.KEPT, 0):
        monkeypatch.setattr(parallax, "KEPT", kept)
        trainer = make_trainer(D2Config(parallax=ParallaxConfig()), iterations=12)
        trainer.run()
        trained.append(parameters(trainer))
    assert same(*trained)


class Lamp(TinyStore):
    """Images that are dark at two of five instants: what moves depends on how many of them are known."""

    def prior(self, camera: str, frame: int) -> DepthPrior:
        prior = super().prior(camera, frame)
        prior.colors[:, :12] = 90 * (frame not in (1, 2))
        return prior


def test_what_is_in_sight_follows_from_the_instants_that_are_known_and_not_from_when_it_was_asked() -> None:
    """Else a resumed run, which asks anew, would not be the uninterrupted one."""
    adapter, hook = make_adapter(make_model()), Parallax(ParallaxConfig())

    def context(known: int) -> Context:
        def instants(camera: str) -> list[View]:
            end = LEFT if camera == LEFT.camera else RIGHT
            return [replace(end, frame=frame, time=frame / 5) for frame in range(known)]

        return replace(context_of(adapter, [LEFT, RIGHT], Lamp()), instants=instants)

    first = hook.loss(context(3))
    later, anew = hook.loss(context(5)), Parallax(ParallaxConfig()).loss(context(5))
    assert torch.equal(later, anew)
    assert not torch.equal(first, later)
    (sight,) = hook._sights.values()  # of three instants nothing is kept any more, and nothing counts
    assert hook._bytes == 12 * len(sight[1][1])


LEFT_ALONE = SimpleNamespace(prior=lambda camera, *frame: prior_of(LEFT) if camera == LEFT.camera else None)


@pytest.mark.parametrize(
    ("views", "store"),
    [([LEFT], None), ([], None), ([LEFT, make_views()[5]], None), ([LEFT, RIGHT], LEFT_ALONE)],
    ids=["one camera", "cameras that move", "another instant", "no prior beside"],
)
def test_there_is_no_loss_where_nothing_is_known(views: list[View], store: object | None) -> None:
    assert loss_of(make_adapter(make_model()), views, store) is None


def test_a_backbone_without_colours_is_told_once(caplog: pytest.LogCaptureFixture) -> None:
    adapter, hook = make_adapter(make_model()), Parallax(ParallaxConfig())
    adapter.colors = None
    for step in (2, 4):
        assert hook.loss(context_of(adapter, [LEFT, RIGHT], step=step)) is None
    assert [record.message for record in caplog.records if "parallax" in record.message] == [
        "parallax supervises nothing: the backbone has no `colors`, see d2_plugin.protocol.Backbone"
    ]


def test_images_of_the_plane_agree_with_it() -> None:
    """The image of the middle camera is what the left one's pixels show there."""
    frames = TinyFrames()
    pixels, places = in_sight(MIDDLE, Side(LEFT, prior_of(LEFT)), Side(RIGHT, prior_of(RIGHT)))
    shown = parallax._sampled(frames.image(1), places)
    torch.testing.assert_close(shown, frames.image(0).view(-1, 3)[pixels], atol=1e-4, rtol=0)
