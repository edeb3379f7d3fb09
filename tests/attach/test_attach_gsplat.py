"""gsplat's dict of parameters: its strategies change entries of dicts, and D2 still knows what became of each row."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mimics import gsplat
from mimics.page import attached, changed_lines
from mimics.workplace import HOOKS, furnish, some_points
from tiny import make_views
from torch import Tensor, nn

from d2_plugin import D2Config, D2Error
from d2_plugin.adapters.gsplat_dict import GsplatAdapter, gsplat_view
from d2_plugin.protocol import Backbone
from d2_plugin.rasterizer import rasterize
from d2_plugin.registry import ADAPTERS, load
from d2_plugin.testing import Example, check_backbone


def snapshot(splats) -> dict[str, Tensor]:
    return {name: value.detach().clone() for name, value in splats.items()}


def same(a: dict[str, Tensor], b: dict[str, Tensor]) -> bool:
    return all(torch.equal(a[name], b[name]) for name in a)


def run(source=gsplat, **options):
    return source.training(*gsplat.make(), **options)


def make_adapter() -> tuple[GsplatAdapter, tuple]:
    """The adapter, and what the operations of gsplat.strategy.ops work on; every parameter has moments."""
    splats, optimizers, strategy = gsplat.make()
    state = strategy.initialize_state() | {"grad2d": torch.zeros(60), "count": torch.zeros(60)}
    sum((p * 0).sum() for p in splats.values()).backward()
    for optimizer in optimizers.values():
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
    return GsplatAdapter(splats, optimizers, state), (splats, optimizers, state)


def test_three_lines_and_an_import_attach_d2() -> None:
    assert changed_lines("gsplat") == [
        'd2 = D2Hooks.attach("d2.toml", "gsplat", splats, optimizers, strategy_state)',
        "loss = loss + d2.loss(step, view)",
        "d2.step(step)",
    ]


def test_all_hooks_off_is_bitwise_the_bare_loop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, source = furnish(tmp_path, monkeypatch), attached(gsplat, "gsplat")
    full = run(source)
    (folder / "d2.toml").write_text(D2Config().to_toml())
    bare, off = snapshot(run().splats), snapshot(run(source).splats)
    assert same(bare, off)
    assert len(full.splats["means"]) != len(bare["means"]), "the hooks changed nothing: this test could not fail"
    assert {entry.hook for entry in full.d2.trace} == {"densify", "prune", "depth_loss"}


def test_a_resumed_run_is_bitwise_the_uninterrupted_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = furnish(tmp_path, monkeypatch)
    (folder / "d2.toml").write_text(replace(HOOKS, prior="prior").to_toml())
    source = attached(gsplat, "gsplat", after_first="if D2_STATE and checkpoint: d2.load_state_dict(D2_STATE)")
    source.D2_STATE = None
    whole, first = run(source), run(source, stop=53)
    moments = {name: optimizer.state_dict() for name, optimizer in first.optimizers.items()}
    checkpoint = copy.deepcopy(((snapshot(first.splats), moments, first.strategy_state), 53))
    source.D2_STATE = first.d2.state_dict()
    assert same(snapshot(whole.splats), snapshot(run(source, checkpoint=checkpoint).splats))


OPERATIONS: dict[str, Callable] = {
    "duplicate": gsplat.duplicate,
    "split": gsplat.split,
    "remove": gsplat.remove,
    "relocate": gsplat.relocate,
}


@settings(max_examples=60, deadline=None)
@given(st.lists(st.sampled_from([*OPERATIONS, "sample_add", "insert", "d2 remove", "look"]), max_size=10))
def test_rows_are_followed_through_any_operations(sequence: list[str]) -> None:
    """Ids in positions agree with the index told, wherever a row is not new; Adam's moments keep their row."""
    adapter, (splats, optimizers, state) = make_adapter()
    splats["means"].data[:, 0] = torch.arange(60.0)
    optimizers["means"].state[splats["means"]]["exp_avg"][:, 0] = torch.arange(60.0)
    followed = torch.arange(60)

    def follow(index: Tensor) -> None:
        nonlocal followed
        followed = torch.where(index >= 0, followed[index.clamp(min=0)], -1)

    adapter.on_resize(follow)
    for seed, action in enumerate(sequence):
        mask = torch.rand(len(splats["means"]), generator=torch.Generator().manual_seed(seed)) < 0.2
        if action in OPERATIONS:
            OPERATIONS[action](splats, optimizers, state, mask)
        elif action == "sample_add":
            gsplat.sample_add(splats, optimizers, state, 3)
        elif action == "insert":
            adapter.insert(some_points(3))
        elif action == "d2 remove":
            adapter.remove(torch.rand(len(adapter)) < 0.2)
        else:
            len(adapter)
    assert len(adapter) == len(followed) == len(splats["means"])
    assert all(len(value) == len(followed) for value in state.values() if isinstance(value, Tensor))
    old = (followed >= 0) & (optimizers["means"].state[splats["means"]]["exp_avg"][:, 0] > 0)
    assert torch.equal(optimizers["means"].state[splats["means"]]["exp_avg"][old, 0], followed[old].float())


def test_an_insertion_keeps_the_evidence_of_the_strategy() -> None:
    adapter, (splats, _, state) = make_adapter()
    state["grad2d"] += torch.arange(60.0)
    assert adapter.insert(some_points(4)) == 4
    assert torch.equal(state["grad2d"], torch.cat([torch.arange(60.0), torch.zeros(4)]))
    assert isinstance(splats["shN"], nn.Parameter)


def test_without_a_state_growth_counts_as_appended() -> None:
    splats, optimizers, _ = gsplat.make()
    adapter, told = GsplatAdapter(splats, optimizers), []
    adapter.on_resize(told.append)
    gsplat.sample_add(splats, optimizers, {}, 5)
    assert len(adapter) == 65
    assert told[0].tolist() == [*range(60), *[-1] * 5]


def test_the_slice_draws_what_the_loop_draws() -> None:
    adapter, (splats, _, _) = make_adapter()
    view = make_views()[0]
    sliced = adapter.slice_at(view)
    colors = (0.5 + 0.28209479177387814 * splats["sh0"][:, 0]).clamp_min(0)
    torch.testing.assert_close(rasterize(sliced, colors, view).color, gsplat.render(splats, view).image)


def test_the_adapter_is_registered_and_satisfies_the_contract() -> None:
    adapter, _ = make_adapter()
    assert isinstance(adapter, load(ADAPTERS, "gsplat"))
    assert isinstance(adapter, Backbone)


def test_the_public_contract_holds() -> None:
    def make() -> Example:
        adapter, (splats, optimizers, state) = make_adapter()
        splats["scales"].data += 1.0
        mask = torch.arange(60) % 3 == 0
        grow = partial(gsplat.duplicate, splats, optimizers, state, mask)
        return Example(adapter, make_views(), optimizers=list(optimizers.values()), grow=grow)

    assert "moments" in check_backbone(make)


def test_cameras_are_views_and_anything_else_is_refused() -> None:
    adapter, _ = make_adapter()
    view = make_views()[2]
    made = gsplat_view("cam2", 0, 0.0, torch.linalg.inv(view.T_camera_world)[None], view.K[None], 32, 24)
    torch.testing.assert_close(adapter.view(made).T_camera_world, view.T_camera_world)
    with pytest.raises(D2Error, match="a camera of type dict is no View"):
        adapter.view({})


def test_a_parameter_of_unknown_start_is_named() -> None:
    splats, optimizers, _ = gsplat.make()
    splats["velocities"] = nn.Parameter(torch.zeros(60, 3))
    optimizers["velocities"] = torch.optim.Adam([splats["velocities"]])
    with pytest.raises(D2Error, match=r"parameter 'velocities' of shape \(60, 3\).*new_rows"):
        GsplatAdapter(splats, optimizers).insert(some_points(2))
    adapter = GsplatAdapter(splats, optimizers, new_rows=lambda points: {"velocities": 0 * points.positions})
    assert adapter.insert(some_points(2)) == 2
    with pytest.raises(D2Error, match="have means but no 'scales'"):
        GsplatAdapter({"means": splats["means"]}, optimizers)


def test_a_scene_is_told_of_rows_that_come_and_go() -> None:
    """gsplat 1.6 keeps a component per row beside the parameters, and its own split fails where one is missing."""
    splats, optimizers, _ = gsplat.make()

    class Scene:
        component_index = torch.zeros(60, dtype=torch.long)

        def on_sample_add(self, sampled: Tensor) -> None:
            self.component_index = torch.cat([self.component_index, self.component_index[sampled]])

        def on_remove(self, mask: Tensor) -> None:
            self.component_index = self.component_index[~mask]

    scene = Scene()
    adapter = GsplatAdapter(splats, optimizers, {}, scene=scene)
    adapter.insert(some_points(4))
    assert len(scene.component_index) == 64
    adapter.remove(torch.arange(64) % 2 == 0)
    assert len(scene.component_index) == 32 == len(splats["means"])
