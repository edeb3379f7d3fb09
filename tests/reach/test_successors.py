"""FasterGS4D, gsplat's contrib.dynamic, Swift4D and CEM-4DGS, as mimics, attached by the printed lines."""

from __future__ import annotations

import copy
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import NamedTuple

import pytest
import torch
from mimics import cem4dgs, fastergs4d, gsplat, gsplat_dynamic, swift4d
from mimics.inria import default_options
from mimics.page import attached, changed_lines
from mimics.workplace import furnish, some_points
from torch import Tensor

from d2_plugin import D2Config, D2Error
from d2_plugin.adapters.successors.cem4dgs import CEM4DGSAdapter
from d2_plugin.adapters.successors.fastergs4d import FasterGS4DAdapter
from d2_plugin.adapters.successors.gsplat_dynamic import GsplatDynamicAdapter
from d2_plugin.adapters.successors.swift4d import Swift4DAdapter
from d2_plugin.protocol import Backbone, Points
from d2_plugin.rasterizer import rasterize
from d2_plugin.registry import ADAPTERS, load
from d2_plugin.testing import Example, check_backbone


class Standing(NamedTuple):
    """A small model that stands still, and what the tests ask of it."""

    adapter: Backbone
    cameras: list
    model: object
    grow: Callable[[], object]
    draw: Callable[[object], Tensor]
    """A camera to the depth sum [H, W] of the mimic's own render."""
    optimizers: Callable[[], list[torch.optim.Optimizer]]


def faster() -> Standing:
    gaussians, views = fastergs4d.make()
    trainer = fastergs4d.Trainer(gaussians, views)
    trainer.setup_gaussians(None)
    jitter(gaussians._left_isoclinic_rotations, gaussians._right_isoclinic_rotations, gaussians._spatial_scales)

    def grow() -> None:
        gaussians._densification_info = torch.stack([torch.ones(len(gaussians._opacities))] * 2)
        gaussians.adaptive_density_control(0.5, 0.005)

    draw = lambda view: fastergs4d.render_image_training(gaussians, view)[1][2].depth_sum  # noqa: E731
    adapter = FasterGS4DAdapter(gaussians, 0.5)
    return Standing(adapter, views, gaussians, grow, draw, lambda: [gaussians.optimizer])


def dynamic() -> Standing:
    params, optimizers, hexplane, net = gsplat_dynamic.make()
    state = gsplat_dynamic.DynamicStrategy().initialize_state(num_gaussians=60)
    state |= {"grad2d": torch.zeros(60), "count": torch.zeros(60)}
    jitter(params["quats"], params["scales"])
    adapter = GsplatDynamicAdapter(params, optimizers, state, hexplane, net, frames=2, camera="cam1")
    grow = lambda: gsplat.duplicate(params, optimizers, state, torch.arange(len(params["means"])) % 3 == 0)  # noqa: E731

    def draw(item: dict) -> Tensor:
        return gsplat_dynamic.rasterization(params, item, state, hexplane, net)[1]["depth_sum"]

    return Standing(adapter, gsplat_dynamic.items(), params, grow, draw, lambda: list(optimizers.values()))


def swift(stage: str = "fine") -> Standing:
    model, scene = swift4d.make()
    model.training_setup(default_options())
    jitter(model._rotation, model._scaling)
    draw = lambda camera: swift4d.render(camera, model, [0, 0, 0], stage)["depth"][0]  # noqa: E731
    adapter = Swift4DAdapter(model, scene, stage)
    return Standing(adapter, scene.cameras, model, partial(clone, model), draw, lambda: [model.optimizer])


def cem() -> Standing:
    model, scene = cem4dgs.make()
    model.training_setup(default_options())
    jitter(model._rotation, model._scaling, model._xyz_disp)
    with torch.no_grad():
        model.extract_dynamic_points_from_static(0.3)
    jitter(model._xyz_motion, model._rotation_motion)
    draw = lambda camera: cem4dgs.render(camera, model, [0, 0, 0])["depth_sum"][0]  # noqa: E731
    return Standing(
        CEM4DGSAdapter(model, near=0.2, far=100.0),
        scene.cameras, model, partial(clone, model), draw, lambda: [model.optimizer],
    )  # fmt: skip


MIMICS: dict[str, ModuleType] = {
    "fastergs4d": fastergs4d,
    "gsplat_dynamic": gsplat_dynamic,
    "swift4d": swift4d,
    "cem4dgs": cem4dgs,
}
STANDING: dict[str, Callable[[], Standing]] = {
    "fastergs4d": faster,
    "gsplat_dynamic": dynamic,
    "swift4d": swift,
    "cem4dgs": cem,
}


@torch.no_grad()
def clone(model) -> None:
    model.densify_and_clone((torch.arange(len(model._xyz)) % 3).float()[:, None], 1.5, 1e9)


def jitter(*parameters: Tensor) -> None:
    """Shapes and rotations that are not those of a start; large enough to be seen."""
    generator = torch.Generator().manual_seed(5)
    for parameter in parameters:
        parameter.data += 0.3 * torch.randn(parameter.shape, generator=generator)


STOP = 48
"""Iterations of a run: insertions, removals and the mimics' own densification, ordering and resets all fall in it."""


def run(name: str, source: ModuleType | None = None, stop: int = STOP, **options) -> SimpleNamespace:
    mimic = MIMICS[name]
    return (source or mimic).training(*mimic.make(), stop=stop, **options)


def snapshot(outcome: SimpleNamespace) -> dict[str, Tensor]:
    model = getattr(outcome, "gaussians", None)
    named = outcome.params.items() if model is None else vars(model).items()
    own = named if not isinstance(model, torch.nn.Module) else model.named_parameters()
    return {key: value.detach().clone() for key, value in own if isinstance(value, torch.nn.Parameter)}


def same(a: dict[str, Tensor], b: dict[str, Tensor]) -> bool:
    assert a
    return a.keys() == b.keys() and all(torch.equal(a[key], b[key]) for key in a)


def saved(name: str, first: SimpleNamespace) -> object:
    """What a checkpoint has to hold for a run to go on."""
    if name == "fastergs4d":
        return first.trainer.recording()
    if name == "gsplat_dynamic":
        moments = {key: optimizer.state_dict() for key, optimizer in first.optimizers.items()}
        nets = first.hexplane.state_dict(), first.deform_net.state_dict()
        return snapshot(first), moments, first.state, nets, first.hex_optimizer.state_dict()
    return first.gaussians.recording()


@pytest.fixture
def workplace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a prior and a d2.toml; the one camera of gsplat's trainer is the middle one there."""
    monkeypatch.setitem(GsplatDynamicAdapter.__init__.__kwdefaults__, "camera", "cam1")
    return furnish(tmp_path, monkeypatch)


@pytest.mark.parametrize("name", MIMICS)
class TestEverySuccessor:
    def test_three_lines_and_an_import_attach_d2(self, name: str) -> None:
        lines = changed_lines(name)
        assert len(lines) == 3
        assert any(f'D2Hooks.attach("d2.toml", "{name}", ' in line for line in lines)
        assert any(line.startswith("loss = loss + ") and "d2.loss(" in line for line in lines)
        assert any("d2.step(" in line for line in lines)

    def test_all_hooks_off_is_bitwise_the_bare_loop(self, name: str, workplace: Path) -> None:
        (workplace / "d2.toml").write_text(D2Config().to_toml())
        assert same(snapshot(run(name, stop=30)), snapshot(run(name, attached(MIMICS[name], name), stop=30)))

    def test_a_resumed_run_is_bitwise_the_uninterrupted_one(self, name: str, workplace: Path) -> None:
        source = attached(MIMICS[name], name)
        whole, first = run(name, source), run(name, source, stop=29)
        assert {entry.hook for entry in whole.d2.trace} == {"densify", "prune", "depth_loss"}
        assert all(value.isfinite().all() for value in snapshot(whole).values())
        checkpoint, state = copy.deepcopy((saved(name, first), 29)), copy.deepcopy(first.d2.state_dict())
        forgetful = run(name, source, checkpoint=copy.deepcopy(checkpoint))
        source.D2Hooks = resuming(source.D2Hooks, state)
        assert same(snapshot(whole), snapshot(run(name, source, checkpoint=checkpoint)))
        assert not same(snapshot(whole), snapshot(forgetful)), "D2's state does not matter"

    def test_the_slice_draws_what_the_repository_draws(self, name: str) -> None:
        standing = STANDING[name]()
        for camera in standing.cameras:
            view = standing.adapter.view(camera)
            splats = standing.adapter.slice_at(view)
            own = rasterize(splats, torch.zeros(len(splats.means), 1), view, standing.adapter.settings)
            assert bool((own.alpha > 0.5).any())
            torch.testing.assert_close(own.depth_sum, standing.draw(camera), rtol=1e-4, atol=1e-4)

    def test_the_adapter_is_registered_and_keeps_the_public_contract(self, name: str) -> None:
        def make() -> Example:
            made = STANDING[name]()
            return Example(made.adapter, made.cameras, optimizers=made.optimizers, grow=made.grow)

        assert isinstance(make().backbone, load(ADAPTERS, name))
        assert isinstance(make().backbone, Backbone)
        assert {"moments", "grow"} <= set(check_backbone(make))


def resuming(hooks: type, state: dict) -> type:
    """D2Hooks whose `attach` goes on from a state, as one line after the first does."""

    class Resuming(hooks):
        @classmethod
        def attach(cls, *arguments, **options):
            d2 = hooks.attach(*arguments, **options)
            d2.load_state_dict(state)
            return d2

    return Resuming


class TestFasterGS4D:
    def test_ordering_the_gaussians_orders_what_d2_counts(self) -> None:
        standing = faster()
        told: list[Tensor] = []
        standing.adapter.on_resize(told.append)
        before = standing.model._spatial_means.detach().clone()
        standing.model.apply_morton_ordering()
        assert torch.equal(standing.model._spatial_means.detach(), before[told[0]])
        assert sorted(told[0].tolist()) == list(range(60))

    def test_an_insertion_keeps_the_densification_info(self) -> None:
        standing = faster()
        standing.model._densification_info += torch.arange(60.0)
        assert standing.adapter.insert(some_points(4)) == 4
        assert torch.equal(standing.model._densification_info[1], torch.cat([torch.arange(60.0), torch.zeros(4)]))

    def test_growth_is_told_with_the_prune_that_follows_it(self) -> None:
        standing = faster()
        told: list[Tensor] = []
        standing.adapter.on_resize(told.append)
        standing.grow()
        assert len(told) == 1
        assert len(told[0]) == len(standing.adapter) > 60
        assert (told[0][60:] == -1).all()

    def test_another_object_or_camera_is_refused(self) -> None:
        with pytest.raises(D2Error, match="SimpleNamespace has no prune, which FasterGS4DAdapter needs"):
            FasterGS4DAdapter(SimpleNamespace(_spatial_means=torch.zeros(1, 3)))
        with pytest.raises(D2Error, match="a camera of type dict has no perspective `camera`"):
            faster().adapter.view({})


class TestSwift4D:
    def test_points_move_where_their_surroundings_move(self) -> None:
        """The nearest logit decides, and what moves is put where the field carries it onto the point."""
        standing = swift()
        model, view = standing.model, standing.adapter.view(standing.cameras[0])
        placed = standing.adapter.slice_at(view).means.detach()
        moving, still = (torch.nonzero(model._dynamic[:, 0] > 0)[0], torch.nonzero(model._dynamic[:, 0] < 0)[0])
        near = torch.cat([placed[moving], placed[still]]) + 1e-3
        ones = torch.ones(2)
        points = Points(near, torch.rand(2, 3), ones / 2, ones * 0.05, ones * view.time)
        assert standing.adapter.insert(points) == 2
        assert (model._dynamic[-2:, 0] > 0).tolist() == [True, False]
        assert standing.adapter.inversion.accepted.all()
        found = standing.adapter.slice_at(view).means[-2:]
        torch.testing.assert_close(found, near, atol=0.03, rtol=0)
        assert not torch.equal(model._xyz[-2], near[0])

    def test_inserted_rows_survive_the_next_weight_prune(self) -> None:
        """It takes what was hardly seen since the last one, also what was inserted a moment ago."""
        standing = swift()
        standing.adapter.insert(some_points(3))
        with torch.no_grad():
            standing.model.weight_prune(0.02)
        assert len(standing.adapter) == 3
        assert standing.model._max_weight.tolist() == [0.0] * 3

    def test_the_coarse_stage_draws_a_still_scene_and_is_left_alone(self) -> None:
        standing = swift("coarse")
        splats = standing.adapter.slice_at(standing.adapter.view(standing.cameras[0]))
        assert torch.equal(splats.means, standing.model._xyz)
        assert not standing.adapter.active(1)


class TestCEM4DGS:
    def test_children_keep_their_motion_through_every_edit(self) -> None:
        """A mark in each motion's origin is found again from its child, whatever was inserted, cloned or removed."""
        standing = cem()
        model, adapter = standing.model, standing.adapter
        model._xyz_motion.data[:, 0, 0] = torch.arange(100.0, 100 + len(model._xyz_motion))
        children = torch.nonzero(model._level[:60, 0] == 1).squeeze(1)
        model._features_rest.data[children, 0, 0] = motion_of(model, children)
        for action in (lambda: adapter.insert(some_points(5)), partial(clone, model),
                       lambda: adapter.remove(torch.arange(len(adapter)) % 4 == 0)):  # fmt: skip
            action()
            children = torch.nonzero(model._level[: len(model._xyz), 0] == 1).squeeze(1)
            assert len(children)
            assert torch.equal(motion_of(model, children), model._features_rest.data[children, 0, 0])
            assert len(model._parent) == len(model._level) == len(model._xyz) + len(model._xyz_motion)
        assert len(adapter) == len(model._xyz)

    def test_motions_have_no_row_of_their_own(self) -> None:
        standing = cem()
        told: list[Tensor] = []
        standing.adapter.on_resize(told.append)
        assert len(standing.adapter) == 60
        assert standing.adapter.insert(some_points(2)) == 2
        assert told[0].tolist() == [*range(60), -1, -1]


def motion_of(model, children: Tensor) -> Tensor:
    """The mark of each child's motion."""
    return model._xyz_motion.data[model._parent[children, 0] - len(model._xyz), 0, 0]


class TestGsplatDynamic:
    def test_inserted_rows_are_marked_as_their_neighbours_are(self) -> None:
        standing = dynamic()
        adapter, view = standing.adapter, standing.adapter.view(standing.cameras[1])
        placed = adapter.slice_at(view).means.detach()
        moving, still = torch.tensor([1]), torch.tensor([0])
        near = torch.cat([placed[moving], placed[still]]) + 1e-3
        ones = torch.ones(2)
        assert adapter.insert(Points(near, torch.rand(2, 3), ones / 2, ones * 0.05, ones * view.time)) == 2
        assert adapter.state["dynamic_mask"][-2:].tolist() == [True, False]
        torch.testing.assert_close(adapter.slice_at(view).means[-2:], near, atol=0.03, rtol=0)

    def test_an_item_without_its_number_of_frames_is_refused(self) -> None:
        params, optimizers, hexplane, net = gsplat_dynamic.make()
        with pytest.raises(D2Error, match="the strategy's state has no 'dynamic_mask'"):
            GsplatDynamicAdapter(params, optimizers, {}, hexplane, net)
        state = {"dynamic_mask": torch.ones(60, dtype=torch.bool)}
        adapter = GsplatDynamicAdapter(params, optimizers, state, hexplane, net)
        with pytest.raises(D2Error, match=r"got no number of frames: pass views.*`frames=`"):
            adapter.view(gsplat_dynamic.items()[0])
