"""No evaluation can take a model away: the hooks remove at most a stated share of the Gaussians in one step."""

from __future__ import annotations

import logging
from dataclasses import replace

import pytest
import torch
from tiny import TinyStore, make_adapter, make_model

from d2_plugin import D2Config, D2Hooks
from d2_plugin.config import DensifyConfig, PruneConfig
from d2_plugin.protocol import Edit

CONFIG = D2Config(densify=DensifyConfig(start=1, every=1), prune=PruneConfig(start=1, every=1), retire_after=0)


def hooks_that_remove(masks: dict[str, torch.Tensor], **settings: float) -> tuple[D2Hooks, torch.Tensor]:
    """Hooks that ask for these rows to go, and the positions before."""
    model = make_model(count=40)
    d2 = D2Hooks(replace(CONFIG, **settings), make_adapter(model), TinyStore())
    for name, mask in masks.items():
        d2.hooks[name].edit = lambda context, mask=mask: Edit(remove=mask)
    return d2, model.gaussians["positions"].detach().clone()


@pytest.mark.parametrize(("settings", "gone"), [({}, 36), ({"remove_at_most": 1}, 40)], ids=["default", "no limit"])
def test_some_stay_by_default_whatever_is_asked_for(settings: dict[str, float], gone: int) -> None:
    d2, _ = hooks_that_remove({"prune": torch.ones(40, dtype=torch.bool)}, **settings)
    assert d2.step(1).removed == gone


def test_what_stays_is_spread_over_the_rows_and_it_is_said(caplog: pytest.LogCaptureFixture) -> None:
    d2, before = hooks_that_remove({"prune": torch.ones(40, dtype=torch.bool)}, remove_at_most=0.5)
    with caplog.at_level(logging.WARNING):
        assert d2.step(1).removed == 20
    assert "the hooks would remove 40 of 40 Gaussians, and at most 20 go in one step (remove_at_most)" in caplog.text
    kept = d2.backbone.model.gaussians["positions"]
    assert torch.equal(kept, before[1::2]), "spread over the rows, not the first half of them"


def test_hooks_together_stay_below_it() -> None:
    rows = torch.arange(40)
    d2, _ = hooks_that_remove({"densify": rows < 15, "prune": rows >= 30}, remove_at_most=0.25)
    assert d2.step(1).removed == 10
    counts = {trace.hook: trace.count for trace in d2.trace if trace.action == "remove"}
    assert counts == {"densify": 6, "prune": 4}


def test_what_is_less_goes_as_it_was_asked_for() -> None:
    rows = torch.arange(40)
    for share in (0.5, 0.9, 1.0):
        d2, before = hooks_that_remove({"prune": rows % 3 == 0}, remove_at_most=share)
        assert d2.step(1).removed == 14
        assert torch.equal(d2.backbone.model.gaussians["positions"], before[rows % 3 != 0])
