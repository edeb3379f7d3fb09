"""Adam in one kernel is torch's: the same numbers, the same state, any number of threads, and torch where it must."""

from __future__ import annotations

import copy
import io

import pytest
import torch
from torch import Tensor, nn

from d2_plugin.gaussians import native_adam
from d2_plugin.gaussians.native_adam import Adam

SHAPES = [(4000, 3), (17,), (1, 3), (40_001,), (0, 3)]
RATES = [1e-2, 3e-4, 1.0, 5e-2, 1e-3]


@pytest.fixture(autouse=True)
def compiled() -> None:
    if native_adam.library() is None:
        pytest.skip("there is no C++ compiler")


def start(kind: type, dtype: torch.dtype = torch.float32, **options: object) -> torch.optim.Optimizer:
    generator = torch.Generator().manual_seed(0)
    values = [nn.Parameter(torch.randn(shape, generator=generator).to(dtype)) for shape in SHAPES]
    groups = [{"params": [value], "lr": rate} for value, rate in zip(values, RATES, strict=True)]
    return kind(groups, eps=1e-15, **options)


def values_of(optimizer: torch.optim.Optimizer) -> list[Tensor]:
    return [value for group in optimizer.param_groups for value in group["params"]]


def train(optimizer: torch.optim.Optimizer, steps: int, first: int = 0) -> list[Tensor]:
    """So many steps with gradients of very different sizes, zero at every third number; the values after them."""
    for step in range(first, first + steps):
        generator = torch.Generator().manual_seed(step)
        for value in values_of(optimizer):
            gradient = torch.randn(value.shape, generator=generator) * 10 ** (step % 7 - 4)
            gradient.view(-1)[::3] = 0
            value.grad = gradient.to(value.dtype)
        optimizer.step()
    return [value.detach().clone() for value in values_of(optimizer)]


def test_it_is_as_near_to_float64_as_torchs_own() -> None:
    exact = train(start(torch.optim.Adam, torch.float64), 40)
    ours, theirs = train(start(Adam, fused=True), 40), train(start(torch.optim.Adam, fused=True), 40)
    for one, other, true in zip(ours[:4], theirs[:4], exact[:4], strict=True):
        assert (one - true).abs().max() <= 2 * (other - true).abs().max() + 1e-7
        torch.testing.assert_close(one, other, rtol=2e-5, atol=2e-6)


@pytest.mark.usefixtures("threads")
def test_any_number_of_threads_gives_the_same_bits() -> None:
    results = []
    for count in (1, 2, 3):
        torch.set_num_threads(count)
        results.append(train(start(Adam), 5))
    assert all(torch.equal(*pair) for result in results[1:] for pair in zip(results[0], result, strict=True))


def test_its_state_is_torchs_so_each_continues_from_the_other() -> None:
    ours, theirs = start(Adam, fused=True), start(torch.optim.Adam, fused=True)
    train(ours, 3), train(theirs, 3)
    mine, other = ours.state_dict(), theirs.state_dict()
    assert mine["state"].keys() == other["state"].keys()
    for key, state in mine["state"].items():
        assert {name: (part.shape, part.dtype) for name, part in state.items()} == {
            name: (part.shape, part.dtype) for name, part in other["state"][key].items()
        }
        assert state["step"] == 3
    theirs.load_state_dict(copy.deepcopy(mine))
    with torch.no_grad():
        for value, from_ours in zip(values_of(theirs), values_of(ours), strict=True):
            value.copy_(from_ours)
    for one, other_value in zip(train(ours, 3, first=3), train(theirs, 3, first=3), strict=True):
        torch.testing.assert_close(one, other_value, rtol=2e-5, atol=2e-6)


def test_a_resumed_run_is_bitwise_the_uninterrupted_one() -> None:
    whole = train(start(Adam), 6)
    first, second = start(Adam), start(Adam)
    train(first, 3)
    buffer = io.BytesIO()
    torch.save([first.state_dict(), values_of(first)], buffer)
    buffer.seek(0)
    state, values = torch.load(buffer, weights_only=True)
    second.load_state_dict(state)
    with torch.no_grad():
        for value, saved in zip(values_of(second), values, strict=True):
            value.copy_(saved)
    assert all(torch.equal(*pair) for pair in zip(whole, train(second, 3, first=3), strict=True))


def test_moments_that_were_exchanged_are_the_ones_that_are_used() -> None:
    """Structure edits put new tensors in the state: the kernel may not write to the old ones."""
    optimizer = start(Adam)
    train(optimizer, 2)
    value = values_of(optimizer)[0]
    before = optimizer.state[value]["exp_avg"]
    optimizer.state[value]["exp_avg"] = torch.zeros_like(before)
    kept = before.clone()
    train(optimizer, 1)
    assert torch.equal(before, kept)
    assert optimizer.state[value]["exp_avg"].any()


def test_parameters_without_a_gradient_stay() -> None:
    optimizer = start(Adam)
    train(optimizer, 2)
    still, moving = values_of(optimizer)[:2]
    before = still.detach().clone(), moving.detach().clone()
    still.grad = None
    optimizer.step()
    assert torch.equal(still, before[0])
    assert not torch.equal(moving, before[1])
    assert (optimizer.state[still]["step"], optimizer.state[moving]["step"]) == (2, 3)


@pytest.mark.parametrize("options", [{"weight_decay": 0.1}, {"amsgrad": True}, {"maximize": True}])
def test_what_the_kernel_does_not_know_is_torchs_own(options: dict[str, object]) -> None:
    pairs = zip(train(start(Adam, **options), 3), train(start(torch.optim.Adam, **options), 3), strict=True)
    assert all(torch.equal(*pair) for pair in pairs)


def test_float64_and_gradients_that_are_not_contiguous_are_torchs_own() -> None:
    pairs = zip(train(start(Adam, torch.float64), 3), train(start(torch.optim.Adam, torch.float64), 3), strict=True)
    assert all(torch.equal(*pair) for pair in pairs)
    results = []
    for kind in (Adam, torch.optim.Adam):
        value = nn.Parameter(torch.ones(5, 7))
        optimizer = kind([value], lr=0.1)
        value.grad = torch.arange(35.0).view(7, 5).T
        optimizer.step()
        results.append(value.detach())
    assert torch.equal(*results)


def test_a_graph_that_needs_the_old_values_is_refused() -> None:
    value = nn.Parameter(torch.ones(3))
    optimizer = Adam([value], lr=0.1)
    loss = value.square().sum()
    value.grad = torch.ones(3)
    optimizer.step()
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


def test_a_nan_in_one_number_spoils_no_other() -> None:
    value = nn.Parameter(torch.ones(40))
    optimizer = Adam([value], lr=0.1)
    value.grad = torch.ones(40).index_fill(0, torch.tensor([7]), torch.nan)
    optimizer.step()
    assert value.isnan().nonzero().tolist() == [[7]]
