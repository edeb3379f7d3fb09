"""The bundled deformation backbone: its field, where it is still, how it learns, what is left out."""

from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F
from tiny import bend_field, make_adapter, make_model, make_trainer, make_views, parameters

from d2_plugin.backbones.deform import Deform
from d2_plugin.backbones.deform_fields import SPACE_PAIRS, Box, HexPlaneField, HexPlaneSettings, at_instant
from d2_plugin.backbones.densify import grow
from d2_plugin.gaussians.slicing import MARGINAL_CUT, slice_gaussians
from d2_plugin.protocol import Points


def deforming() -> Deform:
    """A model past its warm-up whose field moves things."""
    model = bend_field(make_model(backbone="deform"), 0.1)
    with torch.no_grad():
        for plane in model.field.time:
            plane.uniform_(0.5, 1.5, generator=torch.Generator().manual_seed(2))
    return model


class TestModel:
    def test_a_new_field_moves_nothing(self) -> None:
        model = make_model(backbone="deform")
        assert all(not part.any() for part in model.offsets(model.gaussians["positions"], 0.3))
        assert not torch.equal(deforming().slice_at(make_views()[0]).means, model.gaussians["positions"])

    def test_a_gaussian_fades_away_from_its_instant_and_goes_where_the_field_says(self) -> None:
        model, view, time = deforming(), make_views()[0], 0.2
        with torch.no_grad():
            model.gaussians["log_time_scales"].copy_(torch.linspace(-3, 3, len(model)))
        rows = model.gaussians.parameters
        offsets = model.offsets(rows["positions"], time)
        factor = torch.exp(-0.5 * ((time - rows["times"]) / rows["log_time_scales"].exp()) ** 2)
        kept = torch.nonzero(factor > MARGINAL_CUT).squeeze(-1)
        assert 0 < len(kept) < len(model)
        still = {
            "positions": rows["positions"] + offsets.positions,
            "log_scales": rows["log_scales"] + offsets.log_scales,
            "left": rows["rotations"] + offsets.rotations,
            "opacity_logits": rows["opacity_logits"],
        }
        expected, splats = slice_gaussians(still), model.slice_at(replace(view, time=time))
        assert torch.equal(splats.rows, kept)
        torch.testing.assert_close(splats.means, expected.means[kept])
        torch.testing.assert_close(splats.covariances, expected.covariances[kept], rtol=1e-4, atol=1e-7)
        torch.testing.assert_close(splats.opacities, (expected.opacities * factor)[kept])

    def test_gaussians_exist_at_all_instants_at_the_start(self) -> None:
        model = make_model(backbone="deform")
        for time in (0.0, model.duration):
            opacities = model.slice_at(replace(make_views()[0], time=time)).opacities
            torch.testing.assert_close(opacities, torch.full((len(model),), 0.5), rtol=0.006, atol=0)

    def test_what_is_inserted_where_things_move_is_gone_at_other_instants(self) -> None:
        model, count = deforming(), 2
        before = len(model)
        one = torch.full((count,), 0.1)
        lifetimes = torch.tensor([0.02, torch.inf])
        make_adapter(model).insert(Points(torch.rand(count, 3), torch.rand(count, 3), one, one, one, lifetimes))
        then, later = (model.slice_at(replace(make_views()[0], time=t)).rows.tolist() for t in (0.1, 0.4))
        assert then == [*range(before + count)]
        assert later == [*range(before), before + 1]

    def test_a_split_leaves_instants_and_lifetimes_as_they_are(self) -> None:
        model = make_model(count=6, backbone="deform")
        model.gaussians.statistics["screen_gradient"].fill_(1.0)
        with torch.no_grad():
            model.gaussians["log_scales"].zero_()  # large ones are split, not cloned
        known = model.gaussians["times"].detach().clone()
        grow(model, model.settings.densify, torch.Generator().manual_seed(0))
        assert torch.equal(model.gaussians["times"], torch.cat([known, known]))
        assert len(model.gaussians["log_time_scales"].unique()) == 1

    def test_noise_on_time_is_for_training_alone_and_falls_to_zero_at_half_of_the_run(self) -> None:
        trainer, view = make_trainer(iterations=20, backbone="deform"), make_views()[0]
        for until, noisy in ((9, True), (10, False)):
            trainer.run(until=until)
            trained = trainer.model.slice_at(view).means
            with torch.no_grad():
                assert torch.equal(trainer.model.slice_at(view).means, trained) != noisy

    def test_all_parameters_learn(self) -> None:
        trainer = make_trainer(iterations=30, backbone="deform")
        trainer.run(until=2)
        before = parameters(trainer)
        trainer.run(until=6)
        after = parameters(trainer)
        assert not any(torch.equal(before[name], after[name]) for name in before)

    def test_the_box_holds_the_points_and_not_their_outliers(self) -> None:
        positions = torch.rand(1000, 3) * 2 - 1
        positions[0] = 1e6
        box = Box.around(positions, 1.0)
        assert (box.reach < 1.2).all()
        assert (((positions[1:] - box.centre) / box.reach).abs() <= 1.05).all()
        assert torch.isfinite(Box.around(torch.zeros(0, 3), 2.0).reach).all()
        assert (Box.around(torch.ones(1, 3), 2.0).reach > 0).all()


def make_field() -> HexPlaneField:
    """A field in float64 whose last layer is not zero any more."""
    generator = torch.Generator().manual_seed(0)
    box = Box(torch.tensor([0.5, -1.0, 3.0]), torch.tensor([2.0, 1.0, 3.0]), 1.5)
    field = HexPlaneField(box, HexPlaneSettings(features=3, resolutions=(4, 7)), generator)
    with torch.no_grad():
        for parameter in field.heads.parameters():
            parameter.uniform_(-0.5, 0.5, generator=generator)
    return field.double()


def some_positions(count: int = 7) -> torch.Tensor:
    return torch.rand(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(5)) * 4 - 1


def bilinear(plane: torch.Tensor, row: torch.Tensor, column: torch.Tensor) -> torch.Tensor:
    """[N, C] from a plane [C, H, W] at rows and columns in -1..1."""
    height, width = plane.shape[1:]
    y, x = (row + 1) / 2 * (height - 1), (column + 1) / 2 * (width - 1)
    y0, x0 = y.floor().clamp(max=height - 2).long(), x.floor().clamp(max=width - 2).long()
    wy, wx = y - y0, x - x0
    corners = [plane[:, y0 + j, x0 + i] * (wy if j else 1 - wy) * (wx if i else 1 - wx) for j in (0, 1) for i in (0, 1)]
    return sum(corners).T


def test_a_checkpoint_says_in_what_the_offsets_are_measured() -> None:
    """A run that is opened again to be scored has no prior, and without one may find another extent."""
    trained, opened = deforming(), make_model(backbone="deform")
    opened.field = HexPlaneField(Box(torch.zeros(3), torch.ones(3), 7.0), opened.settings.hexplane, opened._generator)
    state = trained.state_dict()
    opened.load_state_dict(state)
    positions = trained.gaussians["positions"]
    assert torch.equal(opened.offsets(positions, 0.3).positions, trained.offsets(positions, 0.3).positions)
    del state["field"]["unit"]  # of a version before
    trained.load_state_dict(state)


class TestField:
    def test_passes_gradcheck(self) -> None:
        field, positions = make_field(), some_positions(3)
        names = [name for name, _ in field.named_parameters()]

        def evaluate(*values: torch.Tensor) -> tuple[torch.Tensor, ...]:
            return tuple(torch.func.functional_call(field, dict(zip(names, values)), (positions, 0.37)))

        values = [parameter.detach().requires_grad_() for parameter in field.parameters()]
        assert torch.autograd.gradcheck(evaluate, values, fast_mode=True)

    def test_positions_far_outside_the_box_stay_finite(self) -> None:
        far = torch.tensor([[1e6, -1e6, 1e6], [1e30, 0, 0]], dtype=torch.float64)
        assert all(torch.isfinite(part).all() for part in make_field()(far, 0.5))

    def test_the_unit_of_length_scales_positions_alone(self) -> None:
        field, positions = make_field(), some_positions()
        scaled = make_field()
        scaled.centre, scaled.reach, scaled.unit = 1e3 * field.centre, 1e3 * field.reach, 1e3 * field.unit
        for part, expected, factor in zip(scaled(1e3 * positions, 0.4), field(positions, 0.4), (1e3, 1, 1)):
            torch.testing.assert_close(part, factor * expected)


class TestHexPlane:
    def test_is_the_product_of_six_bilinear_planes(self) -> None:
        field, positions, fraction = make_field(), some_positions(), 0.37
        with torch.no_grad():
            for plane in field.time:
                plane.uniform_(0.5, 1.5, generator=torch.Generator().manual_seed(2))
        at = ((positions - field.centre) / field.reach).clamp(-1, 1)
        features = []
        for space, time in zip(field.space, field.time):
            product = torch.ones(len(at), space.shape[1], dtype=torch.float64)
            for plane, (a, b) in zip(space, SPACE_PAIRS):
                product = product * bilinear(plane, at[:, a], at[:, b])
            for axis, plane in enumerate(time):
                product = product * bilinear(plane, torch.full_like(at[:, 0], 2 * fraction - 1), at[:, axis])
            features.append(product)
        expected = field.heads(F.relu(field.features(torch.cat(features, -1))))
        torch.testing.assert_close(torch.cat(list(field(positions, fraction)), -1)[:, 3:], expected[:, 3:])

    @pytest.mark.parametrize("instants", [1, 2, 5])
    def test_time_ends_at_the_last_node(self, instants: int) -> None:
        planes = torch.rand(3, 2, instants, 4)
        torch.testing.assert_close(at_instant(planes, 0.0), planes[:, :, 0])
        torch.testing.assert_close(at_instant(planes, 1.0), planes[:, :, -1])
