"""What the plugin promises of every backbone: rows stay together through any edits, a resumed run is the same run."""

import io
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny import ALL_HOOKS, BACKBONES, bend_field, make_adapter, make_model, make_trainer, make_views, parameters, same

from d2_plugin import D2Config, D2Error, D2Hooks
from d2_plugin.backbones import trainer as training
from d2_plugin.backbones.densify import DensifySettings, grow, prune
from d2_plugin.backbones.model import SplatModel
from d2_plugin.backbones.starting import nearest_neighbour_scales
from d2_plugin.backbones.yang4d import create
from d2_plugin.gaussians import spherical_harmonics as sh
from d2_plugin.protocol import Backbone, Points

COUNT = 20
EDITS = ("insert", "remove", "grow", "prune", "reorder")
edits = st.lists(st.tuples(st.sampled_from(EDITS), st.integers(0, 2**16)), max_size=10)


@pytest.fixture(params=BACKBONES)
def backbone(request: pytest.FixtureRequest) -> str:
    return request.param


def numbered(name: str) -> SplatModel:
    """A model of COUNT Gaussians whose colours, Adam moments and statistics hold their numbers 1, 2, 3, ..."""
    model = bend_field(make_model(COUNT, backbone=name))
    sum((p * 0).sum() for p in model.gaussians.parameters.values()).backward()
    model.gaussians.optimizer.step()
    model.gaussians.optimizer.zero_grad()
    numbers = torch.arange(1.0, COUNT + 1)
    with torch.no_grad():
        model.gaussians["base_colors"].copy_(by_row(numbers, model.gaussians["base_colors"]))
        model.gaussians["opacity_logits"].copy_(numbers[torch.randperm(COUNT, generator=generator(0))] / COUNT)
        model.gaussians["log_scales"][::2] = -8.0  # these are cloned, the others split
        for parameter, state in model.gaussians.optimizer.state.items():
            for moment in ("exp_avg", "exp_avg_sq"):
                state[moment].copy_(by_row(numbers, parameter))
    model.gaussians.statistics = {"screen_gradient": numbers.clone(), "seen": torch.ones(COUNT)}
    return model


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def by_row(numbers: torch.Tensor, like: torch.Tensor) -> torch.Tensor:
    return numbers.view(-1, *[1] * (like.ndim - 1)).expand_as(like)


def some_points(count: int, seed: int = 0) -> Points:
    positions, colors = torch.rand(2, count, 3, generator=generator(seed))
    times = torch.arange(count) % 2 / 2
    return Points(positions + torch.tensor([-0.5, -0.5, 2]), colors, times, *torch.full((2, count), 0.1))


def apply(action: str, seed: int, adapter: Backbone, model: SplatModel) -> None:
    """One edit of D2 (insert, remove) or of the backbone itself (grow, prune, reorder)."""
    count = len(model)
    if action == "insert":
        adapter.insert(some_points(1 + seed % 3, seed))
    elif action == "remove":
        adapter.remove(torch.rand(count, generator=generator(seed)) < 0.3)
    elif action == "grow":
        grow(model, replace(model.settings.densify, gradient=seed % (COUNT + 1)), generator(seed))
    elif action == "prune":
        prune(model, faint=0.5 + 0.23 * (seed % 8) / 8)
    else:
        model.select(torch.randperm(count, generator=generator(seed))[: max(count - 2, 0)])


@pytest.mark.parametrize("name", BACKBONES)
@settings(max_examples=20)
@given(sequence=edits)
def test_every_per_gaussian_state_stays_on_its_row(name: str, sequence: list[tuple[str, int]]) -> None:
    """Numbers follow the reports; parameters, Adam moments, statistics and pruning streaks must have followed too."""
    model = numbered(name)
    adapter = make_adapter(model)
    d2 = D2Hooks(ALL_HOOKS, adapter, SimpleNamespace(prior=lambda camera, frame: None))
    d2.hooks["prune"].streak = torch.arange(1, COUNT + 1)
    numbers = [torch.arange(1.0, COUNT + 1)]
    adapter.on_resize(lambda index: numbers.append(torch.cat([numbers[-1], torch.zeros(1)])[index]))  # -1: the zero
    for action, seed in sequence:
        apply(action, seed, adapter, model)
    rows = numbers[-1]
    assert len(rows) == len(model)
    assert torch.equal(d2.hooks["prune"].streak.float(), rows)
    assert torch.equal(model.gaussians.statistics["screen_gradient"], rows)
    old = rows > 0
    assert torch.equal(model.gaussians["base_colors"][old, 0, 0].detach(), rows[old]), "the report is not true"
    for label, parameter in model.gaussians.parameters.items():
        for moment in ("exp_avg", "exp_avg_sq"):
            state = model.gaussians.optimizer.state[parameter][moment]
            assert torch.equal(state, by_row(rows, state)), (label, moment)


@pytest.mark.parametrize("temporal", [True, False])
def test_all_hooks_off_is_bitwise_the_bare_trainer(backbone: str, temporal: bool) -> None:
    trainers = [make_trainer(c, 12, temporal=temporal, backbone=backbone) for c in (None, D2Config(), ALL_HOOKS)]
    for trainer in trainers:
        trainer.run()
    bare, off, full = map(parameters, trainers)
    assert same(bare, off)
    assert not same(bare, full), "the hooks changed nothing: this test could not fail"


@pytest.mark.parametrize(("config", "count"), [(ALL_HOOKS, 2), (D2Config(), 1)])
def test_a_resumed_run_is_bitwise_the_uninterrupted_one(
    backbone: str, config: D2Config, count: int, threads, monkeypatch: pytest.MonkeyPatch
) -> None:
    threads(count)
    monkeypatch.setattr(training, "JITTER_FROM", 20)
    whole, first = (make_trainer(config, 20, backbone=backbone, appearance=True) for _ in range(2))
    whole.run()
    first.run(until=12)
    buffer = io.BytesIO()
    torch.save(first.state_dict(), buffer)
    buffer.seek(0)
    # Other Gaussians, and no background: all must come from the checkpoint.
    second = make_trainer(config, 20, backbone=backbone, background=False, seed=99)
    second.load_state_dict(torch.load(buffer, weights_only=True))
    second.run()
    assert same(parameters(whole), parameters(second))
    state = first.state_dict()  # kept in memory while the run goes on, and continued from twice
    first.run()
    for again in (make_trainer(config, 20, backbone=backbone) for _ in range(2)):
        again.load_state_dict(state)
        again.run()
        assert same(parameters(whole), parameters(again))
    assert whole.model.appearance.change("cam0").abs().max() > 0


def test_a_run_comes_to_rest_at_its_end(backbone: str) -> None:
    """All learning rates are a twentieth in the end, positions' also a hundredth; none rises past the last step. A
    short run learns to its last steps."""
    model = make_model(COUNT, backbone=backbone)

    def rates(step: int, iterations: int = 2000) -> dict[str, float]:
        model.optimize(step, iterations)
        return {group["name"]: group["lr"] for group in model.gaussians.optimizer.param_groups}

    first, late, end = rates(0), rates(1400), rates(2000)
    assert late == {**first, "positions": pytest.approx(first["positions"] * 0.01**0.7)}
    assert end == pytest.approx({**{n: rate / 20 for n, rate in first.items()}, "positions": first["positions"] / 2000})
    assert rates(2600) == end
    assert {**rates(98, 100), "positions": first["positions"]} == first


def test_what_an_image_differs_by_without_each_gaussian(backbone: str) -> None:
    """Against the images without them, one by one; a pixel that does not count tells nothing."""
    model, view = make_model(24, backbone=backbone), make_views()[0]
    whole, energies, weights = model.render(view).color.detach(), torch.zeros(24), torch.ones(view.height, view.width)
    weights[:, view.width // 2 :] = 0
    generator, true = torch.Generator().manual_seed(0), torch.zeros(24)
    for _ in range(100):
        torch.testing.assert_close(model.add_energies(energies, view, generator, weights), whole)
    for row in range(24):
        with torch.no_grad():
            logits = model.gaussians["opacity_logits"]
            logit, logits[row] = logits[row].clone(), -100.0
            true[row] = ((model.render(view).color - whole).square().sum(-1) * weights).sum()
            logits[row] = logit
    assert torch.equal(energies > 0, true > 0)
    seen = true > 0.01 * true.max()
    assert seen.sum() > 10
    assert (energies[seen] / 100 / true[seen]).log2().abs().median() < 0.3
    assert torch.corrcoef(torch.stack([energies, true]).argsort(1).argsort(1).float())[0, 1] > 0.95


def test_what_images_would_hardly_miss_is_left_out(backbone: str) -> None:
    """Of four Gaussians one is hidden behind an opaque one; one lives but halfway between the trained instants."""
    views = make_views()
    at = Points(
        torch.tensor([[0.0, 0, 2], [0, 0, 6], [0.2, 0.1, 1], [-0.2, -0.1, 1]]),
        torch.rand(4, 3, generator=torch.Generator().manual_seed(2)),
        torch.tensor([0.0, 0, 0.25, 0]),
        torch.tensor([2.0, 0.05, 0.1, 0.1]),
        torch.tensor([0.999, 0.9, 0.9, 0.9]),
        torch.tensor([math.inf, math.inf, 0.05, math.inf]),
    )
    model = make_model(backbone=backbone)
    model.select(torch.arange(0))
    model.append(model.initial_rows(at, model.settings, model.duration))
    with torch.no_grad():
        model.gaussians["log_time_scales"][[0, 1, 3]] = 3.0
    between = [replace(view, time=0.25) for view in views[:3]]
    before = [model.render(view).color.detach() for view in views + between]
    model.leave_out_dispensable(2000, views, lambda index: before[index] + 0.05)
    assert len(model) == 3
    torch.testing.assert_close(model.gaussians["positions"].detach()[:, 2], torch.tensor([2.0, 1, 1]))
    for view, image in zip(views + between, before, strict=True):
        torch.testing.assert_close(model.render(view).color, image, atol=0.02, rtol=0)


def test_no_more_is_left_out_than_the_images_can_spare(backbone: str) -> None:
    """What the removal costs is within the share of the error; pixels that do not count have no error to spare."""
    views, left = make_views(), {}
    for share, weight in [(0.0, 1.0), (0.01, 1.0), (0.1, 1.0), (0.1, 0.0)]:
        model = make_model(backbone=backbone, dispensable=share)
        images = [model.render(view).color.detach() for view in views]
        targets, counting = [image + 0.2 for image in images], torch.full_like(images[0][..., 0], weight)
        model.leave_out_dispensable(2000, views, targets.__getitem__, dict.fromkeys(range(len(views)), counting).get)
        left[share, weight] = len(model)
        change = sum((model.render(view).color - image).square().sum() for view, image in zip(views, images))
        assert weight == 0 or change <= 3 * share * sum(image.numel() * 0.2**2 for image in images)
    assert left[0.0, 1.0] > left[0.01, 1.0] > left[0.1, 1.0]


def test_images_that_are_not_finite_leave_all_gaussians(backbone: str) -> None:
    model = make_model(backbone=backbone)
    model.leave_out_dispensable(2000, make_views(), lambda index: torch.tensor(math.nan))
    assert len(model) == 60


@pytest.mark.parametrize(("iterations", "looks"), [(47, False), (48, True)])
def test_a_run_of_eight_steps_for_each_view_takes_a_look_at_each(backbone, iterations, looks) -> None:
    trainer, counts = make_trainer(iterations=iterations, backbone=backbone, densify={"every": 1000}), []
    trainer.model.gaussians["opacity_logits"].data[7] = -100.0
    trainer.run(on_step=lambda step, loss: counts.append(len(trainer.model)))
    at = round(0.7 * iterations)
    assert counts[: at - 1] == [60] * (at - 1)
    assert len(set(counts[at - 1 :])) == 1
    assert (counts[-1] < 60) == looks


def test_training_lowers_the_loss_of_the_tiny_scene(backbone: str) -> None:
    losses: list[float] = []
    make_trainer(iterations=100, backbone=backbone).run(on_step=lambda step, loss: losses.append(loss))
    assert sum(losses[-6:]) < 0.5 * sum(losses[:6])


def test_without_time_these_are_ordinary_3d_gaussians(backbone: str) -> None:
    model = make_model(temporal=False, backbone=backbone)
    assert getattr(model, "field", None) is None
    assert {"times", "log_time_scales", "right"}.isdisjoint(model.gaussians.parameters)
    a, b = (model.slice_at(view) for view in (make_views()[0], make_views()[-1]))
    assert all(torch.equal(x, y) for x, y in zip(a, b, strict=True))
    assert len(a.rows) == 60


def test_a_time_that_is_not_a_number_is_refused(backbone: str) -> None:
    with pytest.raises(D2Error, match="the time of camera 'cam0', frame 0 is NaN"):
        make_model(backbone=backbone).slice_at(replace(make_views()[0], time=math.nan))


def test_a_new_gaussian_stands_still_and_fades_over_a_fifth_of_the_duration() -> None:
    rows = (torch.rand(9, 3), torch.rand(9, 3), torch.full((9,), 0.3))
    model = create(*rows, extent=1.0, duration=1.0, temporal=True)
    early, late = (model.slice_at(replace(make_views()[0], time=time)) for time in (0.28, 0.32))
    torch.testing.assert_close(early.means, late.means)
    torch.testing.assert_close(early.covariances, late.covariances)
    expected = torch.sigmoid(model.gaussians["opacity_logits"]) * torch.exp(torch.tensor(-0.5 * 0.02**2 / 0.2))
    torch.testing.assert_close(late.opacities, expected)


def test_a_first_scale_is_the_root_mean_square_distance_to_three_neighbours() -> None:
    positions = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3], [50, 0, 0]])
    assert nearest_neighbour_scales(positions)[0].item() == pytest.approx(math.sqrt((1 + 4 + 9) / 3))


class TestColour:
    @pytest.mark.parametrize("degree", [0, 1, 2, 3])
    def test_basis_is_orthonormal_over_the_sphere(self, degree: int) -> None:
        z, weight = np.polynomial.legendre.leggauss(16)
        phi = np.arange(32) * 2 * math.pi / 32
        radius = np.sqrt(1 - z**2)
        grid = np.stack([np.outer(radius, np.cos(phi)), np.outer(radius, np.sin(phi)), np.outer(z, np.ones(32))], -1)
        values = sh.basis(torch.from_numpy(grid.reshape(-1, 3)), degree)
        gram = (values * torch.from_numpy(np.repeat(weight, 32) * 2 * math.pi / 32)[:, None]).T @ values
        torch.testing.assert_close(gram, torch.eye((degree + 1) ** 2, dtype=torch.float64))

    def test_constant_colours_survive_the_coefficients(self) -> None:
        rgb, directions = torch.rand(7, 3), torch.randn(7, 3)
        for degree, time_degree in ((0, 0), (2, 0), (1, 2)):
            coefficients = sh.coefficients_from_rgb(rgb, degree, time_degree)
            assert coefficients.shape == (7, sh.channel_count(degree, time_degree), 3)
            torch.testing.assert_close(sh.colors(coefficients, directions, torch.rand(7), degree, time_degree), rgb)

    def test_time_modulates_with_the_cosine_of_the_phase(self) -> None:
        coefficients = torch.zeros(1, sh.channel_count(0, 1), 3)
        coefficients[:, 1] = 0.4 / sh.SH_C0
        color = sh.colors(coefficients, torch.ones(1, 3), torch.tensor([1 / 6]), 0, 1)
        torch.testing.assert_close(color, torch.full((1, 3), 0.5 + 0.4 * math.cos(math.pi / 3)))


class TestDensityControl:
    def test_small_gaussians_are_cloned_and_large_ones_split_into_two(self) -> None:
        model = make_model()
        with torch.no_grad():
            model.gaussians["log_scales"][:30] = math.log(1e-3)
            model.gaussians["log_scales"][30:] = math.log(0.1)
        model.gaussians.statistics["screen_gradient"][[0, 40]] = 1.0
        model.gaussians.statistics["seen"].fill_(1)
        before = {name: value.detach().clone() for name, value in model.gaussians.parameters.items()}
        grow(model, DensifySettings(gradient=0.5), torch.Generator().manual_seed(0))
        after = model.gaussians.parameters
        assert len(model) == 62, "one clone; one parent replaced by two children"
        assert torch.equal(after["positions"][-3], before["positions"][0])
        torch.testing.assert_close(after["log_scales"][-2:], before["log_scales"][[40, 40]] - math.log(1.6))
        assert not (after["positions"] == before["positions"][40]).all(-1).any(), "the parent is gone"

    def test_growth_stops_at_the_budget(self) -> None:
        model = make_model()
        model.gaussians.statistics["screen_gradient"].fill_(1)
        model.gaussians.statistics["seen"].fill_(1)
        grow(model, DensifySettings(gradient=0.5, budget=64), torch.Generator())
        assert len(model) == 64

    def test_transparent_and_huge_gaussians_are_pruned(self) -> None:
        model = make_model()
        with torch.no_grad():
            model.gaussians["opacity_logits"][3] = -10
            model.gaussians["log_scales"][5, 1] = 10
        prune(model)
        assert len(model) == 58


def test_every_training_view_is_used_once_per_round() -> None:
    drawn, trainer, views = [], make_trainer(), make_views()
    trainer.model.accumulate = drawn.append
    trainer.run(until=len(views))
    assert {(view.camera, view.frame) for view in drawn} == {(view.camera, view.frame) for view in views}


@pytest.mark.parametrize("degree", [0, 1])
def test_black_is_no_trap(backbone: str, degree: int) -> None:
    """A Gaussian whose colour a step took below 0 is drawn black, and finds back where the images are brighter."""
    model = make_model(COUNT, backbone=backbone, sh_degree=degree)
    with torch.no_grad():
        model.gaussians["base_colors"].copy_(sh.coefficients_from_rgb(torch.full((COUNT, 3), -0.05), 0, 0))
    view = make_views()[0]
    for wanted, leads in ((1.0, True), (-1.0, False)):
        colors = model.colors(view, model.slice_at(view))
        assert (colors == 0).all()
        (gradient,) = torch.autograd.grad((colors - wanted).square().sum(), model.gaussians["base_colors"])
        assert bool((gradient < 0).any()) is leads, f"towards {wanted}"
        assert not (gradient > 0).any(), "further below 0"


def test_colours_of_direction_and_time_train_and_grow() -> None:
    trainer = make_trainer(iterations=20, sh_degree=1, sh_time_degree=2)
    trainer.run()
    assert all(value.isfinite().all() for value in parameters(trainer).values())
    assert len(trainer.model) > 60
