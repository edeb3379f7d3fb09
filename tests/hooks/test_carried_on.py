"""What one camera alone sees gets the depth of what is known beside it, where others look through the space before."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest
import torch
from tiny import make_adapter, make_model
from torch import Tensor

from d2_plugin.config import DensifyConfig
from d2_plugin.hooks.carried_on import CarriedOn
from d2_plugin.hooks.densify import Densify
from d2_plugin.hooks.hook import Context
from d2_plugin.hooks.views import ViewSampler
from d2_plugin.protocol import DepthPrior, Label, View

WALL = 4.0
SIZE = 96, 60


AWAY = torch.diag(torch.tensor([-1.0, 1, -1, 1]))
"""Looks the other way."""


def camera(name: str, across: float, unit: float = 1.0, frame: int = 0) -> View:
    """One that looks along z from `across` units to the right of the origin, 96x60 pixels; it sees 4.8 of the wall."""
    K = torch.tensor([[80.0, 0, 48], [0, 80.0, 30], [0, 0, 1]])
    pose = torch.eye(4)
    pose[0, 3] = -across * unit
    return View(name, frame, 0.0, pose, K, *SIZE)


def prior(view: View, unit: float = 1.0, known: slice = slice(None)) -> DepthPrior:
    """The wall in the columns `known`."""
    depth = torch.zeros(view.height, view.width)
    depth[:, known] = WALL * unit
    labels = torch.where(depth > 0, int(Label.VERIFIED), int(Label.EMPTY)).to(torch.uint8)
    sigma = torch.where(depth > 0, 0.01, torch.inf)
    return DepthPrior(depth, labels, torch.full((*depth.shape, 3), 128, dtype=torch.uint8), sigma)


def carried_on(
    own: DepthPrior, *others: tuple[View, DepthPrior | None], still: Tensor | None = None, unit: float = 1.0
) -> DepthPrior:
    """The prior of a camera .4 to the right of the origin, with cameras beside it and what is known of them, and one
    that sees nothing of it all."""
    view, known = camera("right", 0.4, unit), ViewSampler()
    behind = (replace(view, camera="behind", T_camera_world=view.T_camera_world @ AWAY), own)
    priors: Mapping[str, DepthPrior | None] = {"right": own, **{o.camera: found for o, found in (*others, behind)}}
    for seen in (view, *(other for other, _ in others), behind[0]):
        known.add(seen)
    return CarriedOn()(own, view, given(known, priors), still)


def given(known: ViewSampler, priors: Mapping[str, DepthPrior | None]) -> Context:
    """What a hook knows of these views."""
    loader: Any = lambda view: priors[view.camera]  # noqa: E731
    model: Any = None
    numbers = torch.Generator()
    return Context(1, model, (), loader, numbers, instants=known.instants, beside=known.beside)


LEFT = camera("left", 0.0)
"""Its image ends at the right camera's column 88, at the wall."""
REST = prior(camera("right", 0.4), known=slice(0, 88))


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_a_wall_goes_on_where_the_other_cameras_image_ends(unit: float) -> None:
    left = camera("left", 0.0, unit)
    own = prior(camera("right", 0.4, unit), unit, slice(0, 88))
    found = carried_on(own, (left, prior(left, unit)), unit=unit)
    assert found.support[:, 88:].all()
    torch.testing.assert_close(found.depth, torch.full_like(found.depth, WALL * unit), rtol=1e-4, atol=0)
    assert (found.labels[:, 88:] == Label.MONO).all()
    assert not found.trusted[:, 88:].any()


def test_what_another_camera_would_see_and_did_not_match_stays_unknown() -> None:
    found = carried_on(prior(camera("right", 0.4), known=slice(0, 84)), (LEFT, prior(LEFT)))
    assert not found.support[:, 84:88].any()
    assert found.support[:, 88:92].all()


def beside_the_space(depth: float) -> tuple[View, DepthPrior]:
    """A camera at the right that sees no wall, and what is half as far from the right camera, 3.5 units away; and what
    it knows: itself, what stands there, or, at 0, nothing."""
    pose = torch.eye(4)
    pose[:3, :3] = torch.tensor([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    pose[:3, 3] = torch.tensor([-1.5, 0, 5.0])
    side = replace(camera("side", 0.0), T_camera_world=pose)
    assert side.sees(torch.tensor([[1.5, 0, 2], [2.6, 0, 4]])).tolist() == [True, False]
    known = prior(side)
    return side, known._replace(depth=torch.full_like(known.depth, depth), labels=known.labels * (depth > 0))


@pytest.mark.parametrize(("depth", "through"), [(10.0, True), (3.0, False), (0.0, False)])
def test_depth_is_carried_on_where_other_cameras_look_through_the_space_before_it(depth: float, through: bool) -> None:
    assert bool(carried_on(REST, beside_the_space(depth)).support[30, 88:].any()) == through


def test_what_stands_there_at_another_instant_counts_as_well() -> None:
    """As a person whom it does not match at each: he is known at instant 1 alone."""
    (side, through), (_, person) = beside_the_space(10.0), beside_the_space(3.0)
    right, known = camera("right", 0.4), ViewSampler()
    for frame in (0, 1):
        for view in (right, side, replace(LEFT, T_camera_world=AWAY)):
            known.add(replace(view, frame=frame))
    context = given(known, {})
    loader: Any = lambda view: (through, person)[view.frame] if view.camera == "side" else REST  # noqa: E731
    found = CarriedOn()(REST, right, replace(context, prior=loader), None)
    assert not found.support[30, 88:].any()


def test_what_was_seen_meanwhile_counts_as_if_it_had_been_known_from_the_start() -> None:
    """So a run that is continued goes on with the same bits."""
    (side, through), (_, person) = beside_the_space(10.0), beside_the_space(3.0)
    right, known = camera("right", 0.4), ViewSampler()
    loader: Any = lambda view: (through, person)[view.frame] if view.camera == "side" else REST  # noqa: E731
    context, hook = replace(given(known, {}), prior=loader), CarriedOn()
    for view in (replace(right, frame=1), side, replace(LEFT, T_camera_world=AWAY)):
        known.add(view)
    assert hook(REST, right, context, None).support[30, 88:].any()
    known.add(replace(side, frame=1))
    assert not hook(REST, right, context, None).support[30, 88:].any()


def test_a_camera_without_a_prior_looks_through_nothing() -> None:
    side, _ = beside_the_space(10.0)
    assert not carried_on(REST, (side, None)).support[30, 88:].any()


def test_what_moves_and_what_is_far_is_left_alone() -> None:
    still = torch.ones(SIZE[1], SIZE[0], dtype=torch.bool)
    still[:30] = False
    found = carried_on(REST, (LEFT, prior(LEFT)), still=still)
    assert not found.support[:30, 88:].any()
    assert found.support[30:, 88:].all()
    sky = REST._replace(labels=REST.labels.masked_fill(~REST.support, int(Label.FAR)))
    assert not carried_on(sky, (LEFT, prior(LEFT))).support[:, 88:].any()


def test_where_nothing_can_be_said_the_prior_stays_as_it_is() -> None:
    filled = REST._replace(labels=REST.labels.masked_fill(torch.eye(60, 96) > 0, int(Label.MONO)))
    assert carried_on(filled, (LEFT, prior(LEFT))) is filled, "a network's depth fills what it can"
    nothing = prior(LEFT, known=slice(0, 0))
    assert carried_on(nothing, (LEFT, prior(LEFT))) is nothing
    flawed = REST._replace(depth=REST.depth.masked_fill(REST.depth > 0, torch.nan))
    assert carried_on(flawed, (LEFT, prior(LEFT))) is flawed


@pytest.mark.parametrize("slope", [-2e-3, 1e-3])
def test_a_wall_that_runs_away_or_near_goes_on_as_it_runs(slope: float) -> None:
    """Inverse depth is affine in the image, from block to block within the block's own slope."""
    columns = torch.arange(SIZE[0]) + 0.5
    wall = (1 / (1 / WALL + slope * (columns - 88))).expand(SIZE[1], -1)
    found = carried_on(REST._replace(depth=wall * (REST.depth > 0)), (LEFT, prior(LEFT)))
    assert found.support[:, 88:92].all()
    torch.testing.assert_close(found.depth[:, 88:92], wall[:, 88:92], rtol=0.01, atol=0)


def test_what_lies_on_no_plane_goes_on_as_far_away_as_next_to_it() -> None:
    """Two steps of a stair: a plane through both would run on towards the camera."""
    stair = torch.where(torch.arange(SIZE[0]) < 84, 1.3 * WALL, WALL).expand(SIZE[1], -1)
    found = carried_on(REST._replace(depth=stair * (REST.depth > 0)), (LEFT, prior(LEFT)))
    off = (found.depth[:, 88:92] / WALL - 1).abs()
    assert float(off.median()) < 0.01
    assert float(off.max()) < 0.1


@pytest.mark.parametrize("known", [slice(0, 2), slice(0, 12)])
@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_little_that_is_known_lays_a_plane_or_none_and_nothing_fails(known: slice, unit: float) -> None:
    """One column of blocks, and six, from which planes to the other end of the image are ill-posed; a noisy wall."""
    noise = torch.rand(SIZE[1], SIZE[0], generator=torch.Generator().manual_seed(0))
    own = prior(camera("right", 0.4, unit), unit, known)
    own = own._replace(depth=own.depth * (1 + 0.2 * noise))
    away = camera("away", -9.0, unit)
    found = carried_on(own, (away, prior(away, unit)), unit=unit)
    assert ((found.depth == 0) | ((found.depth > 0.9 * WALL * unit) & (found.depth < 1.6 * WALL * unit))).all()


def test_depth_is_carried_on_for_a_tenth_of_the_image_at_most() -> None:
    away = camera("away", -9.0)
    found = carried_on(prior(LEFT, known=slice(0, 48)), (away, prior(away)))
    columns = torch.nonzero(found.support.all(0)).flatten()
    assert 48 + 6 <= int(columns.max()) <= 48 + 10


@pytest.mark.parametrize(
    ("carry_on", "moves", "cameras"), [(True, False, 3), (False, False, 3), (True, True, 3), (True, False, 2)]
)
def test_densify_inserts_there_with_three_cameras_that_stand_still(carry_on: bool, moves: bool, cameras: int) -> None:
    views = [camera("right", 0.4), LEFT, replace(LEFT, camera="behind", T_camera_world=AWAY)][:cameras]
    known = ViewSampler()
    for view in [*views, *([replace(camera("left", 0.1), frame=1)] if moves else [])]:
        known.add(view)
    model = make_model(count=1)
    with torch.no_grad():
        model.gaussians["positions"].copy_(torch.tensor([[0.0, 0.0, 50.0]]))
    context = given(known, {"right": REST, "left": prior(LEFT), "behind": prior(LEFT)})
    context = replace(context, backbone=make_adapter(model), sample=lambda: views[:1])
    edit = Densify(DensifyConfig(carry_on=carry_on)).edit(context)
    assert edit is not None
    assert edit.insert is not None
    assert bool((edit.insert.positions[:, 0] > 2.6).any()) == (carry_on and not moves and cameras == 3)
    torch.testing.assert_close(edit.insert.positions[:, 2], torch.full_like(edit.insert.positions[:, 2], WALL))
