"""gsplat, its contrib.dynamic, Swift4D and CEM-4DGS: what is particular to each."""

from collections.abc import Callable
from functools import partial

import pytest
import torch
from mimics import gsplat, gsplat_dynamic
from mimics.workplace import some_points
from refusals import refuses
from repositories import clone, make_cem4dgs, make_gsplat, make_gsplat_dynamic, make_swift4d
from torch import Tensor, nn

from d2_plugin.adapters.gsplat_dict import GsplatAdapter
from d2_plugin.adapters.successors.gsplat_dynamic import GsplatDynamicAdapter
from d2_plugin.protocol import Points


@pytest.mark.parametrize(
    ("make", "moves"),
    [
        (make_swift4d, lambda adapter: adapter.gaussians._dynamic[:, 0] > 0),
        (make_gsplat_dynamic, lambda adapter: adapter.state["dynamic_mask"]),
    ],
)
def test_points_move_where_their_surroundings_move(make: Callable, moves: Callable) -> None:
    """The nearest Gaussian decides, and what moves is put where the field carries it onto the point."""
    standing = make()
    adapter, view = standing.adapter, standing.adapter.view(standing.cameras[1])
    placed, known = adapter.slice_at(view).means.detach(), moves(adapter)
    near = torch.cat([placed[known][:1], placed[~known][:1]]) + 1e-3
    ones = torch.ones(2)
    assert adapter.insert(Points(near, torch.rand(2, 3), ones / 2, ones * 0.05, ones * view.time)) == 2
    assert moves(adapter)[-2:].tolist() == [True, False]
    assert adapter.inversion.accepted.all()
    torch.testing.assert_close(adapter.slice_at(view).means[-2:], near, atol=0.03, rtol=0)
    raw = standing.model["means"] if make is make_gsplat_dynamic else standing.model._xyz
    assert not torch.equal(raw[-2], near[0])


class TestGsplat:
    def test_without_a_state_growth_counts_as_appended(self) -> None:
        splats, optimizers, _ = gsplat.make()
        adapter, reports = GsplatAdapter(splats, optimizers), []
        adapter.on_resize(reports.append)
        gsplat.sample_add(splats, optimizers, {}, 5)
        assert len(adapter) == 65
        assert reports[0].tolist() == [*range(60), *[-1] * 5]

    def test_gaussians_that_were_copied_over_dead_ones_count_anew(self) -> None:
        """MCMC zeroes the state of those that it copied; of the dead it says nothing, and they keep their row."""
        standing, reports = make_gsplat(), []
        standing.adapter.on_resize(reports.append)
        dead = torch.arange(60) % 4 == 0
        gsplat.relocate(standing.model, standing.adapter.optimizers, standing.adapter.state, dead)
        assert len(standing.adapter) == 60
        copied = torch.where(~dead)[0][: int(dead.sum())]
        assert reports[0].tolist() == torch.arange(60).index_fill(0, copied, -1).tolist()

    def test_a_parameter_of_unknown_start_is_named(self) -> None:
        splats, optimizers, _ = gsplat.make()
        splats["velocities"] = nn.Parameter(torch.zeros(60, 3))
        optimizers["velocities"] = torch.optim.Adam([splats["velocities"]])
        refuses(r"'velocities' of shape \(60, 3\).*new_rows", GsplatAdapter(splats, optimizers).insert, some_points(2))
        adapter = GsplatAdapter(splats, optimizers, new_rows=lambda points: {"velocities": 0 * points.positions})
        assert adapter.insert(some_points(2)) == 2
        refuses("have means but no 'scales'", GsplatAdapter, {"means": splats["means"]}, optimizers)
        refuses("'times' has no optimizer", GsplatAdapter, {**splats, "times": splats["means"]}, optimizers)

    def test_a_scene_is_told_of_rows_that_come_and_go(self) -> None:
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


class TestSwift4D:
    def test_inserted_rows_survive_the_next_weight_prune(self) -> None:
        """It takes what was hardly seen since the last one, also what was inserted a moment ago."""
        standing = make_swift4d()
        standing.adapter.insert(some_points(3))
        with torch.no_grad():
            standing.model.weight_prune(0.02)
        assert len(standing.adapter) == 3
        assert standing.model._max_weight.tolist() == [0.0] * 3

    def test_the_coarse_stage_draws_a_still_scene_and_is_left_alone(self) -> None:
        standing = make_swift4d("coarse")
        splats = standing.adapter.slice_at(standing.adapter.view(standing.cameras[0]))
        assert torch.equal(splats.means, standing.model._xyz)
        assert not standing.adapter.active(1)


class TestCEM4DGS:
    def test_children_keep_their_motion_through_every_edit(self) -> None:
        """A mark in each motion's origin is found again from its child, whatever was inserted, cloned or removed."""
        standing = make_cem4dgs()
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


def motion_of(model, children: Tensor) -> Tensor:
    """The mark of each child's motion."""
    return model._xyz_motion.data[model._parent[children, 0] - len(model._xyz), 0, 0]


class TestGsplatDynamic:
    def test_an_item_without_its_number_of_frames_is_refused(self) -> None:
        params, optimizers, hexplane, net = gsplat_dynamic.make()
        refuses("strategy's state has no 'dynamic_mask'", GsplatDynamicAdapter, params, optimizers, {}, hexplane, net)
        state = {"dynamic_mask": torch.ones(60, dtype=torch.bool)}
        adapter = GsplatDynamicAdapter(params, optimizers, state, hexplane, net)
        refuses(r"got no number of frames: pass views.*`frames=`", adapter.view, gsplat_dynamic.items()[0])
