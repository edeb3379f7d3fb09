"""The paper's equations as pure functions, at the points where an implementation goes wrong."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest
import torch

from d2_plugin.hooks.densify import (
    back_project,
    first_of_each,
    frustum_cells,
    shuffled_pixels,
    under_reconstructed,
)
from d2_plugin.hooks.prior import PriorLoader
from d2_plugin.hooks.prune import depth_inconsistency, opacity_contribution
from d2_plugin.protocol import DepthPrior, Label, View


def tensor(*values: float) -> torch.Tensor:
    return torch.tensor(values)


def a_view(width: int = 64, height: int = 48) -> View:
    angle = 0.3
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.tensor(
        [[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]], dtype=torch.float64
    )
    pose[:3, 3] = torch.tensor([0.2, -0.1, 0.5], dtype=torch.float64)
    intrinsics = torch.tensor([[60.0, 0, 30.5], [0, 55.0, 25.0], [0, 0, 1]], dtype=torch.float64)
    return View("a", 0, 0.0, pose, intrinsics, width, height)


@pytest.mark.parametrize("label", list(Label))
def test_trusted_are_verified_and_agreed_pixels_and_no_others(label: Label) -> None:
    prior = DepthPrior(torch.ones(2, 2), torch.full((2, 2), int(label), dtype=torch.uint8))
    assert prior.verified.all() == (label == Label.VERIFIED)
    assert prior.trusted.all() == (label in (Label.VERIFIED, Label.AGREED))
    assert prior.support.all() == (label in (Label.VERIFIED, Label.AGREED, Label.MONO))
    view = View("a", 0, 0.0, torch.eye(4), torch.eye(3), 2, 2)
    pixels = PriorLoader(SimpleNamespace(prior=lambda camera, frame: prior)).known(view)
    assert (pixels is not None) == (prior.trusted | prior.far).all()


class TestPruning:
    def test_no_verified_pixel_is_no_evidence(self) -> None:
        assert depth_inconsistency(tensor(float("nan")), tensor(0.0), 0.1).item() == 0

    def test_contribution_is_zero_where_a_gaussian_is_visible_nowhere(self) -> None:
        torch.testing.assert_close(opacity_contribution(tensor(0.0, 1.5), tensor(0.0, 3.0)), tensor(0.0, 0.5))


class TestDensification:
    def test_region_holds_both_conditions_and_nothing_outside_the_support(self) -> None:
        depth, valid = tensor(0.0, 1.0, 1.3, 1.3), torch.tensor([False, True, True, True])
        support = torch.tensor([True, True, True, False])
        region = under_reconstructed(depth, valid, torch.ones(4), support, tau_u=0.2)
        assert region.tolist() == [True, False, True, False]

    def test_back_projection_of_a_projected_point_is_the_point(self) -> None:
        view = a_view()
        pixels = torch.tensor([[0, 0], [63, 47], [10, 20]])
        depth = torch.tensor([0.5, 2.0, 1e4], dtype=torch.float64)
        points = back_project(view, pixels, depth)
        camera = points @ view.T_camera_world[:3, :3].T + view.T_camera_world[:3, 3]
        image = camera @ view.K.T
        torch.testing.assert_close(camera[:, 2], depth)
        torch.testing.assert_close(image[:, :2] / image[:, 2:] - 0.5, pixels.double())

    def test_shuffled_pixels_are_the_mask_each_once(self) -> None:
        mask = torch.rand(20, 30, generator=torch.Generator().manual_seed(0)) > 0.5
        pixels = shuffled_pixels(mask, torch.Generator().manual_seed(1))
        assert len(torch.unique(pixels, dim=0)) == len(pixels) == int(mask.sum())
        assert mask[pixels[:, 1], pixels[:, 0]].all()
        assert not torch.equal(pixels, shuffled_pixels(mask, torch.Generator().manual_seed(2)))
        assert shuffled_pixels(torch.zeros_like(mask), torch.Generator()).shape == (0, 2)

    def test_points_of_one_cell_share_a_key_and_distant_ones_do_not(self) -> None:
        view = a_view()
        pixels = torch.tensor([[10, 10], [10, 10], [30, 10], [10, 10]])
        points = back_project(view, pixels, torch.tensor([2.0, 2.001, 2.0, 3.0], dtype=torch.float64))
        cells = frustum_cells(view, points, stride=4, depth_step=0.1)
        assert cells[0] == cells[1]
        assert len(set(cells.tolist())) == 3

    def test_points_behind_or_outside_have_no_cell(self) -> None:
        view = a_view()
        points = back_project(view, torch.tensor([[10, 10], [500, 10]]), torch.tensor([-2.0, 2.0], dtype=torch.float64))
        assert frustum_cells(view, points, 1, 0.1).tolist() == [-1, -1]

    def test_first_of_each_keeps_one_per_key_in_order(self) -> None:
        assert first_of_each(torch.tensor([5, 3, 5, 5, 3, 7])).tolist() == [True, True, False, False, False, True]
        assert first_of_each(torch.zeros(0, dtype=torch.int64)).tolist() == []
