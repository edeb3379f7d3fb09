"""`densify.max_gaussians`, where a user sets it, also bounds what the trainer's own densification adds."""

from __future__ import annotations

import logging

import pytest
import torch
from tiny import TinyStore, make_adapter, make_model, make_views

from d2_plugin import D2Hooks
from d2_plugin.config import D2Config, DensifyConfig
from d2_plugin.hooks.edits import faintest
from d2_plugin.protocol import Points


def grown(most: int | None, steps: int = 4) -> tuple[D2Hooks, list[int]]:
    """A toy trainer that adds ten Gaussians a step, the last of them faintest, long after insertion has ended."""
    model = make_model()
    adapter = make_adapter(model)
    densify = DensifyConfig(start=1, stop=2, max_gaussians=most, budget_per_view=5)
    d2, counts = D2Hooks(D2Config(densify=densify), adapter, TinyStore()), []
    for step in range(1, steps + 1):
        d2.loss(step, make_views()[0])
        ones = torch.ones(10)
        positions = torch.tensor([0.0, 0.0, 3.0]).repeat(10, 1)
        adapter.insert(Points(positions, positions * 0, ones * 0, ones / 10, torch.linspace(0.9, 0.1, 10)))
        d2.step(step)
        counts.append(len(adapter))
    return d2, counts


def test_the_trainers_own_growth_stops_at_the_cap_and_it_is_said_once(caplog: pytest.LogCaptureFixture) -> None:
    before = len(make_adapter(make_model()))
    with caplog.at_level(logging.INFO, logger="d2_plugin"):
        d2, counts = grown(before + 14)
    assert max(counts) == counts[-1] == before + 14
    assert caplog.text.count("above max_gaussians") == 1
    assert d2.log.capped > 0
    assert f"({d2.log.capped} above max_gaussians)" in d2.log.summary()


def test_without_a_cap_nothing_of_the_trainers_is_removed() -> None:
    d2, counts = grown(None)
    assert counts[-1] - counts[0] == 30
    assert "max_gaussians" not in d2.log.summary()


def test_what_was_there_before_stays_where_the_cap_is_below_it(caplog: pytest.LogCaptureFixture) -> None:
    before = len(make_adapter(make_model()))
    _, counts = grown(before - 5)
    assert counts == [before] * 4
    assert f"step 1: {before + 10} Gaussians, so none are inserted: max_gaussians = {before - 5}" in caplog.text


def test_the_faintest_of_the_newest_go() -> None:
    class Slice:
        def __init__(self, rows: list[int], opacities: list[float]) -> None:
            self.rows, self.opacities = torch.tensor(rows), torch.tensor(opacities)

    fresh = torch.tensor([0, 0, 1, 1, 1, 1])
    slices = [Slice([0, 2, 3, 4], [0.01, 0.9, 0.1, 0.3]), Slice([1, 3, 5], [0.01, 0.8, 0.2])]
    assert faintest(fresh, 2, slices).tolist() == [False, False, False, False, True, True]
    assert faintest(fresh, 9, slices).tolist() == [False, False, True, True, True, True]
