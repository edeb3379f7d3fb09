"""Insertion covers what the prior knows: one Gaussian per square of the image, from every camera, at once."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tiny import ALL_HOOKS, HEIGHT, WIDTH, TinyStore, make_adapter, make_model, make_views

from d2_plugin.config import DensifyConfig
from d2_plugin.hooks.densify import Densify
from d2_plugin.hooks.hook import Context, Window
from d2_plugin.hooks.prior import PriorLoader
from d2_plugin.plugin import D2Hooks
from d2_plugin.protocol import DepthPrior, Points, View

KNOWN = HEIGHT * (WIDTH - 1)
"""Pixels of the tiny prior's support in one view: all but the column in conflict."""


def proposed(views: list[View], **settings: float) -> Points:
    """What densify wants to insert into a model of one Gaussian that is far away from the plane."""
    model = make_model(count=1)
    with torch.no_grad():
        model.gaussians["positions"].copy_(torch.tensor([[0.0, 0.0, 50.0]]))
    numbers = torch.Generator().manual_seed(0)
    context = Context(1, make_adapter(model), (), PriorLoader(TinyStore()), numbers, lambda: views)
    return Densify(DensifyConfig(**settings)).edit(context).insert


def squares(points: Points, view: View, side: float) -> list[tuple[int, int]]:
    """The square of the image that each point lies in."""
    camera = points.positions + view.T_camera_world[:3, 3]
    pixels = (camera / camera[:, 2:] @ view.K.T)[:, :2] / side
    return [(int(column), int(row)) for column, row in pixels.tolist()]


@pytest.mark.parametrize("spacing", [1.0, 2.0, 4.0, 8.0])
def test_every_square_of_a_bare_image_gets_one_gaussian(spacing: float) -> None:
    view = make_views()[0]
    found = squares(proposed([view], spacing=spacing), view, spacing)
    every = {(c, r) for c in range(math.ceil(WIDTH / spacing)) for r in range(math.ceil(HEIGHT / spacing))}
    in_conflict = {(WIDTH // 2, r) for r in range(HEIGHT)} if spacing == 1 else set()
    assert len(found) == len(set(found))
    assert set(found) == every - in_conflict


def test_a_gaussian_is_as_large_as_the_distance_to_the_next() -> None:
    points = proposed([make_views()[0]], spacing=4.0, scale=0.7)
    torch.testing.assert_close(points.scales, torch.full_like(points.scales, 0.7 * 4 * 3.0 / 30))


@given(budget=st.integers(1, 400))
def test_a_budget_is_kept_and_spreads_its_samples_over_the_image(budget: int) -> None:
    view = make_views()[0]
    points = proposed([view], spacing=1.0, budget_per_view=budget)
    spacing = math.sqrt(KNOWN / budget)
    assert len(points.positions) <= budget
    # Of the squares that fit into the image at this spacing all are filled but those in the column in conflict.
    columns, rows = math.floor(WIDTH / spacing), math.floor(HEIGHT / spacing)
    assert len(points.positions) >= min(budget, (columns - 1) * rows) - 1
    expected = torch.full_like(points.scales, DensifyConfig().scale * spacing * 3.0 / 30)
    torch.testing.assert_close(points.scales, expected)


def test_what_one_view_inserts_another_does_not_insert_again() -> None:
    views = make_views()[:3]
    apart = sum(len(proposed([view], spacing=4.0).positions) for view in views)
    assert len(proposed(views, spacing=4.0).positions) < 0.7 * apart


def test_the_first_evaluation_looks_through_every_camera_seen_so_far() -> None:
    looked: list[set[str]] = []

    class Spied(TinyStore):
        def prior(self, camera: str, frame: int) -> DepthPrior:
            looked[-1].add(camera)
            return super().prior(camera, frame)

    config = replace(
        ALL_HOOKS, views_per_evaluation=1, prune=None, depth_loss=None, densify=DensifyConfig(start=6, every=2, stop=9)
    )
    d2 = D2Hooks(config, make_adapter(make_model()), Spied())
    views = make_views()
    for step in range(1, 9):
        d2.loss(step, views[(step - 1) % len(views)])
        looked.append(set())
        d2.step(step)
    assert looked[:6] == [set()] * 5 + [{"cam0", "cam1", "cam2"}]


@given(start=st.integers(0, 50), every=st.integers(1, 20), length=st.integers(0, 60), steps=st.integers(1, 120))
def test_a_window_is_due_at_its_start_and_every_so_often_until_its_stop(
    start: int, every: int, length: int, steps: int
) -> None:
    window = Window(start, start + length, every)
    assert [step for step in range(steps) if window.due(step)] == [
        step for step in range(start, start + length, every) if step < steps
    ]


@pytest.mark.parametrize("iterations", [1, 20, 40, 500, 2000, 30_000])
def test_a_schedule_inserts_early_and_leaves_half_of_the_run_to_train(iterations: int) -> None:
    config = DensifyConfig.for_iterations(iterations)
    assert config.start <= max(1, iterations / 40)
    assert config.start < config.stop
    if iterations >= 40:
        assert config.stop <= iterations / 2 + config.every + 1
    assert config.budget_per_view == 10 * iterations
