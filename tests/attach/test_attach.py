"""The official repositories, as mimics: three lines attach D2, none of the repository's own behaviour is lost."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mimics import deformable3d, ex4dgs, fudan, hust4d, spacetime
from mimics.inria import default_options
from mimics.page import attached, changed_lines
from mimics.workplace import HOOKS, furnish, some_points
from torch import Tensor

from d2_plugin import D2Config
from d2_plugin.adapters.deformable3d import Deformable3DAdapter
from d2_plugin.adapters.ex4dgs import Ex4DGSAdapter
from d2_plugin.adapters.fudan import FudanAdapter
from d2_plugin.adapters.hust4d import Hust4DAdapter
from d2_plugin.adapters.inria import InriaAdapter
from d2_plugin.adapters.spacetime import SpacetimeAdapter
from d2_plugin.protocol import Backbone
from d2_plugin.rasterizer import rasterize
from d2_plugin.registry import ADAPTERS, load
from d2_plugin.testing import Example, check_backbone

MIMICS: dict[str, ModuleType] = {
    "fudan": fudan,
    "deformable3d": deformable3d,
    "hust4d": hust4d,
    "spacetime": spacetime,
    "ex4dgs": ex4dgs,
}


@pytest.fixture
def workplace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a prior and a d2.toml, as the working directory of a trainer."""
    return furnish(tmp_path, monkeypatch)


def run(mimic: ModuleType, source: ModuleType | None = None, **options) -> SimpleNamespace:
    """Train the mimic, or its attached `source`, from the same start."""
    return (source or mimic).training(*mimic.make(), **options)


def snapshot(model) -> dict[str, Tensor]:
    values = {name: getattr(model, attribute).detach().clone() for name, attribute in model.columns}
    moments = {
        f"{group['name']} {key}": model.optimizer.state[group["params"][0]][key].clone()
        for group in model.optimizer.param_groups
        for key in model.optimizer.state.get(group["params"][0], {})
        if key != "step"
    }
    return values | moments


def same(a: dict[str, Tensor], b: dict[str, Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


@pytest.mark.parametrize("name", MIMICS)
class TestEveryRepository:
    def test_three_lines_and_an_import_attach_d2(self, name: str) -> None:
        lines = changed_lines(name)
        assert len(lines) == 3
        assert lines[0].startswith(f'd2 = D2Hooks.attach("d2.toml", "{name}", gaussians')
        assert lines[1].startswith("loss = loss + d2.loss(iteration, viewpoint_cam")
        assert lines[2] == "d2.step(iteration)"

    def test_all_hooks_off_is_bitwise_the_bare_loop(self, name: str, workplace: Path) -> None:
        mimic = MIMICS[name]
        bare, source = run(mimic), attached(mimic, name)
        (workplace / "d2.toml").write_text(D2Config().to_toml())
        assert same(snapshot(bare.gaussians), snapshot(run(mimic, source).gaussians))
        (workplace / "d2.toml").write_text(replace(HOOKS, prior="prior").to_toml())
        full = run(mimic, source)
        assert not same(snapshot(bare.gaussians), snapshot(full.gaussians)), "hooks changed nothing: this cannot fail"
        assert {entry.hook for entry in full.d2.trace} == {"densify", "prune", "depth_loss"}
        assert all(value.isfinite().all() for value in snapshot(full.gaussians).values())

    def test_a_resumed_run_is_bitwise_the_uninterrupted_one(self, name: str, workplace: Path) -> None:
        mimic = MIMICS[name]
        source = attached(mimic, name, after_first="if D2_STATE and checkpoint: d2.load_state_dict(D2_STATE)")
        source.D2_STATE = None
        whole, first = run(mimic, source), run(mimic, source, stop=53)
        checkpoint, state = copy.deepcopy((saved(first), 53)), copy.deepcopy(first.d2.state_dict())
        forgetful = run(mimic, source, checkpoint=copy.deepcopy(checkpoint))
        source.D2_STATE = state
        assert same(snapshot(whole.gaussians), snapshot(run(mimic, source, checkpoint=checkpoint).gaussians))
        assert not same(snapshot(whole.gaussians), snapshot(forgetful.gaussians)), "D2's state does not matter"

    def test_the_slice_draws_what_the_repository_draws(self, name: str) -> None:
        for adapter, camera, package in drawn(name):
            view = adapter.view(camera)
            splats = adapter.slice_at(view)
            own = rasterize(splats, torch.zeros(len(splats.means), 1), view, adapter.settings)
            depth_sum = package.get("depth_sum", package["depth"])
            torch.testing.assert_close(own.depth_sum, depth_sum[0], rtol=1e-4, atol=1e-4)

    def test_an_insertion_keeps_the_densification_evidence(self, name: str) -> None:
        adapter = next(iter(drawn(name)))[0]
        model, count = adapter.gaussians, len(adapter)
        if name == "spacetime":
            model.omegamask = torch.ones(count, 1)
        for accumulator in adapter.evidence:
            value = getattr(model, accumulator)
            setattr(model, accumulator, torch.arange(1.0, 1 + value.numel()).view_as(value))
        told: list[Tensor] = []
        adapter.on_resize(told.append)
        assert adapter.insert(some_points(5)) == 5
        assert told[0].tolist() == [*range(count), *[-1] * 5]
        for accumulator in adapter.evidence:
            value = getattr(model, accumulator)
            assert len(value) == count + 5, accumulator
            assert torch.equal(value[:count].flatten(), torch.arange(1.0, 1 + value[:count].numel())), accumulator
            assert (value[count:] == adapter.evidence[accumulator]).all(), accumulator

    def test_the_repositorys_own_edits_are_reported_row_by_row(self, name: str) -> None:
        """Ids in positions and in Adam's moments follow the index that listeners receive."""
        adapter = next(iter(drawn(name)))[0]
        model = adapter.gaussians
        sum((getattr(model, attribute) * 0).sum() for _, attribute in model.columns).backward()
        model.optimizer.step()
        ids = torch.arange(float(len(adapter)))
        model._xyz.data[:, 0] = ids
        model.optimizer.state[model._xyz]["exp_avg"][:, 0] = ids
        followed = ids.clone()

        def follow(index: Tensor) -> None:
            nonlocal followed
            followed = torch.where(index >= 0, followed[index.clamp(min=0)], torch.full_like(index, -1.0).float())

        adapter.on_resize(follow)
        with torch.no_grad():
            grads = (torch.arange(len(adapter)) % 3).float()[:, None]
            model.densify_and_clone(grads, 1.5, 1e9)
            adapter.insert(some_points(4))
            if name != "ex4dgs":
                padded = torch.cat([grads, torch.zeros(len(adapter) - len(grads), 1)])
                model.densify_and_split(padded, 0.5, 0.0)
            adapter.remove(torch.arange(len(adapter)) % 7 == 0)
        kept = followed[: len(model._xyz)] >= 0
        followed = followed[: len(model._xyz)]
        assert 0 < int(kept.sum()) < len(adapter)
        assert torch.equal(model._xyz[kept, 0].detach(), followed[kept])
        assert torch.equal(model.optimizer.state[model._xyz]["exp_avg"][kept, 0], followed[kept])

    @settings(max_examples=40, deadline=None)
    @given(sequence=st.lists(st.sampled_from(["clone", "split", "insert", "remove", "extract"]), max_size=8))
    def test_rows_are_followed_through_any_edits(self, name: str, sequence: list[str]) -> None:
        """Rows are numbered anew before every edit; the reports to listeners must lead back to the numbers."""
        model, make_adapter, _, _ = next(iter(variants(name)))
        model.training_setup(default_options())
        adapter, told = make_adapter(), []
        adapter.on_resize(told.append)
        for seed, action in enumerate(sequence):
            told.clear()
            numbers = torch.arange(float(len(adapter)))
            for part, values in zip(tables(model), numbers.split([len(part) for part in tables(model)]), strict=True):
                part.copy_(values)
            edit(adapter, model, action, torch.Generator().manual_seed(seed))
            index = torch.arange(len(numbers))
            for step in told:
                index = torch.where(step >= 0, index[step.clamp(min=0)], -1)
            now = torch.cat(tables(model))
            assert len(now) == len(index) == len(adapter)
            assert torch.equal(now[index >= 0], numbers[index[index >= 0]])

    def test_the_adapter_is_registered_and_satisfies_the_contract(self, name: str) -> None:
        adapter = next(iter(drawn(name)))[0]
        assert isinstance(adapter, load(ADAPTERS, name))
        assert isinstance(adapter, Backbone)

    def test_the_public_contract_holds(self, name: str) -> None:
        def make(variant: int) -> Example:
            model, adapter, cameras, _ = list(variants(name))[variant]
            model.training_setup(default_options())
            model._scaling.data += 1.0
            return Example(adapter(), cameras, optimizers=lambda: [model.optimizer], grow=partial(clone_some, model))

        for variant in range(len(list(variants(name)))):
            assert {"moments", "grow"} <= set(check_backbone(partial(make, variant)))

    def test_attaching_again_takes_the_place_of_the_first(self, name: str) -> None:
        """Stages of one run attach to one model more than once."""
        adapter = next(iter(drawn(name)))[0]
        told: list[str] = []
        adapter.on_resize(lambda index: told.append("first"))
        again = copy.copy(adapter)
        InriaAdapter.__init__(again, adapter.gaussians, adapter.settings)
        again.on_resize(lambda index: told.append("second"))
        again.insert(some_points(2))
        assert told == ["second"]
        again.detach()
        assert "prune_points" not in vars(adapter.gaussians)


def saved(first: SimpleNamespace) -> object:
    """What the repository's checkpoint holds (for Deformable-3D, what it would have to)."""
    params = first.gaussians.recording()
    if hasattr(first, "deform"):
        return params, first.deform.deform.state_dict(), first.deform.optimizer.state_dict()
    return params


def drawn(name: str) -> Iterator[tuple[InriaAdapter, object, dict[str, Tensor]]]:
    """(adapter, camera, render package) of every camera, for every variant of the repository's model."""
    for model, adapter, cameras, render in variants(name):
        model.training_setup(default_options())
        jitter(model)
        for camera in cameras:
            yield adapter(), camera, render(camera)


def variants(name: str):
    """(model, maker of its adapter, cameras, render of a camera) for every variant."""
    black = [0, 0, 0]
    if name == "fudan":
        model, scene = fudan.make()
        yield model, lambda: FudanAdapter(model, scene), scene.train_cameras[1.0], partial(draw_in, fudan, model, black)
    elif name == "spacetime":
        model, scene = spacetime.make()
        yield model, lambda: SpacetimeAdapter(model, 2), scene.cameras, partial(draw_in, spacetime, model, black)
    elif name == "ex4dgs":
        model, scene = ex4dgs.make()
        yield model, lambda: Ex4DGSAdapter(model), scene.cameras, partial(draw_in, ex4dgs, model, black)
    elif name == "hust4d":
        for stage in ("fine", "coarse"):
            model, scene = hust4d.make()
            maker = partial(Hust4DAdapter, model, scene, stage)
            yield model, maker, scene.cameras, partial(draw_in, hust4d, model, black, stage=stage)
    else:
        for is_6dof in (False, True):
            model, deform, scene = deformable3d.make(is_6dof)
            yield model, partial(warm, model, deform), scene.cameras, partial(draw_deformed, model, deform, black)


def draw_in(mimic: ModuleType, model, background: list[int], camera, **options) -> dict[str, Tensor]:
    return mimic.render(camera, model, background, **options)


def warm(model, deform) -> Deformable3DAdapter:
    """The adapter after the warm-up."""
    adapter = Deformable3DAdapter(model, deform, warm_up=10)
    adapter.begin_step(10)
    return adapter


def draw_deformed(model, deform, background: list[int], camera) -> dict[str, Tensor]:
    motion = deform.step(model.get_xyz, camera.fid.expand(len(model.get_xyz), 1))
    return deformable3d.render(camera, model, background, *motion, deform.deform.is_6dof)


def tables(model) -> list[Tensor]:
    """The first coordinate of every row, in the contract's order."""
    parts = [model._xyz.data[:, 0]]
    return [*parts, model._xyz_motion.data[:, 0, 0]] if hasattr(model, "_xyz_motion") else parts


@torch.no_grad()
def edit(adapter: InriaAdapter, model, action: str, generator: torch.Generator) -> None:
    """One edit by the repository or by D2; those that a repository does not have are left out."""
    grads = torch.rand(len(model._xyz), 1, generator=generator)
    if action == "insert":
        adapter.insert(some_points(3))
    elif action == "remove":
        adapter.remove(torch.rand(len(adapter), generator=generator) < 0.2)
    elif action == "clone":
        model.densify_and_clone(grads, 0.7, 1e9)
    elif action == "split" and not hasattr(model, "_xyz_motion"):
        model.densify_and_split(grads, 0.7, 0.0)
    elif action == "extract" and hasattr(model, "_xyz_motion"):
        model.xyz_error_min_timestamp.zero_()
        model._xyz_disp.data[:, 0] = grads[:, 0]
        model.extract_dynamic_points_from_static()


def clone_some(model) -> None:
    """The repository's own growth."""
    with torch.no_grad():
        model.densify_and_clone((torch.arange(len(model._xyz)) % 3).float()[:, None], 1.5, 1e9)


def jitter(model) -> None:
    """Shapes and rotations that are not those of a start."""
    generator = torch.Generator().manual_seed(5)
    for name in ("_rotation", "_scaling", "_rotation_r", "_scaling_t", "_motion", "_omega", "_trbf_scale", "_xyz_disp"):
        if hasattr(model, name):
            value = getattr(model, name).data
            value += 0.4 * torch.randn(value.shape, generator=generator)


def test_hooks_may_wait_for_the_field_of_a_warm_up(workplace: Path) -> None:
    """Until iteration 30 the mimic fits one still scene to all instants, as Deformable-3D-Gaussians until 3000."""
    source = attached(deformable3d, "deformable3d", "d2.backbone.in_warm_up = False")
    bare, waiting = run(deformable3d, stop=29), run(deformable3d, source, stop=29)
    assert same(snapshot(bare.gaussians), snapshot(waiting.gaussians))
    assert not waiting.d2.trace
    going = run(deformable3d, source, stop=45)
    assert min(entry.step for entry in going.d2.trace) == 30
    assert not same(snapshot(run(deformable3d, stop=45).gaussians), snapshot(going.gaussians))
    models = deformable3d.make()[:2]
    assert Deformable3DAdapter(*models, warm_up=30).active(1)
    assert not Deformable3DAdapter(*models, warm_up=30, in_warm_up=False).active(29)
