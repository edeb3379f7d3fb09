"""The slice of a 4D Gaussian: golden vectors, the kernel against torch, and where numbers end."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
import pytest
import torch
from slice_scenes import AT, CONSTANTS, GOLDEN, random_rows, relative_error
from tiny import make_model, make_views
from torch import Tensor

from d2_plugin import D2Error
from d2_plugin.gaussians import native_slice as kernel
from d2_plugin.gaussians.native_slice import TEMPORAL, native_slice
from d2_plugin.gaussians.rotation4d import (
    condition_on_time,
    covariances_from_factors,
    normalized_quaternions,
    rotation_matrices_4d,
    temporal_marginal,
    time_row,
)
from d2_plugin.gaussians.slicing import reference_slice

OUTPUTS = ("means", "covariances", "opacities")


@pytest.fixture
def compiled() -> None:
    if kernel.library() is None:
        pytest.skip("there is no C++ compiler")


needs_compiler = pytest.mark.usefixtures("compiled")


@pytest.fixture(params=[True, False], ids=["temporal", "static"])
def temporal(request: pytest.FixtureRequest) -> bool:
    return request.param


def slice_with_gradients(slice_in, rows: Mapping[str, Tensor], dtype: torch.dtype, seed: int = 7, at: float = AT):
    """Outputs, and gradients of a fixed random sum of them, of `slice_in` (native or torch) in `dtype`."""
    raw = {name: value.to(dtype, copy=True).requires_grad_() for name, value in rows.items()}
    *outputs, drawn = slice_in(raw, at, *CONSTANTS)
    generator = torch.Generator().manual_seed(seed)
    upstream = [torch.randn(output.shape, generator=generator).to(dtype) for output in outputs]
    torch.autograd.backward(outputs, upstream)
    return (*(o.detach() for o in outputs), drawn), {name: value.grad for name, value in raw.items()}


@needs_compiler
@pytest.mark.parametrize("time_scale", [0.02, 0.5, 2.0])
@pytest.mark.parametrize("count", [0, 1, 15, 16, 17, 1040, 3001])
def test_values_and_gradients_are_those_of_torch_in_float64(count: int, time_scale: float, temporal: bool) -> None:
    rows = random_rows(count, temporal, count, time_scale)
    native, native_gradients = slice_with_gradients(native_slice, rows, torch.float32)
    exact, exact_gradients = slice_with_gradients(reference_slice, rows, torch.float64)
    assert torch.equal(native[3], exact[3])
    for name, value, expected in zip(OUTPUTS, native, exact):
        assert value.is_contiguous()
        assert relative_error(value, expected) < 2e-6, name
    for name, expected in exact_gradients.items():
        assert relative_error(native_gradients[name], expected) < 1e-5, name


@needs_compiler
def test_where_float32_is_short_of_digits_the_kernel_loses_no_more_than_torch() -> None:
    rows = random_rows(300, True, time_scale=200.0)  # velocities are ratios of numbers three orders apart
    native, native_gradients = slice_with_gradients(native_slice, rows, torch.float32)
    plain, plain_gradients = slice_with_gradients(reference_slice, rows, torch.float32)
    exact, exact_gradients = slice_with_gradients(reference_slice, rows, torch.float64)
    assert torch.equal(native[3], exact[3])
    for name, value, other, expected in zip(OUTPUTS, native, plain, exact):
        assert relative_error(value, expected) < 2e-6 + 1.5 * relative_error(other, expected), name
    for name, expected in exact_gradients.items():
        allowed = 2e-6 + 1.5 * relative_error(plain_gradients[name], expected)
        assert relative_error(native_gradients[name], expected) < allowed, name


@needs_compiler
def test_the_number_of_threads_changes_no_bit(temporal: bool, same_for_any_threads: Callable) -> None:
    def everything() -> list[Tensor]:
        outputs, gradients = slice_with_gradients(native_slice, random_rows(10_000, temporal), torch.float32)
        return [*outputs, *gradients.values()]

    same_for_any_threads(everything)


@needs_compiler
@pytest.mark.parametrize("spoilt", list(TEMPORAL))
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_nan_or_infinity_in_one_gaussian_leaves_the_others_untouched(spoilt: str, value: float) -> None:
    rows = random_rows(200, True, time_scale=20.0)
    clean, clean_gradients = slice_with_gradients(native_slice, rows, torch.float32)
    rows[spoilt].view(200, -1)[7, 0] = value
    # The same upstream gradient for each Gaussian, whether or not the spoilt one is still drawn.
    raw = {name: tensor.clone().requires_grad_() for name, tensor in rows.items()}
    *outputs, drawn = native_slice(raw, AT, *CONSTANTS)
    generator = torch.Generator().manual_seed(7)
    upstream, places = (
        [torch.randn(o.shape, generator=generator) for o in clean[:3]],
        torch.searchsorted(clean[3], drawn),
    )
    torch.autograd.backward(outputs, [gradient[places] for gradient in upstream])
    for output, expected in zip(outputs, clean):
        assert torch.equal(output[drawn != 7], expected[clean[3] != 7])
    others = torch.arange(200) != 7
    for name, tensor in raw.items():
        assert torch.equal(tensor.grad[others], clean_gradients[name][others]), name


@needs_compiler
def test_each_output_alone_has_its_gradient(temporal: bool) -> None:
    rows = random_rows(40, temporal)
    for output in range(3):
        gradients = []
        for slice_in, dtype in ((native_slice, torch.float32), (reference_slice, torch.float64)):
            raw = {name: value.to(dtype, copy=True).requires_grad_() for name, value in rows.items()}
            slice_in(raw, AT, *CONSTANTS)[output].square().sum().backward()
            gradients.append({name: value.grad for name, value in raw.items()})
        for name, expected in gradients[1].items():
            found = gradients[0][name]
            assert found is not None
            if expected is None or not expected.any():
                assert not found.any(), name
            else:
                assert relative_error(found, expected) < 5e-6, name


@needs_compiler
def test_rows_of_another_number_of_gaussians_are_refused() -> None:
    rows = random_rows(10, True)
    rows["right"] = rows["right"][:9]
    with pytest.raises(D2Error, match=r"right has shape \(9, 4\), expected 4 numbers for each of 10 Gaussians"):
        native_slice(rows, AT, *CONSTANTS)


@needs_compiler
def test_a_model_slices_in_torch_where_there_is_no_compiler(temporal: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    model, view = make_model(temporal=temporal), make_views()[-1]
    native = model.slice_at(view)
    assert "_Slice" in type(native.covariances.grad_fn).__name__
    monkeypatch.setattr(kernel, "library", lambda: None)
    plain = model.slice_at(view)
    assert "_Slice" not in type(plain.covariances.grad_fn).__name__
    for one, other in zip(native, plain):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-6)


def tensor(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


@pytest.mark.parametrize("name", GOLDEN)
def test_slice_agrees_with_the_reference_implementation(name: str) -> None:
    mean, mean_time, scales, left, right, instant, at, covariance, marginal, variance, velocity = GOLDEN[name]
    left, right = normalized_quaternions(tensor(*left)[:, None]), normalized_quaternions(tensor(*right)[:, None])
    factors = rotation_matrices_4d(left, right) * tensor(*scales)[:, None]
    spatial, speed = condition_on_time(factors)
    v_t = (time_row(left, right) * tensor(*scales)[:, None]).square().sum(0)
    np.testing.assert_allclose(v_t[0], variance, rtol=1e-12)
    np.testing.assert_allclose(tensor(*mean) + speed[:, 0] * (instant - mean_time), tensor(*at), atol=5e-9)
    np.testing.assert_allclose(covariances_from_factors(spatial)[0], tensor(*covariance), atol=5e-9)
    np.testing.assert_allclose(temporal_marginal(tensor(instant - mean_time), v_t)[0], marginal, rtol=1e-12)
    if velocity is not None:
        np.testing.assert_allclose(speed[:, 0], tensor(*velocity), atol=5e-9)


PATHS = {
    "kernel": (native_slice, torch.float32),
    "torch, float32": (reference_slice, torch.float32),
    "torch, float64": (reference_slice, torch.float64),
}

IDENTITY = torch.tensor([1.0, 0, 0, 0])


class Sliced(NamedTuple):
    means: Tensor
    covariances: Tensor
    opacities: Tensor
    rows: Tensor
    gradients: dict[str, Tensor]

    def assert_finite(self) -> None:
        for name, tensor in (*zip(self._fields, self[:3]), *self.gradients.items()):
            assert torch.isfinite(tensor).all(), name


@pytest.fixture(params=list(PATHS))
def take_slice(request: pytest.FixtureRequest) -> Callable[..., Sliced]:
    """Slice and differentiate the sum of all outputs, by one of the paths."""
    slice_in, dtype = PATHS[request.param]
    if slice_in is native_slice and kernel.library() is None:
        pytest.skip("there is no C++ compiler")

    def run(rows: Mapping[str, Tensor], at: float) -> Sliced:
        raw = {name: value.to(dtype, copy=True).requires_grad_() for name, value in rows.items()}
        *outputs, drawn = slice_in(raw, at, *CONSTANTS)
        torch.autograd.backward(outputs, [torch.ones_like(output) for output in outputs])
        gradients = {name: torch.zeros_like(value) if value.grad is None else value.grad for name, value in raw.items()}
        return Sliced(*(output.detach() for output in outputs), drawn, gradients)

    return run


def axis_aligned(scales: tuple[float, float, float], time_scale: float, time: float = 0.0) -> dict[str, Tensor]:
    """One Gaussian at (1, 2, 3) that does not move."""
    return {
        "positions": torch.tensor([[1.0, 2, 3]]),
        "log_scales": torch.tensor([scales]).log(),
        "left": IDENTITY[None].clone(),
        "opacity_logits": torch.zeros(1),
        "times": torch.tensor([time]),
        "log_time_scales": torch.tensor([time_scale]).log(),
        "right": IDENTITY[None].clone(),
    }


@pytest.mark.parametrize("temporal", [True, False])
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


@pytest.mark.parametrize("norm", [1e-20, 1e-6, 1e6, 1e20])
@pytest.mark.parametrize("temporal", [True, False])
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
    unit = normalized_quaternions(torch.tensor([[0.6], [0.0], [0.8], [0.0]]).mul(norm).half())
    torch.testing.assert_close(unit.norm(dim=0), torch.ones(1, dtype=torch.float16), atol=2e-3, rtol=0)


@pytest.mark.parametrize("temporal", [True, False])
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


@pytest.mark.parametrize("offset", [1e-6, 1.0, 1e9, 1e30])
def test_a_vanishing_temporal_variance_at_another_instant_is_not_there(take_slice, offset: float) -> None:
    found = take_slice(axis_aligned((0.1, 0.1, 0.1), 1e-38), offset)
    assert len(found.rows) == 0
    assert all(not gradient.any() for gradient in found.gradients.values())


@pytest.mark.parametrize("deviations", [0.0, 1.0, 2.4])
@pytest.mark.parametrize("variance", [1e-20, 1e-10, 1.0, 1e10, 1e20])
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
    xx, xy, xz, yy, yz, zz = found.covariances.double().T
    matrices = torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], -1).view(-1, 3, 3)
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
