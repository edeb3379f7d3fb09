"""What the trainer evaluated to draw a view is not evaluated again for D2's depth of that view."""

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from mimics import gsplat
from repositories import VARIANTS
from tiny import make_views
from torch import Tensor

from d2_plugin import D2Hooks
from d2_plugin.adapters.gsplat_dict import GsplatAdapter
from d2_plugin.config import D2Config, DepthLossConfig


def make(name: str) -> SimpleNamespace:
    """A mimic with the depth loss alone: its adapter, cameras, what they depend on in time, and how it draws one."""
    standing, calls = VARIANTS[name](), []
    adapter, model, draw = standing.adapter, standing.model, standing.draw
    adapter.exact_times = True  # of Deformable-3D-Gaussians
    if name == "spacetime":
        moves = [getattr(model, f"_{part}") for part in ("rotation", "omega", "trbf_center", "trbf_scale", "motion")]
        asked = adapter._at
        adapter._at = lambda time: (calls.append(1), asked(time))[1]
        draw = lambda camera: (calls.append(1), standing.draw(camera))  # noqa: E731
    else:
        field = model._deformation if name == "hust4d" else adapter.deform.deform
        field.register_forward_hook(lambda *_: calls.append(1))
        moves = list(field.parameters())
    d2 = D2Hooks(D2Config(prior="prior", depth_loss=DepthLossConfig()), adapter)
    return SimpleNamespace(
        adapter=adapter, moves=moves, cameras=standing.cameras, draw=draw, d2=d2, calls=calls, model=model
    )


def gradients(made: SimpleNamespace, loss: Tensor) -> list[Tensor]:
    parameters = [*made.moves, made.model._xyz, made.model._opacity]
    parts = torch.autograd.grad(loss, parameters, allow_unused=True)
    return [torch.zeros_like(p) if part is None else part for p, part in zip(parameters, parts, strict=True)]


@pytest.fixture(params=["hust4d", "deformable3d", "spacetime"])
def name(request: pytest.FixtureRequest, workplace: Path) -> str:
    return request.param


@pytest.mark.parametrize("batch", [1, 3])
def test_what_moves_is_evaluated_once_a_view_and_gradients_are_the_same(name: str, batch: int) -> None:
    losses = []
    for drawn in (True, False):
        made = make(name)
        cameras = made.cameras[:batch]
        for camera in cameras if drawn else ():
            made.draw(camera)
        loss = made.d2.loss(1, cameras)
        assert len(made.calls) == batch
        losses.append((loss.detach(), *gradients(made, loss)))
        assert not made.adapter._unassigned
    assert any(part.any() for part in losses[0][1:-2]), "what moves has gradients"
    for one, other in zip(*losses, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-7)


def test_what_cannot_be_assigned_is_evaluated_anew(name: str) -> None:
    """A viewer that draws with gradients on, rows that changed since, an evaluation of a test image."""
    made = make(name)
    expected = made.d2.loss(1, made.cameras[0]).detach()
    made.draw(made.cameras[3])
    made.draw(made.cameras[0])
    made.calls.clear()
    torch.testing.assert_close(made.d2.loss(2, made.cameras[0]).detach(), expected)
    assert len(made.calls) == 1
    with torch.no_grad():
        made.draw(made.cameras[3])
    made.calls.clear()
    torch.testing.assert_close(made.d2.loss(3, made.cameras[0]).detach(), expected)
    made.draw(made.cameras[0])
    made.adapter.remove(torch.arange(len(made.adapter)) == 0)
    made.calls.clear()
    assert made.d2.loss(4, made.cameras[0]).isfinite()
    assert len(made.calls) == 1


@pytest.mark.usefixtures("workplace")
def test_a_render_that_leaves_no_new_fading_is_not_used() -> None:
    """Some renders of SpacetimeGaussians evaluate rotations and leave `trbfoutput` as an earlier view has it."""
    made = make("spacetime")
    made.draw(made.cameras[0])
    assert len(made.adapter._unassigned) == 1
    model = made.model
    model.get_rotation(0.3 - model._trbf_center.detach())
    model.trbfoutput = None
    model.get_rotation(0.4 - model._trbf_center.detach())
    assert len(made.adapter._unassigned) == 1


def test_gsplat_gives_its_own_depth_once() -> None:
    splats, optimizers, strategy = gsplat.make()
    adapter, views = GsplatAdapter(splats, optimizers, strategy.initialize_state()), make_views()[:2]
    drawn = [gsplat.render(splats, view) for view in views]
    depths = torch.stack([image.depth_sum for image in drawn])
    shown = adapter.rendered(views, depths, depths / 3)
    for view, image in zip(shown, drawn, strict=True):
        depth_sum, alpha = adapter.rendered_depth(view)
        assert torch.equal(depth_sum, image.depth_sum)
        assert torch.equal(alpha, image.depth_sum / 3)
        assert depth_sum.requires_grad
        assert adapter.rendered_depth(view) is None
    adapter.rendered(views, depths, depths)
    adapter.rendered(views[:1], depths, depths)
    assert adapter.rendered_depth(views[1]) is None, "renders of an earlier step are out of date"


@pytest.mark.usefixtures("workplace")
def test_offsets_at_noisy_times_are_not_used() -> None:
    made = make("deformable3d")
    made.adapter.exact_times = False
    for step, evaluations in ((1, 2), (20_000, 1)):
        made.calls.clear()
        made.draw(made.cameras[0])
        made.d2.loss(step, made.cameras[0])
        assert len(made.calls) == evaluations
