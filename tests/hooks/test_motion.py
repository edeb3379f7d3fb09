"""What moves: the image halfway between two instants supervises it, and it lives as long as its instant."""

from dataclasses import replace

import pytest
import torch
from tiny import ALL_HOOKS, BACKBONES, TinyFrames, TinyStore, make_adapter, make_model, make_views, parameters, same
from torch import Tensor

from d2_plugin.backbones.model import SplatModel
from d2_plugin.backbones.trainer import Trainer, TrainSettings
from d2_plugin.config import D2Config, DensifyConfig, MotionConfig, ParallaxConfig
from d2_plugin.hooks.densify import CHANGED, Densify, MovingPixels
from d2_plugin.hooks.hook import Context, HookConfig
from d2_plugin.hooks.motion import Motion
from d2_plugin.hooks.prior import RIM, PriorLoader
from d2_plugin.plugin import D2Hooks
from d2_plugin.protocol import DepthPrior, Label, Points, View

VIEWS = make_views()
FIRST, SECOND = VIEWS[0], VIEWS[3]
"""One camera at two instants, half a second apart."""
HEIGHT, WIDTH = FIRST.height, FIRST.width


class Halfway(TinyStore):
    """The prior of the tiny scene with a view halfway; its left quarter moves, its right quarter is not known."""

    def __init__(self, image: Tensor | None = None, unknown: int = WIDTH // 4) -> None:
        self.image = torch.full((HEIGHT, WIDTH, 3), 90, dtype=torch.uint8) if image is None else image
        self.unknown = unknown

    def underway(self, camera: str, frame: int, quarter: int) -> tuple[int, DepthPrior] | None:
        """From the first instant to the second, as if nothing moved from quarter to quarter."""
        if frame > 0:
            return None
        labels = torch.zeros(HEIGHT, WIDTH, dtype=torch.uint8)
        labels[:, : WIDTH // 4], labels[:, WIDTH - self.unknown :] = Label.VERIFIED, Label.CONFLICT
        depth = torch.where(labels == Label.VERIFIED, 2.5, 0.0)
        return 1, DepthPrior(depth, labels, self.image, torch.where(labels == Label.VERIFIED, 0.01, torch.inf))


def context_of(adapter: object, store: object, views: list[View], known: list[View], step: int = 2) -> Context:
    """Of a loss for `views`, or an evaluation of the first of the `known` ones, once these were trained on."""

    def of(camera: str) -> list[View]:
        return [view for view in known if view.camera == camera]

    return Context(step, adapter, views, PriorLoader(store), torch.Generator().manual_seed(0), lambda: known[:1], of)


def model_far_away() -> SplatModel:
    model = make_model(count=1)
    with torch.no_grad():
        model.gaussians["positions"][:, 2] = 50.0
    return model


def loss_of(adapter: object, store: object | None = None, step: int = 2, **changes: float) -> Tensor | None:
    context = context_of(adapter, store or Halfway(), [FIRST], [FIRST, SECOND], step)
    return Motion(MotionConfig(**changes)).loss(context)


def test_what_is_looked_at_between_two_instants_is_what_moves_and_a_rim() -> None:
    view, kept = PriorLoader(Halfway()).underway(FIRST, [FIRST, SECOND])
    prior = kept.prior(torch.device("cpu"))
    assert (view.width, view.height) == (WIDTH // 4 + RIM, HEIGHT)
    assert prior.depth.shape == prior.colors.shape[:2] == (HEIGHT, view.width)
    still = Halfway()
    still.underway = lambda *_: (1, Halfway().underway("", 0, 2)[1]._replace(depth=torch.zeros(HEIGHT, WIDTH)))
    assert PriorLoader(still).underway(FIRST, [FIRST, SECOND]) is None


def test_a_part_in_the_middle_shows_the_same_pixels() -> None:
    store, part = Halfway(), Halfway()
    labels = torch.zeros(HEIGHT, WIDTH, dtype=torch.uint8)
    labels[HEIGHT // 2, WIDTH // 2] = Label.VERIFIED
    prior = store.underway("", 0, 2)[1]._replace(labels=labels, depth=2.5 * (labels > 0))
    part.underway = lambda *_: (1, prior)
    view, _ = PriorLoader(part).underway(FIRST, [FIRST, SECOND])
    rows, columns = (slice(max(size // 2 - RIM, 0), size // 2 + RIM + 1) for size in (HEIGHT, WIDTH))
    model = make_model()
    whole = model.render(replace(FIRST, time=view.time)).color
    # Gaussians far beside the image are clamped there, hence no closer.
    torch.testing.assert_close(model.render(view).color, whole[rows, columns], atol=1e-2, rtol=0)


@pytest.mark.parametrize("backbone", BACKBONES)
class TestLoss:
    def test_of_the_render_itself_at_that_time_it_is_next_to_nothing(self, backbone: str) -> None:
        adapter = make_adapter(make_model(backbone=backbone))
        for step, time in ((1, 0.125), (2, 0.25), (3, 0.375), (4, 0.25)):
            shown = adapter.model.render(replace(FIRST, time=time)).color.detach()  # with its background
            image = (255 * shown).round().clamp(0, 255).byte()
            assert float(loss_of(adapter, Halfway(image), step).detach()) < 1e-3

    def test_it_moves_gaussians_and_has_the_weight_that_was_asked_for(self, backbone: str) -> None:
        adapter = make_adapter(make_model(backbone=backbone))
        once, twice = loss_of(adapter), loss_of(adapter, weight=2.0)
        torch.testing.assert_close(twice, 2 * once)
        once.backward()
        gradient = adapter.model.gaussians["positions"].grad
        assert gradient.isfinite().all()
        assert gradient.any()

    def test_where_motion_is_not_known_the_image_counts_for_nothing(self, backbone: str) -> None:
        adapter, store = make_adapter(make_model(backbone=backbone)), Halfway()
        before = float(loss_of(adapter, store).detach())
        store.image[:, -WIDTH // 4 :] = 255
        assert float(loss_of(adapter, store).detach()) == before
        store.image[:, 0] = 255
        assert float(loss_of(adapter, store).detach()) != before


def test_its_gradient_is_that_of_differences_in_time_and_place() -> None:
    """In float64, through positions, times and what couples them."""
    model = make_model(count=3, background=False)
    with torch.no_grad():
        for name, value in model.gaussians.parameters.items():
            value.data = value.data.double()
            if name in ("left", "right"):
                value += 0.1 * torch.rand(value.shape, generator=torch.Generator().manual_seed(0), dtype=value.dtype)
    views = [replace(v, T_camera_world=v.T_camera_world.double(), K=v.K.double()) for v in (FIRST, SECOND)]
    context = context_of(make_adapter(model), Halfway(unknown=0), views[:1], views)
    names = ("positions", "times", "left", "right", "opacity_logits")
    inputs = [model.gaussians.parameters[name] for name in names]
    # L1 has corners, which differences this small do not meet.
    assert torch.autograd.gradcheck(lambda *_: Motion(MotionConfig()).loss(context), inputs, eps=1e-7, atol=1e-5)


class TestWhereThereIsNothingToLearnFrom:
    def test_a_store_without_instants_between_adds_nothing(self) -> None:
        assert loss_of(make_adapter(make_model()), TinyStore()) is None

    def test_nor_does_the_last_instant_or_one_whose_next_has_not_been_seen(self) -> None:
        adapter = make_adapter(make_model())
        for views, known in (([SECOND], [FIRST, SECOND]), ([FIRST], [FIRST])):
            assert Motion(MotionConfig()).loss(context_of(adapter, Halfway(), views, known)) is None


class Taken(Halfway):
    """The same with images of the instants: grey, but for a bar at the left of the second one."""

    def prior(self, camera: str, frame: int) -> DepthPrior:
        image = torch.full((HEIGHT, WIDTH, 3), 128, dtype=torch.uint8)
        image[:, : 4 * frame] = 255
        return super().prior(camera, frame)._replace(colors=image)


class TestOtherInstants:
    def test_are_looked_at_in_runs_that_are_long_for_their_steps_and_not_short(self) -> None:
        assert [MotionConfig.for_iterations(steps).again for steps in (999, 1000, 30_000)] == [0, 0.04, 40 / 30_000]

    @pytest.mark.parametrize("view", [FIRST, SECOND])
    def test_show_the_image_that_was_taken_where_something_moves(self, view: View) -> None:
        loader = PriorLoader(Taken())
        window, image = loader.moving(view, [FIRST, SECOND])
        assert (window.time, window.width, window.height) == (view.time, WIDTH // 4 + RIM, HEIGHT)
        assert torch.equal(image, Taken().prior("", view.frame).colors[:, : WIDTH // 4 + RIM])
        assert loader.moving(view, [view]) is None, "where it moves to, or comes from, has not been seen yet"

    def test_train_what_lives_at_another_instant_than_the_step_s(self) -> None:
        changed = []
        for again in (0.0, 1.0):
            adapter = make_adapter(make_model())
            rows = adapter.model.gaussians
            with torch.no_grad():
                rows["times"].fill_(SECOND.time)
                rows["log_time_scales"].fill_(-3.5)
            loss = loss_of(adapter, Taken(), again=again)
            gradient = torch.autograd.grad(loss, rows["base_colors"], allow_unused=True)[0]
            changed.append(gradient is not None and bool(gradient.any()))
        assert changed == [False, True]

    def test_are_four_at_most_in_a_step(self) -> None:
        known = [replace(FIRST, frame=frame, time=frame / 2) for frame in range(300)]
        motion, store = Motion(MotionConfig(again=0.5)), Taken()
        store.underway = lambda camera, frame, quarter: (frame + 1, Halfway().underway(camera, 0, quarter)[1])
        context = context_of(make_adapter(make_model()), store, known[:1], known)
        looks = [look.view.time for look in motion._looks(context, FIRST)]
        assert len(looks) == 5
        assert looks[0] == 0.25, "halfway"


def test_late_in_a_run_images_on_the_way_count_a_quarter_and_those_that_were_taken_in_full() -> None:
    adapter = make_adapter(make_model())
    assert MotionConfig.for_iterations(2000).late == 1400
    early, late = (loss_of(adapter, Taken(), step=step, late=6) for step in (2, 6))  # both look halfway
    assert torch.allclose(late, early / 4)
    context = context_of(adapter, Taken(), [FIRST], [FIRST, SECOND], 6)
    weights = [look.weight for look in Motion(MotionConfig(late=6, again=1.0))._looks(context, FIRST)]
    assert weights == [0.25, 1.0, 1.0]


class TestInsertionHalfway:
    def points(self, insert: bool) -> Tensor:
        """Times and lifetimes of what is inserted where nothing stands."""
        adapter = make_adapter(model_far_away())
        config = D2Config(densify=DensifyConfig(start=2, every=1), motion=MotionConfig(insert=insert), finite_every=0)
        hooks, inserted = D2Hooks(config, adapter, Halfway()), []
        adapter.insert = lambda points: inserted.append(points) or 0
        for view in (FIRST, SECOND):
            hooks.loss(1, view)
        hooks.step(2)
        lifetimes = inserted[0].lifetimes
        lifetimes = torch.full_like(inserted[0].times, torch.nan) if lifetimes is None else lifetimes
        return torch.stack([inserted[0].times, lifetimes, inserted[0].positions[:, 2]], 1)

    def test_what_moves_is_inserted_halfway_in_time_and_lives_for_an_interval(self) -> None:
        points = self.points(True)
        halfway = points[points[:, 0] == 0.25]
        assert len(halfway)
        torch.testing.assert_close(halfway[:, 1], torch.full_like(halfway[:, 1], 0.5))
        torch.testing.assert_close(halfway[:, 2], torch.full_like(halfway[:, 2], 2.5))

    def test_unless_that_is_off(self) -> None:
        assert not (self.points(False)[:, 0] == 0.25).any()


def trainer(**more: HookConfig) -> Trainer:
    def attach(model: object) -> D2Hooks:
        return D2Hooks(replace(ALL_HOOKS, **more), make_adapter(model), Halfway())

    return Trainer(make_model(), TinyFrames(), TrainSettings(iterations=18, seed=3), attach)


@pytest.mark.parametrize("hook", [{"motion": MotionConfig(again=1.0)}, {"parallax": ParallaxConfig(every=1)}])
def test_a_resumed_run_is_bitwise_the_uninterrupted_one_and_not_that_without_the_hook(hook: dict) -> None:
    whole, first, second, without = (trainer(**(hook if i < 3 else {})) for i in range(4))
    whole.run()
    first.run(9)
    second.load_state_dict(first.state_dict())
    second.run()
    without.run()
    assert same(parameters(whole), parameters(second))
    assert not same(parameters(whole), parameters(without))


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
        labels = torch.full((HEIGHT, WIDTH), int(Label.VERIFIED), dtype=torch.uint8)
        return DepthPrior(torch.full((HEIGHT, WIDTH), 3.0), labels, self.image(frame) if self.colors else None)

    def image(self, frame: int) -> Tensor:
        grey = 100 + (self.flicker if frame % 2 else 0)
        image = torch.full((HEIGHT, WIDTH, 3), grey)
        image[:, BAR * frame : BAR * (frame + 1)] = 255
        return image.to(torch.uint8)


def evaluation_of(store: Crossing, known: list[View]) -> Context:
    return context_of(make_adapter(model_far_away()), store, [], known)


def bar(frame: int) -> Tensor:
    """Where the bar stands, bool [H, W]."""
    mask = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    mask[:, BAR * frame : BAR * (frame + 1)] = True
    return mask


@pytest.mark.parametrize(("frame", "noise"), [(0, 0), (3, 0), (6, 0), (5, CHANGED)])
def test_what_moves_has_the_interval_and_the_rest_and_noise_have_no_end(frame: int, noise: int) -> None:
    known = instants(7)
    found = MovingPixels().intervals(known[frame], evaluation_of(Crossing(flicker=noise), known))
    torch.testing.assert_close(found, torch.where(bar(frame), INTERVAL, torch.inf))


def test_the_interval_is_that_of_the_instants_that_are_trained_on() -> None:
    known = instants(7)[::2]
    found = MovingPixels().intervals(known[0], evaluation_of(Crossing(), known))
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
    assert MovingPixels().intervals(known[1], evaluation_of(store, known)) is None


def test_a_later_run_of_the_same_state_finds_the_same() -> None:
    """The median is of the first instants seen, which the state of the hooks keeps: a resumed run has it again."""
    known = instants(7)
    whole, context = MovingPixels(), evaluation_of(Crossing(), known)
    whole.intervals(known[0], evaluation_of(Crossing(), known[:4]))
    torch.testing.assert_close(whole.intervals(known[2], context), MovingPixels().intervals(known[2], context))


class TestInsertion:
    def inserted(self, **settings: float | None) -> Points:
        known = instants(7)
        return Densify(DensifyConfig(spacing=2, **settings)).edit(evaluation_of(Crossing(), known)).insert

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

    @pytest.mark.parametrize("backbone", BACKBONES)
    def test_a_backbone_without_them_inserts_all_the_same(self, backbone: str) -> None:
        model = make_model(count=4, backbone=backbone, temporal=False)
        points = self.inserted()
        with torch.no_grad():
            make_adapter(model).insert(points)
        assert len(model) == 4 + len(points.positions)


def test_points_without_a_lifetime_beside_some_with_it_have_no_end() -> None:
    two, three = torch.arange(2.0), torch.arange(6.0).view(2, 3)
    plain = Points(three, three, two, two, two)
    together = Points.joined([plain, plain._replace(lifetimes=two + 1)])
    assert together.lifetimes.tolist() == [torch.inf, torch.inf, 1.0, 2.0]
    assert all(torch.equal(a, b) for a, b in zip(together.select(torch.tensor([2, 3])), (*plain[:5], two + 1)))
    assert Points.joined([plain, plain]).lifetimes is None
