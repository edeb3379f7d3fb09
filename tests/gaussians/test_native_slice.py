"""The slice in the kernel is the slice in torch: values, gradients, edges of the lanes, threads."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import pytest
import torch
from slice_scenes import AT, CONSTANTS, GOLDEN, random_rows, relative_error
from tiny import make_model, make_views
from torch import Tensor

from d2_plugin import D2Error
from d2_plugin.gaussians import native_slice as kernel
from d2_plugin.gaussians.native_slice import TEMPORAL, native_slice
from d2_plugin.gaussians.slicing import reference_slice

OUTPUTS = ("means", "covariances", "opacities")


@pytest.fixture(autouse=True)
def compiled() -> None:
    if kernel.library() is None:
        pytest.skip("there is no C++ compiler")


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


@pytest.mark.parametrize("name", GOLDEN)
def test_kernel_agrees_with_the_reference_implementation(name: str) -> None:
    mean, mean_time, scales, left, right, instant, at, covariance, marginal, _, _ = GOLDEN[name]
    rows = {
        "positions": torch.tensor([mean], dtype=torch.float32),
        "log_scales": torch.tensor([scales[:3]]).log(),
        "left": torch.tensor([left], dtype=torch.float32),
        "opacity_logits": torch.zeros(1),
        "times": torch.tensor([mean_time]),
        "log_time_scales": torch.tensor(scales[3:]).log(),
        "right": torch.tensor([right], dtype=torch.float32),
    }
    means, covariances, opacities, drawn = native_slice(rows, instant, *CONSTANTS)
    assert drawn.tolist() == [0]
    torch.testing.assert_close(means[0], torch.tensor(at, dtype=torch.float32), atol=5e-7, rtol=1e-6)
    torch.testing.assert_close(covariances[0], torch.tensor(covariance, dtype=torch.float32), atol=2e-8, rtol=1e-5)
    torch.testing.assert_close(opacities[0], torch.tensor(0.5 * marginal), atol=0, rtol=1e-6)


def test_the_number_of_threads_changes_no_bit(temporal: bool, same_for_any_threads: Callable) -> None:
    def everything() -> list[Tensor]:
        outputs, gradients = slice_with_gradients(native_slice, random_rows(10_000, temporal), torch.float32)
        return [*outputs, *gradients.values()]

    same_for_any_threads(everything)


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


def test_rows_of_another_number_of_gaussians_are_refused() -> None:
    rows = random_rows(10, True)
    rows["right"] = rows["right"][:9]
    with pytest.raises(D2Error, match=r"right has shape \(9, 4\), expected 4 numbers for each of 10 Gaussians"):
        native_slice(rows, AT, *CONSTANTS)


def test_a_model_slices_in_torch_where_there_is_no_compiler(temporal: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    model, view = make_model(temporal=temporal), make_views()[-1]
    native = model.slice_at(view)
    assert "_Slice" in type(native.covariances.grad_fn).__name__
    monkeypatch.setattr(kernel, "library", lambda: None)
    plain = model.slice_at(view)
    assert "_Slice" not in type(plain.covariances.grad_fn).__name__
    for one, other in zip(native, plain):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-6)
