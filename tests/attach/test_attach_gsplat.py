"""gsplat's dict of parameters: cameras, parameters and state; for the rest see test_every_repository.py."""

import pytest
import torch
from mimics import gsplat
from mimics.workplace import some_points
from repositories import make_gsplat
from torch import Tensor, nn

from d2_plugin import D2Error
from d2_plugin.adapters.gsplat_dict import GsplatAdapter


def test_without_a_state_growth_counts_as_appended() -> None:
    splats, optimizers, _ = gsplat.make()
    adapter, reports = GsplatAdapter(splats, optimizers), []
    adapter.on_resize(reports.append)
    gsplat.sample_add(splats, optimizers, {}, 5)
    assert len(adapter) == 65
    assert reports[0].tolist() == [*range(60), *[-1] * 5]


def test_gaussians_that_were_copied_over_dead_ones_count_anew() -> None:
    """MCMC zeroes the state of those that it copied; of the dead it says nothing, and they keep their row."""
    standing, reports = make_gsplat(), []
    standing.adapter.on_resize(reports.append)
    dead = torch.arange(60) % 4 == 0
    gsplat.relocate(standing.model, standing.adapter.optimizers, standing.adapter.state, dead)
    assert len(standing.adapter) == 60
    copied = torch.where(~dead)[0][: int(dead.sum())]
    assert reports[0].tolist() == torch.arange(60).index_fill(0, copied, -1).tolist()


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
