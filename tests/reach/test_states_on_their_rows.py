"""Batches, accumulated gradients, restored checkpoints, opacity resets, relocation: every state stays on its row.

A mark rides in a raw parameter that nothing trains, in Adam's moments and in a hook of D2. Whatever the trainer and D2
clone, split, insert, relocate and remove, the three agree on every row that is old.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
import torch
from mimics import fudan, gsplat, hust4d
from mimics.inria import default_options, l1_loss
from mimics.page import attached
from mimics.workplace import furnish
from tiny import TinyFrames, TinyStore
from torch import Tensor

from d2_plugin import D2Hooks
from d2_plugin.adapters.gsplat_dict import GsplatAdapter
from d2_plugin.config import D2Config, DensifyConfig, DepthLossConfig, PruneConfig
from d2_plugin.hooks.hook import Hook, HookConfig

PLACE = (slice(None), 14, 2)
"""Of the mark in the spherical harmonics: the last coefficient, whose gradient the mimics leave at zero."""

CONFIG = D2Config(
    densify=DensifyConfig(start=5, stop=60, every=10, budget_per_view=15),
    prune=PruneConfig(start=5, stop=60, every=10, patience=2, tau_p=0.6),
    depth_loss=DepthLossConfig(every=1),
)


class Marks(Hook):
    """A hook that keeps one number per Gaussian and nothing else; new rows have 0."""

    def __init__(self, marks: Tensor) -> None:
        super().__init__(HookConfig())
        self.marks = marks.clone()

    def follow(self, index: Tensor) -> None:
        self.marks = torch.where(index >= 0, self.marks[index.clamp(min=0)], 0.0)

    def reset(self) -> None:
        raise AssertionError("the number of Gaussians changed without a report")

    def state_dict(self) -> dict[str, Tensor]:
        return {"marks": self.marks}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        self.marks = state["marks"].clone()


def mark(rest: Tensor, moments: dict[str, Tensor], marks: Tensor) -> None:
    """Into the parameter, and into the second moment, whose share of a step is zero where the first is."""
    rest.data[PLACE] = marks
    moments["exp_avg_sq"][PLACE] = marks


def disagreements(rest: Tensor, moments: Mapping[str, Tensor], hook: Marks, steps: int) -> list[int]:
    """Rows that are old by Adam's state and on which parameter, moment and hook do not agree; checks some are old."""
    faded = moments["exp_avg_sq"][PLACE].double() / 0.999**steps
    parameter = rest.detach()[PLACE].double()
    old = faded > 0.5
    assert int(old.sum()) > 5
    wrong = old & (((faded - parameter).abs() > 0.25) | ((hook.marks.double() - parameter).abs() > 0.25))
    # a row that the hook calls old carries the mark it came with: clones are new to D2
    wrong |= (hook.marks > 0) & ((hook.marks.double() - parameter).abs() > 0.25)
    return torch.nonzero(wrong).squeeze(1).tolist()


def attached_with_marks(mimic: ModuleType, page: str) -> ModuleType:
    """The mimic with the page's lines and, after the first, a second D2 on the same adapter that has the marks."""
    return attached(mimic, page, after_first="d2 = WITH_MARKS(d2, gaussians, scene, iteration0=first_iter)")


@pytest.mark.parametrize("batch", [2, 4])
@pytest.mark.parametrize("name", ["fudan", "hust4d"])
def test_batches_of_views_with_resets_and_restored_checkpoints(
    name: str, batch: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """fudan accumulates gradients over the views of a batch, one backward each; 4DGaussians has one for all of them."""
    furnish(tmp_path, monkeypatch)
    mimic = {"fudan": fudan, "hust4d": hust4d}[name]
    source, kept = attached_with_marks(mimic, name), SimpleNamespace(state=None, hook=None, resets=0)

    def with_marks(d2: D2Hooks, gaussians, scene, iteration0: int) -> D2Hooks:
        marks = gaussians._features_rest.detach()[PLACE]
        if not iteration0 and getattr(d2.backbone, "stage", "fine") == "fine":
            marks = torch.arange(1.0, 1 + len(marks))
            sum((getattr(gaussians, attribute) * 0).sum() for _, attribute in gaussians.columns).backward()
            gaussians.optimizer.step()
            gaussians.optimizer.zero_grad(set_to_none=True)
            mark(gaussians._features_rest, gaussians.optimizer.state[gaussians._features_rest], marks)
        kept.hook = Marks(marks)
        reset = gaussians.reset_opacity
        gaussians.reset_opacity = lambda: (reset(), setattr(kept, "resets", kept.resets + 1))
        made = D2Hooks(CONFIG, d2.backbone, TinyStore(), hooks={"marks": kept.hook})
        if kept.state is not None:
            made.load_state_dict(kept.state)
        return made

    source.WITH_MARKS = with_marks
    options = default_options(batch_size=batch, opacity_reset_interval=11, densify_grad_threshold=3e-2)
    first = source.training(*mimic.make(), opt=options, stop=18)
    checkpoint = copy.deepcopy((first.gaussians.capture(), 18))
    kept.state = copy.deepcopy(first.d2.state_dict())
    second = source.training(*mimic.make(), opt=options, checkpoint=checkpoint, stop=36)
    for outcome, steps in ((first, 18), (second, 36)):
        rest, hook = outcome.gaussians._features_rest, outcome.d2.hooks["marks"]
        moments = outcome.gaussians.optimizer.state[rest]
        assert disagreements(rest, moments, hook, steps) == []
    assert kept.resets >= 3 or name == "hust4d"
    actions = {entry.action for entry in second.d2.trace}
    assert {"insert", "remove"} <= actions, f"only {actions}: this could not fail"


@pytest.mark.parametrize(("views", "accumulate"), [(2, 3), (4, 2)])
def test_accumulated_gradients_with_relocation_and_opacity_resets(views: int, accumulate: int) -> None:
    """gsplat's dict under MCMC: dead Gaussians become copies of living ones, and D2 counts both anew."""
    frames, (splats, optimizers, _) = TinyFrames(), gsplat.make()
    state: dict[str, object] = {"grad2d": torch.zeros(60), "count": torch.zeros(60)}
    hook = Marks(torch.arange(1.0, 61))
    sum((p * 0).sum() for p in splats.values()).backward()
    for optimizer in optimizers.values():
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
    mark(splats["shN"], optimizers["shN"].state[splats["shN"]], hook.marks)
    d2 = D2Hooks(CONFIG, GsplatAdapter(splats, optimizers, state), TinyStore(), hooks={"marks": hook})
    relocated = 0
    for step in range(1, 31):
        for part in range(accumulate):
            chosen = [(step + part + i) % len(frames.views) for i in range(views)]
            images = torch.stack([gsplat.render(splats, frames.views[i]).image for i in chosen])
            loss = l1_loss(images, torch.stack([frames.image(i) for i in chosen]))
            loss = loss + d2.loss(step, [frames.views[i] for i in chosen])
            (loss / accumulate).backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        relocated += mcmc(splats, optimizers, state, step)
        d2.step(step)
    assert relocated == 12
    assert {entry.action for entry in d2.trace} >= {"insert", "remove"}
    assert disagreements(splats["shN"], optimizers["shN"].state[splats["shN"]], hook, 30) == []


@torch.no_grad()
def mcmc(splats, optimizers, state, step: int) -> int:
    """Relocation, growth and a reset of opacities at their steps; returns how many were relocated."""
    if step % 9 == 0:
        faint = torch.sigmoid(splats["opacities"]).argsort()[:4]
        dead = torch.zeros(len(splats["means"]), dtype=torch.bool).index_fill(0, faint, True)
        gsplat.relocate(splats, optimizers, state, dead)
        living = torch.where(~dead)[0][: int(dead.sum())]
        # gsplat zeroes the moments of what was copied from (ops.py, relocate); the copies' rows are overwritten
        for name, parameter in splats.items():
            for key in ("exp_avg", "exp_avg_sq"):
                optimizers[name].state[parameter][key][living] = 0
                optimizers[name].state[parameter][key][dead] = 0
        return len(faint)
    if step % 13 == 0:
        gsplat.sample_add(splats, optimizers, state, 3)
    if step == 21:
        splats["opacities"].data.clamp_(max=0.0)
        for value in optimizers["opacities"].state[splats["opacities"]].values():
            value.zero_()
    return 0
