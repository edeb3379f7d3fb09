"""The slice of a 4D Gaussian: golden vectors, the kernel against torch, and where numbers end."""

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple

import numpy as np
import pytest
import torch
from slice_scenes import AT, CONSTANTS, GOLDEN, random_rows, relative_error
from tiny import make_model, make_views
from torch import Tensor

from d2_plugin import D2Error
from d2_plugin.gaussians import native_slice as kernel
from d2_plugin.gaussians import rotation4d
from d2_plugin.gaussians.native_slice import TEMPORAL, native_slice
from d2_plugin.gaussians.slicing import reference_slice
from d2_plugin.protocol import covariance_matrices

OUTPUTS = ("means", "covariances", "opacities")


@pytest.fixture(params=[True, False], ids=["temporal", "static"])
def temporal(request: pytest.FixtureRequest) -> bool:
    return request.param


class Sliced(NamedTuple):
    means: Tensor
    covariances: Tensor
    opacities: Tensor
    rows: Tensor
    gradients: dict[str, Tensor]

    def assert_finite(self) -> None:
        for name, tensor in (*zip(self._fields, self[:3]), *self.gradients.items()):
            assert torch.isfinite(tensor).all(), name


def sliced(slice_in: Callable, dtype: torch.dtype, rows: Mapping, at=AT, weighed=True, used=slice(None)) -> Sliced:
    """The slice by `slice_in`, and gradients of the sum of the outputs `used`, `weighed` by a fixed noise or not."""
    raw = {name: value.to(dtype, copy=True).requires_grad_() for name, value in rows.items()}
    *outputs, drawn = slice_in(raw, at, *CONSTANTS)
    generator, upstream = torch.Generator().manual_seed(7), []
    for output in outputs:  # a Gaussian has its noise, whichever others are drawn
        noise = torch.randn(len(raw["positions"]), *output.shape[1:], generator=generator)
        upstream.append(noise[drawn].to(dtype) if weighed else torch.ones_like(output))
    torch.autograd.backward(outputs[used], upstream[used])
    gradients = {name: torch.zeros_like(value) if value.grad is None else value.grad for name, value in raw.items()}
    return Sliced(*(output.detach() for output in outputs), drawn, gradients)


native = partial(sliced, native_slice, torch.float32)
plain = partial(sliced, reference_slice, torch.float32)
exact = partial(sliced, reference_slice, torch.float64)


@pytest.mark.usefixtures("compiler")
class TestKernel:
    @pytest.mark.parametrize("time_scale", [0.02, 2.0])
    @pytest.mark.parametrize("count", [0, 1, 15, 16, 17, 3001])
    def test_values_and_gradients_are_those_of_torch_in_float64(self, count, time_scale, temporal) -> None:
        rows = random_rows(count, temporal, count, time_scale)
        found, expected = native(rows), exact(rows)
        assert torch.equal(found.rows, expected.rows)
        for value, other in zip(found[:3], expected):
            assert value.is_contiguous()
            assert relative_error(value, other) < 2e-6
        for name, other in expected.gradients.items():
            assert relative_error(found.gradients[name], other) < 1e-5, name

    def test_where_float32_is_short_of_digits_the_kernel_loses_no_more_than_torch(self) -> None:
        rows = random_rows(300, True, time_scale=200.0)  # velocities are ratios of numbers three orders apart
        found, other, expected = native(rows), plain(rows), exact(rows)
        assert torch.equal(found.rows, expected.rows)
        for ours, theirs, right in zip(found[:3], other, expected):
            assert relative_error(ours, right) < 2e-6 + 1.5 * relative_error(theirs, right)
        for name, right in expected.gradients.items():
            allowed = 2e-6 + 1.5 * relative_error(other.gradients[name], right)
            assert relative_error(found.gradients[name], right) < allowed, name

    def test_the_number_of_threads_changes_no_bit(self, temporal: bool, same_for_any_threads: Callable) -> None:
        def everything() -> list[Tensor]:
            found = native(random_rows(10_000, temporal))
            return [*found[:4], *found.gradients.values()]

        same_for_any_threads(everything)

    @pytest.mark.parametrize("spoilt", list(TEMPORAL))
    @pytest.mark.parametrize("value", [math.nan, math.inf])
    def test_nan_or_infinity_in_one_gaussian_leaves_the_others_untouched(self, spoilt: str, value: float) -> None:
        rows = random_rows(200, True, time_scale=20.0)
        clean = native(rows)
        rows[spoilt].view(200, -1)[7, 0] = value
        found = native(rows)
        for output, expected in zip(found[:3], clean):
            assert torch.equal(output[found.rows != 7], expected[clean.rows != 7])
        others = torch.arange(200) != 7
        for name, expected in clean.gradients.items():
            assert torch.equal(found.gradients[name][others], expected[others]), name

    @pytest.mark.parametrize("used", range(3), ids=OUTPUTS)
    def test_each_output_alone_has_its_gradient(self, temporal: bool, used: int) -> None:
        rows, alone = random_rows(40, temporal), slice(used, used + 1)
        found, expected = native(rows, used=alone), exact(rows, used=alone)
        for name, gradient in expected.gradients.items():
            assert relative_error(found.gradients[name], gradient) < 5e-6, name

    def test_rows_of_another_number_of_gaussians_are_refused(self) -> None:
        rows = random_rows(10, True)
        rows["right"] = rows["right"][:9]
        with pytest.raises(D2Error, match=r"right has shape \(9, 4\), expected 4 numbers for each of 10 Gaussians"):
            native_slice(rows, AT, *CONSTANTS)

    def test_a_model_slices_in_torch_where_there_is_no_compiler(self, temporal, monkeypatch) -> None:
        model, view = make_model(temporal=temporal), make_views()[-1]
        compiled = model.slice_at(view)
        monkeypatch.setattr(kernel, "library", lambda: None)
        for one, other in zip(model.slice_at(view), compiled):
            torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-6)


def tensor(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


@pytest.mark.parametrize("name", GOLDEN)
def test_slice_agrees_with_the_reference_implementation(name: str) -> None:
    mean, mean_time, scales, left, right, instant, at, covariance, marginal, variance, velocity = GOLDEN[name]
    left, right = (rotation4d.normalized_quaternions(tensor(*side)[:, None]) for side in (left, right))
    factors = rotation4d.rotation_matrices_4d(left, right) * tensor(*scales)[:, None]
    spatial, speed = rotation4d.condition_on_time(factors)
    v_t = (rotation4d.time_row(left, right) * tensor(*scales)[:, None]).square().sum(0)
    np.testing.assert_allclose(v_t[0], variance, rtol=1e-12)
    np.testing.assert_allclose(tensor(*mean) + speed[:, 0] * (instant - mean_time), tensor(*at), atol=5e-9)
    np.testing.assert_allclose(rotation4d.covariances_from_factors(spatial)[0], tensor(*covariance), atol=5e-9)
    np.testing.assert_allclose(rotation4d.temporal_marginal(tensor(instant - mean_time), v_t)[0], marginal, rtol=1e-12)
    if velocity is not None:
        np.testing.assert_allclose(speed[:, 0], tensor(*velocity), atol=5e-9)


PATHS = {"kernel": native, "torch, float32": plain, "torch, float64": exact}
IDENTITY = torch.tensor([1.0, 0, 0, 0])


@pytest.fixture(params=list(PATHS))
def take_slice(request: pytest.FixtureRequest) -> Callable[..., Sliced]:
    """Slice and differentiate the sum of all outputs, by one of the paths."""
    if request.param == "kernel" and kernel.library() is None:
        pytest.skip("there is no C++ compiler")
    return partial(PATHS[request.param], weighed=False)


def axis_aligned(scales: tuple[float, float, float], time_scale: float, time: float = 0.0) -> dict[str, Tensor]:
    """One Gaussian at (1, 2, 3) that does not move."""
    still = {"left": IDENTITY[None].clone(), "right": IDENTITY[None].clone(), "opacity_logits": torch.zeros(1)}
    wide = {"log_scales": torch.tensor([scales]).log(), "log_time_scales": torch.tensor([time_scale]).log()}
    return still | wide | {"positions": torch.tensor([[1.0, 2, 3]]), "times": torch.tensor([time])}


def test_a_zero_quaternion_is_the_identity_and_receives_no_gradient(take_slice, temporal: bool) -> None:
    rows = random_rows(40, temporal, time_scale=20.0)
    sides = ("left", "right") if temporal else ("left",)
    for side in sides:
        rows[side][3] = IDENTITY
    expected = take_slice(rows, 0.5)
    for side in sides:
        rows[side][3] = 0
    found = take_slice(rows, 0.5)
    found.assert_finite()
    for one, other in zip(found[:4], expected):
        assert torch.equal(one, other)
    for side in sides:
        assert not found.gradients[side][3].any()
        assert expected.gradients[side][3].any()


@pytest.mark.parametrize("norm", [1e-20, 1e6, 1e20])
def test_the_norm_of_a_quaternion_changes_nothing_but_its_gradient(take_slice, temporal: bool, norm: float) -> None:
    rows = random_rows(40, temporal, time_scale=20.0)
    sides = ("left", "right") if temporal else ("left",)
    for side in sides:
        rows[side] = torch.nn.functional.normalize(rows[side])
    expected = take_slice(rows, 0.5)
    for side in sides:
        rows[side] = rows[side] * norm
    found = take_slice(rows, 0.5)
    found.assert_finite()
    for one, other in zip(found[:4], expected):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-5)
    for side in sides:
        assert relative_error(found.gradients[side].double() * norm, expected.gradients[side].double()) < 1e-4


@pytest.mark.parametrize("norm", [0.0, 1e-4, 1.0, 6e4])
def test_quaternions_in_half_precision_have_length_one(norm: float) -> None:
    unit = rotation4d.normalized_quaternions(torch.tensor([[0.6], [0.0], [0.8], [0.0]]).mul(norm).half())
    torch.testing.assert_close(unit.norm(dim=0), torch.ones(1, dtype=torch.float16), atol=2e-3, rtol=0)


def test_gradients_include_the_normalisation_of_quaternions(temporal: bool) -> None:
    rows = {name: value.double() for name, value in random_rows(3, temporal, time_scale=5.0).items()}
    for side, norm in (("left", 0.3), ("right", 3.0)):
        if side in rows:
            rows[side] = norm * torch.nn.functional.normalize(rows[side])
    names = list(rows)

    def outputs(*values: Tensor) -> tuple[Tensor, ...]:
        return reference_slice(dict(zip(names, values)), 0.5, *CONSTANTS)[:3]

    assert torch.autograd.gradcheck(outputs, [rows[name].requires_grad_() for name in names])


@pytest.mark.parametrize("log_scale", [100.0, -100.0])
@pytest.mark.parametrize("name", ["log_scales", "log_time_scales"])
def test_a_log_scale_beyond_float32_saturates(take_slice, name: str, log_scale: float) -> None:
    rows = random_rows(40, True, time_scale=20.0)
    rows["times"][3] = 0.5
    rows[name].view(40, -1)[3, 0] = math.copysign(30.0, log_scale)
    at_the_limit = take_slice(rows, 0.5)
    rows[name].view(40, -1)[3, 0] = log_scale
    found = take_slice(rows, 0.5)
    found.assert_finite()
    assert found.gradients[name].view(40, -1)[3, 0] == 0
    for one, other in zip(found[:4], at_the_limit):
        assert torch.equal(one, other)


def test_a_vanishing_temporal_variance_at_its_own_instant_is_fully_there(take_slice) -> None:
    found = take_slice(axis_aligned((0.1, 0.1, 0.1), 1e-38, time=0.5), 0.5)
    found.assert_finite()
    assert found.rows.tolist() == [0]
    assert found.opacities.tolist() == [0.5]
    assert found.gradients["opacity_logits"].tolist() == [0.25]


@pytest.mark.parametrize("offset", [1e-6, 1.0, 1e30])
def test_a_vanishing_temporal_variance_at_another_instant_is_not_there(take_slice, offset: float) -> None:
    found = take_slice(axis_aligned((0.1, 0.1, 0.1), 1e-38), offset)
    assert len(found.rows) == 0
    assert all(not gradient.any() for gradient in found.gradients.values())


@pytest.mark.parametrize("deviations", [0.0, 2.4])
@pytest.mark.parametrize("variance", [1e-20, 1.0, 1e20])
def test_the_marginal_depends_on_standard_deviations_alone(take_slice, variance: float, deviations: float) -> None:
    sigma = math.sqrt(variance)
    found = take_slice(axis_aligned((0.1, 0.1, 0.1), sigma, time=-deviations * sigma), 0.0)
    found.assert_finite()
    marginal = math.exp(-0.5 * deviations**2)
    torch.testing.assert_close(found.opacities[0].item(), 0.5 * marginal, rtol=1e-5, atol=0)
    by_time = found.gradients["times"][0].item() * sigma
    torch.testing.assert_close(by_time, 0.5 * marginal * deviations, rtol=1e-5, atol=1e-12)


def test_a_slice_of_a_long_life_is_positive_definite_as_the_rasterizer_gets_it(take_slice) -> None:
    """Long in time, a hundredth wide in space: the Schur complement of these loses more than half."""
    rows = random_rows(2000, True)
    rows["log_scales"] = torch.tensor([1e-2, 1e-2, 1e-2]).log().expand(2000, 3)
    rows["log_time_scales"] = torch.full((2000,), math.log(100.0))
    found = take_slice(rows, 0.5)
    matrices = covariance_matrices(found.covariances.double())
    # One eigenvalue is 1e-4, one may be as large as 1e4: beyond that, the six float32 numbers cannot hold it.
    narrow = torch.linalg.eigvalsh(matrices)[:, 2] < 1e2
    assert narrow.double().mean() > 0.9
    assert (torch.linalg.eigvalsh(matrices)[narrow, 0] > 0).all()


def test_extreme_draws_stay_finite_with_opacities_in_0_1(take_slice) -> None:
    count, generator = 20_000, torch.Generator().manual_seed(1)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(count, *shape, generator=generator)

    rows = random_rows(count, True)
    rows["positions"] *= 10 ** uniform(-3, 6, 1)
    rows["log_scales"] = uniform(-6, 3, 3) * math.log(10)
    rows["log_time_scales"] = uniform(-6, 3) * math.log(10)
    rows["opacity_logits"] = uniform(-20, 20)
    rows["left"] *= 10 ** uniform(-10, 10, 1)
    rows["right"] *= 10 ** uniform(-10, 10, 1)
    rows["times"] = torch.randn(count, generator=generator) * 10 ** uniform(-6, 3)
    found = take_slice(rows, 0.0)
    found.assert_finite()
    assert len(found.rows) > count / 10
    assert ((found.opacities >= 0) & (found.opacities <= 1)).all()
