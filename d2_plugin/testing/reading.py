"""Checks of what the hooks read: views, slices, their gradients, the trainer's own depth."""

from __future__ import annotations

from collections.abc import Iterator

import torch

from d2_plugin.hooks.expected import check_view
from d2_plugin.protocol import Splats, View, covariance_matrices
from d2_plugin.rasterizer import rasterize
from d2_plugin.testing.example import Check, Example, some_points, some_rows


def _views(example: Example) -> Iterator[str]:
    views, again = example.views, example.views
    for view, same in zip(views, again):
        if not isinstance(view, View):
            yield f"view() must return a d2_plugin.protocol.View, got {type(view).__name__}"
            return
        yield from _camera(view)
        check_view(view)
        if (view.camera, view.frame) != (same.camera, same.frame):
            yield f"view() names one camera '{view.camera}', frame {view.frame} and then '{same.camera}', {same.frame}"
    keys = {(view.camera, view.frame) for view in views}
    if len(keys) < len(views):
        yield f"{len(views)} cameras share {len(keys)} keys (camera, frame): the depth prior is found by them"


def _camera(view: View) -> Iterator[str]:
    where = f"view '{view.camera}', frame {view.frame}:"
    if view.T_camera_world.shape != (4, 4) or view.K.shape != (3, 3):
        yield f"{where} T_camera_world must be [4, 4] and K [3, 3]"
        return
    rotation = view.T_camera_world[:3, :3].double().cpu()
    if not torch.allclose(rotation @ rotation.T, torch.eye(3, dtype=torch.float64), atol=1e-4):
        yield f"{where} the rotation of T_camera_world is not orthonormal: is it transposed, or scaled?"
    elif torch.linalg.det(rotation) < 0:
        yield f"{where} T_camera_world mirrors the world: axes are x right, y down, z forward"
    last_row = view.T_camera_world.new_tensor([0, 0, 0, 1])
    if not torch.allclose(view.T_camera_world[3], last_row, atol=1e-5):  # an inverse in float32 leaves 1.5e-8
        yield f"{where} the last row of T_camera_world is not 0 0 0 1: it maps column vectors, so transpose it"
    is_last = torch.allclose(view.K[2], view.K.new_tensor([0, 0, 1]), atol=1e-5)
    if (view.K.diagonal()[:2] <= 0).any() or not is_last or view.K[0, 1] != 0:  # the rasterizer refuses any skew
        yield f"{where} K must hold positive focal lengths in pixels, no skew and a last row 0 0 1"


def _slices(example: Example) -> Iterator[str]:
    count, backbone = len(example.backbone), example.backbone
    for view in example.views:
        splats = backbone.slice_at(view)
        yield from _shapes(splats, count)
        again = backbone.slice_at(view)
        if any(not torch.equal(a, b) for a, b in zip(splats, again)):
            yield "slice_at gives another answer when asked twice: it must not change the backbone"
        with torch.no_grad():
            if any(part.grad_fn is not None for part in backbone.slice_at(view)):  # a parameter itself is no graph
                yield "slice_at builds a graph under torch.no_grad(): surveys would keep it in memory"
            if not rasterize(splats, torch.zeros_like(splats.means), view, backbone.settings).alpha.any():
                yield f"camera '{view.camera}' sees no Gaussian: is T_camera_world world to camera, are means in world?"


def _shapes(splats: Splats, count: int) -> Iterator[str]:
    drawn = len(splats.rows)
    for name, part, shape in zip(Splats._fields, splats, ((drawn, 3), (drawn, 6), (drawn,), (drawn,))):
        if tuple(part.shape) != shape:
            yield f"{name} of a slice has shape {tuple(part.shape)}, expected {shape}"
            return
    rows = splats.rows
    if rows.dtype != torch.int64 or (drawn and (rows.min() < 0 or rows.max() >= count)):
        yield f"rows of a slice must be int64 in 0..{count - 1}: they say which of the {count} Gaussians each one is"
    elif len(rows.unique()) < drawn:
        yield "rows of a slice name one Gaussian twice: statistics would count it twice"
    if not all(torch.isfinite(part).all() for part in splats[:3]):
        yield "a slice of finite parameters is not finite"
        return
    if ((splats.opacities < 0) | (splats.opacities > 1)).any():
        yield "opacities of a slice are outside 0..1: activate them, temporal factor included"
    smallest = torch.linalg.eigvalsh(covariance_matrices(splats.covariances.detach().double()))[:, 0]
    if (smallest < -1e-6 * splats.covariances.detach().abs().amax(-1)).any():
        yield "a covariance has a negative eigenvalue: the order is xx xy xz yy yz zz"


def _gradients(example: Example) -> Iterator[str]:
    before = [parameter.detach().clone() for _, parameter in example.parameters]
    splats = example.backbone.slice_at(example.views[0])
    for name, part in zip(("means", "opacities"), (splats.means, splats.opacities)):
        if not part.requires_grad:
            yield f"{name} of a slice have no gradient: the depth loss could not move anything"
            return
    parameters = [parameter for _, parameter in example.parameters if parameter.requires_grad]
    if any(parameter.grad is not None for parameter in parameters):
        yield "slice_at leaves gradients behind: they would be added to the trainer's own"
    total = splats.means.sum() + splats.covariances.sum() + splats.opacities.sum()
    gradients = torch.autograd.grad(total, parameters, allow_unused=True) if parameters else ()
    reached = [gradient for gradient in gradients if gradient is not None]
    if parameters and not any(gradient.any() for gradient in reached):
        yield "no optimized parameter receives a gradient from a slice: is something detached?"
    if not all(torch.isfinite(gradient).all() for gradient in reached):
        yield "a slice has gradients that are not finite"
    if any(not torch.equal(a, b) for a, (_, b) in zip(before, example.parameters)):
        yield "slice_at changes parameters"


def _random_state(example: Example) -> Iterator[str]:
    state = torch.get_rng_state()
    view = example.views[0]
    example.backbone.slice_at(view)
    example.backbone.insert(some_points(example, view))
    example.backbone.remove(some_rows(example))
    if not torch.equal(state, torch.get_rng_state()):
        yield "the global random state changes: the trainer's own draws would differ with the hooks on"


def _rendered_depth(example: Example) -> Iterator[str]:
    backbone, camera = example.backbone, example.cameras[0]
    if not hasattr(backbone, "rendered_depth") or example.render is None:
        return
    example.render(camera)
    view = backbone.view(camera)
    rendered = backbone.rendered_depth(view)
    if rendered is None:
        return
    depth_sum, alpha = rendered
    if depth_sum.shape != (view.height, view.width) or alpha.shape != depth_sum.shape:
        yield f"rendered_depth has shapes {tuple(depth_sum.shape)}, {tuple(alpha.shape)}, expected [H, W] twice"
        return
    if not (depth_sum.requires_grad and alpha.requires_grad):
        yield "rendered_depth hands out maps without gradients: return None instead, and the plugin renders"
    splats = backbone.slice_at(view)
    own = rasterize(splats, torch.zeros_like(splats.means), view, backbone.settings)
    for name, got, expected in (("alpha", alpha, own.alpha), ("depth_sum", depth_sum, own.depth_sum)):
        limit = 0.02 * max(expected.detach().abs().max().item(), 1e-12)
        if (got - expected).detach().abs().mean() > limit:
            yield f"rendered_depth: {name} is not the slice's: depth_sum sums w z, not normalised, and alpha sums w"
    example.render(camera)
    if backbone.rendered_depth(backbone.view(example.cameras[1])) is not None:
        yield "rendered_depth hands out the render of one camera for another"
        return
    for other in example.cameras[:2]:
        example.render(other)
    batch = [backbone.rendered_depth(backbone.view(other)) for other in example.cameras[:2]]
    if any(maps is None for maps in batch):
        yield "rendered_depth knows the last render alone: find those of a batch by camera and frame"
    elif not torch.allclose(batch[0][1], alpha, rtol=1e-3, atol=1e-4):
        yield "rendered_depth hands out the render of one camera of a batch for another"


READING: dict[str, Check] = {
    "views": _views,
    "slices": _slices,
    "gradients": _gradients,
    "random state": _random_state,
    "rendered depth": _rendered_depth,
}
