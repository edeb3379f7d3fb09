"""The deformation fields: where they are still, how they learn, what they cost."""

from __future__ import annotations

import math

import pytest
import torch
import torch.nn.functional as F
from tiny import make_model

from d2_plugin.backbones.deform_fields import (
    POSITION_OCTAVES,
    SPACE_PAIRS,
    TIME_OCTAVES,
    Box,
    HexPlaneField,
    HexPlaneSettings,
    MlpField,
    MlpSettings,
    at_instant,
    bend,
    hats,
    octaves,
)

FIELDS = ("mlp", "hexplane")


@pytest.fixture(params=FIELDS)
def kind(request: pytest.FixtureRequest) -> str:
    return request.param


def make_field(kind: str, seed: int = 0) -> MlpField | HexPlaneField:
    """A field in float64 whose last layer is not zero any more."""
    generator = torch.Generator().manual_seed(seed)
    box = Box(torch.tensor([0.5, -1.0, 3.0]), torch.tensor([2.0, 1.0, 3.0]), 1.5)
    if kind == "mlp":
        field = MlpField(box, MlpSettings(width=12, depth=4), generator)
    else:
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


class TestFields:
    def test_motion_starts_from_none(self, kind: str) -> None:
        model = make_model(backbone=kind)
        still = model.offsets(model.gaussians["positions"], 0.3)
        assert all(not part.any() for part in still)

    def test_every_parameter_but_the_positions_receives_its_gradient(self, kind: str) -> None:
        field, positions = make_field(kind), some_positions().requires_grad_()
        sum(part.square().sum() for part in field(positions, 0.37)).backward()
        assert positions.grad is None
        assert all(parameter.grad is not None and parameter.grad.any() for parameter in field.parameters())

    def test_passes_gradcheck(self, kind: str) -> None:
        field, positions = make_field(kind), some_positions(3)
        names = [name for name, _ in field.named_parameters()]

        def evaluate(*values: torch.Tensor) -> tuple[torch.Tensor, ...]:
            return tuple(torch.func.functional_call(field, dict(zip(names, values)), (positions, 0.37)))

        assert torch.autograd.gradcheck(evaluate, [p.detach().requires_grad_() for p in field.parameters()])

    def test_positions_far_outside_the_box_stay_finite(self, kind: str) -> None:
        far = torch.tensor([[1e6, -1e6, 1e6], [1e30, 0, 0]], dtype=torch.float64)
        assert all(torch.isfinite(part).all() for part in make_field(kind)(far, 0.5))

    def test_the_unit_of_length_scales_positions_alone(self, kind: str) -> None:
        field, positions = make_field(kind), some_positions()
        scaled = make_field(kind)
        scaled.centre, scaled.reach, scaled.unit = 1e3 * field.centre, 1e3 * field.reach, 1e3 * field.unit
        for part, expected, factor in zip(scaled(1e3 * positions, 0.4), field(positions, 0.4), (1e3, 1, 1)):
            torch.testing.assert_close(part, factor * expected)


class TestMlp:
    def test_is_a_network_on_the_encoded_place_and_time_together(self) -> None:
        """The official form: one row of inputs for each Gaussian, and the skip as a concatenation."""
        field, positions, fraction = make_field("mlp"), some_positions(), 0.37
        place = octaves((positions - field.centre) / field.reach, POSITION_OCTAVES)
        instant = octaves(torch.tensor([2 * fraction - 1], dtype=torch.float64), TIME_OCTAVES).expand(len(place), -1)
        inputs = torch.cat([place, instant], -1)
        weights = [torch.cat([p.weight, t.weight], -1) for p, t in zip(field.place, field.instant)]
        biases = [p.bias + t.bias for p, t in zip(field.place, field.instant)]
        state = F.relu(inputs @ weights[0].T + biases[0])
        for i, layer in enumerate(field.hidden):
            joined = torch.cat([inputs, state], -1) if i == field.skip else state
            weight = torch.cat([weights[1], layer.weight], -1) if i == field.skip else layer.weight
            bias = biases[1] + layer.bias if i == field.skip else layer.bias
            state = F.relu(joined @ weight.T + bias)
        expected = field.heads(state)
        torch.testing.assert_close(torch.cat(list(field(positions, fraction)), -1)[:, 3:], expected[:, 3:])
        torch.testing.assert_close(field(positions, fraction).positions, field.unit * expected[:, :3])

    def test_encoding_is_the_value_and_its_octaves(self) -> None:
        x = torch.tensor([[0.3]], dtype=torch.float64)
        expected = [
            0.3,
            *(math.sin(math.pi * k * 0.3) for k in (1, 2, 4)),
            *(math.cos(math.pi * k * 0.3) for k in (1, 2, 4)),
        ]
        torch.testing.assert_close(octaves(x, 3)[0], torch.tensor(expected, dtype=torch.float64))

    @pytest.mark.parametrize("depth", [1, 2, 3])
    def test_shallow_networks_are_networks(self, depth: int) -> None:
        box = Box(torch.zeros(3), torch.ones(3), 1.0)
        field = MlpField(box, MlpSettings(width=8, depth=depth), torch.Generator().manual_seed(0))
        assert field(torch.rand(5, 3), 0.5).positions.shape == (5, 3)


class TestHexPlane:
    def test_is_the_product_of_six_bilinear_planes(self) -> None:
        field, positions, fraction = make_field("hexplane"), some_positions(), 0.37
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

    def test_lines_are_interpolated_where_hats_meet(self) -> None:
        line, at = torch.tensor([[[2.0, 4.0, 8.0]]]), torch.tensor([[-1.0, -0.5, 0.0, 0.9, 1.0]])
        torch.testing.assert_close((line @ hats(at, 3))[0, 0], torch.tensor([2.0, 3.0, 4.0, 7.6, 8.0]))

    @pytest.mark.parametrize("instants", [1, 2, 5])
    def test_time_ends_at_the_last_node(self, instants: int) -> None:
        planes = torch.rand(3, 2, instants, 4)
        torch.testing.assert_close(at_instant(planes, 0.0), planes[:, :, 0])
        torch.testing.assert_close(at_instant(planes, 1.0), planes[:, :, -1])

    def test_straight_planes_have_no_bend_and_ones_no_cost(self) -> None:
        ramp = torch.arange(6.0).expand(2, 6)
        assert bend(ramp, -1).item() == 0
        assert bend(ramp**2, -1).item() == 4
        assert bend(ramp, -2).item() == 0, "two nodes have no second difference"
        field = make_field("hexplane")
        with torch.no_grad():
            for plane in field.space:
                plane.fill_(0.3)
        assert field.regularization().item() == 0
