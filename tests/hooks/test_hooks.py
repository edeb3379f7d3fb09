"""The paper's equations as pure functions, insertion that covers what the prior knows, and the table of hooks."""

import math
import os
import re
import subprocess
import sys
import textwrap
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny import ALL_HOOKS, HEIGHT, WIDTH, TinyStore, make_adapter, make_model, make_trainer, make_views

from d2_plugin import hooks
from d2_plugin.config import DensifyConfig, PruneConfig
from d2_plugin.hooks.densify import Densify, back_project, frustum_cells
from d2_plugin.hooks.hook import Context, HookConfig
from d2_plugin.hooks.prior import PriorLoader
from d2_plugin.plugin import D2Hooks
from d2_plugin.protocol import DepthPrior, Points, View


def test_back_projection_of_a_projected_point_is_the_point() -> None:
    turned = torch.linalg.qr(torch.rand(3, 3, generator=torch.Generator().manual_seed(0)).double())[0]
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3], pose[:3, 3] = turned, torch.tensor([0.2, -0.1, 0.5])
    K = torch.tensor([[60.0, 0, 30.5], [0, 55.0, 25.0], [0, 0, 1]], dtype=torch.float64)
    pixels, depth = torch.tensor([[0, 0], [63, 47], [10, 20]]), torch.tensor([0.5, 2.0, 1e4]).double()
    camera = back_project(View("a", 0, 0.0, pose, K, 64, 48), pixels, depth) @ turned.T + pose[:3, 3]
    image = camera @ K.T
    torch.testing.assert_close(camera[:, 2], depth)
    torch.testing.assert_close(image[:, :2] / image[:, 2:] - 0.5, pixels.double())


@pytest.mark.parametrize("unit", [1e-6, 1e-3, 1.0, 1e6])
def test_cells_as_thin_as_the_least_tau_u_have_numbers_in_any_unit_of_length(unit: float) -> None:
    near, far = frustum_cells(make_views()[1], unit * torch.tensor([[0.0, 0, 2], [0, 0, 3]]), 1.0, 1e-6).tolist()
    assert 0 <= near < far


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


@settings(max_examples=40)
@given(budget=st.integers(1, 400))
def test_a_budget_is_kept_and_spreads_its_samples_over_the_image(budget: int) -> None:
    view = make_views()[0]
    points = proposed([view], spacing=1.0, budget_per_view=budget, scale=0.7)
    spacing = math.sqrt(KNOWN / budget)
    assert len(points.positions) <= budget
    # Of the squares that fit into the image at this spacing all are filled but those in the column in conflict.
    columns, rows = math.floor(WIDTH / spacing), math.floor(HEIGHT / spacing)
    assert len(points.positions) >= min(budget, (columns - 1) * rows) - 1
    expected = torch.full_like(points.scales, 0.7 * spacing * 3.0 / 30)  # as large as the distance to the next
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


@given(start=st.integers(0, 50), every=st.integers(1, 20), length=st.integers(0, 60))
def test_a_hook_is_due_at_its_start_and_every_so_often_until_its_stop(start: int, every: int, length: int) -> None:
    hook, due = HookConfig(start, start + length, every), [*range(start, start + length, every)]
    assert [step for step in range(120) if hook.due(step)] == due
    assert [hook.left(step) for step in (*due, 120)] == [*range(len(due), -1, -1)]


@pytest.mark.parametrize("iterations", [1, 20, 40, 110, 500, 2000, 30_000])
def test_a_schedule_inserts_early_and_leaves_half_of_the_run_to_train(iterations: int) -> None:
    """In a short run holes close, and what is misplaced moves, at a pace that counts iterations, not parts of the run;
    and an evaluation costs as much as several steps."""
    insert, remove = DensifyConfig.for_iterations(iterations), PruneConfig.for_iterations(iterations)
    assert insert.start <= max(1, iterations / 40)
    assert insert.start < insert.stop <= iterations / 2 + insert.every + 1
    assert remove.every >= 10
    assert insert.every >= min(10, iterations / 10)
    assert insert.budget_per_view >= 10 * iterations


def test_a_step_inside_torch_compile_is_the_same_step() -> None:
    trainers = [make_trainer(ALL_HOOKS) for _ in range(2)]
    compiled = torch.compile(lambda *given: trainers[1].d2.loss(*given), backend="eager")
    for step, view in enumerate(make_views(), start=1):
        assert torch.equal(trainers[0].d2.loss(step, view), compiled(step, view))


FILE_OF_THE_HOOK = """
from dataclasses import dataclass
from torch import Tensor
from d2_plugin.hooks import Context, Hook, HookConfig
from d2_plugin.settings import NotNegative
"""

SCRIPT = """
import no_dynamo
from d2_plugin import hooks
import shrink
from shrink import Shrink, ShrinkConfig
HookRow = hooks.HookRow
hooks.HOOKS |= {ROW}

import torch
from d2_plugin import D2Config
from d2_plugin.config import for_iterations
from d2_plugin.runs.settings import HOOK_NAMES, RunSettings, check, hook_config
from d2_plugin.settings import declared
from tiny import make_trainer, parameters, same
from pathlib import Path

config = D2Config.from_dict({"shrink": {"weight": 0.5}})
trainer = make_trainer(config, iterations=2)
trainer.run()
done = [(entry.step, entry.hook, entry.action) for entry in trainer.d2.trace]
assert done == [(1, "shrink", "loss"), (2, "shrink", "loss")]
bare = make_trainer(iterations=2)
bare.run()
assert not same(parameters(bare), parameters(trainer))
assert trainer.d2.state_dict()["hooks"] == {"shrink": {}}

import tomllib
assert D2Config.from_dict(tomllib.loads(config.to_toml())) == config
assert {setting.name: setting.help for setting in declared(D2Config)}["shrink"] == "Keeps Gaussians small."
assert "shrink" in HOOK_NAMES
run = check(RunSettings("room", ("a",), hooks=("shrink",), overrides={"shrink": {"weight": 2}}))
assert hook_config(run, Path("p")).shrink.weight == 2.0
assert for_iterations(["shrink"], 100).hooks == ("shrink",)
"""


def test_a_hook_is_added_with_one_file_and_one_row(tmp_path: Path) -> None:
    example = re.search(r"class,\n\n(.*?)\n\nand the list", hooks.__doc__, re.DOTALL)[1]
    row = re.search(r'`("shrink": HookRow\(.*?\))`', hooks.__doc__)[1]
    (tmp_path / "shrink.py").write_text(FILE_OF_THE_HOOK + textwrap.dedent(example))
    script = SCRIPT.replace("ROW", row)
    tests = Path(__file__).parents[1]
    environment = {"PYTHONPATH": f"{tmp_path}:{tests}:{tests.parent}"}
    subprocess.run([sys.executable, "-c", script], check=True, env=os.environ | environment, timeout=300)
