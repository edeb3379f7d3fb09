"""What a trainer hands over, held against the contract once: what was expected and what was got, in a sentence."""

from __future__ import annotations

import operator
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

from d2_plugin.errors import D2Error
from d2_plugin.protocol import Backbone, Splats, View
from d2_plugin.reading import said
from d2_plugin.values import shown

MEMBERS = ("settings", "__len__", "view", "slice_at", "insert", "remove", "on_resize")
"""What every backbone has (see `d2_plugin.protocol.Backbone`)."""

STATE = ("hooks", "views", "generator", "idle", "retired")
"""What `D2Hooks.state_dict` gives."""


def check_backbone(backbone: object) -> None:
    """Refuse what is no backbone, with the members that it lacks."""
    lacks = [name for name in MEMBERS if not hasattr(type(backbone), name) and not hasattr(backbone, name)]
    if lacks:
        raise D2Error(
            f"the backbone is a {type(backbone).__name__} without {', '.join(lacks)}: give an adapter of "
            "d2_plugin.adapters, or a class with these (docs/your-backbone.md)"
        )


def converted(backbone: Backbone, camera: object) -> View:
    """The trainer's camera as a view."""
    if camera is None:
        raise D2Error("d2.loss got None as a view: give the trainer's camera, or a list of them for a batch")
    try:
        view = backbone.view(camera)
    except D2Error:
        raise
    except (AttributeError, KeyError, TypeError) as failure:
        raise D2Error(
            f"{type(backbone).__name__} cannot make a view of a {type(camera).__name__} ({failure}): give "
            "the trainer's own camera, or a list of them for a batch"
        ) from failure
    if not isinstance(view, View):
        raise D2Error(
            f"view() of {type(backbone).__name__} returned a {type(view).__name__}, expected d2_plugin.protocol.View: "
            "mend the adapter"
        )
    return view


def check_view(view: View) -> None:
    """Refuse a view that no image can have; waits for its device, so once per view is enough."""
    name = f"the view of camera {shown(view.camera)} at frame {shown(view.frame)}"
    K, T = view.K, view.T_camera_world
    for matrix, shape, what in ((K, (3, 3), "K"), (T, (4, 4), "T_camera_world")):
        if not isinstance(matrix, Tensor) or tuple(matrix.shape) != shape:
            got = tuple(matrix.shape) if isinstance(matrix, Tensor) else type(matrix).__name__
            raise D2Error(f"{what} of {name} is {got}, expected a tensor {shape}: mend the adapter's view()")
        if not bool(torch.isfinite(matrix).all()):
            raise D2Error(f"{what} of {name} has a number that is not finite: correct the camera")
    fx, fy = float(K[0, 0]), float(K[1, 1])
    if not (fx > 0 and fy > 0):
        raise D2Error(f"{name} has focal lengths {fx:g} and {fy:g}, expected positive pixels: correct the camera")
    if not (view.width >= 1 and view.height >= 1):
        raise D2Error(f"{name} has {view.width}x{view.height} pixels, expected at least one: correct the camera")


def check_splats(splats: Splats, count: int, inserting: bool) -> None:
    """Refuse Gaussians that do not fit each other; those that hooks add to are float32, as the prior is."""
    means, rows = splats.means, splats.rows
    if means.ndim != 2 or means.shape[1] != 3 or len(rows) != len(means) or len(splats.opacities) != len(means):
        shapes = ", ".join(f"{name} {tuple(part.shape)}" for name, part in zip(splats._fields, splats))
        raise D2Error(f"slice_at() returned {shapes}, expected M rows each and means [M, 3]: mend the adapter")
    if len(means) > count:
        raise D2Error(f"slice_at() returned {len(means)} Gaussians of {count}: mend the adapter")
    if inserting and means.dtype != torch.float32:
        raise D2Error(
            f"densify inserts float32 Gaussians and slice_at() returned {means.dtype}: train in float32, or leave "
            "densify out"
        )


def check_device(splats: Splats, view: View) -> None:
    """Refuse Gaussians that do not lie where their view does, and its prior with it."""
    if splats.means.device != view.K.device:
        raise D2Error(
            f"the view of camera {shown(view.camera)} at frame {shown(view.frame)} is on {view.K.device} but "
            f"slice_at() returned Gaussians on {splats.means.device}: make view() return K and T_camera_world there"
        )


def check_step(step: object) -> None:
    """Refuse what is no number of an optimizer step."""
    try:
        fits = not isinstance(step, bool) and operator.index(step) >= 0  # type: ignore[arg-type]
    except TypeError:
        fits = False
    if not fits:
        raise D2Error(f"d2 got {shown(step)} as the step: give the number of the optimizer's step, 0 or more")


@contextmanager
def fitting_state() -> Iterator[None]:
    """Within it, a state that does not fit is one sentence."""
    try:
        yield
    except D2Error:
        raise
    except (AttributeError, IndexError, KeyError, RuntimeError, TypeError, ValueError) as failure:
        raise D2Error(
            f"the state of D2 does not fit ({said(failure)}): give what d2.state_dict() returned, of this version"
        ) from failure


def check_state(state: object, hooks: Mapping[str, Any], count: int) -> None:
    """Refuse a state that `state_dict` did not give, one of other hooks, or one of another number of Gaussians."""
    lacks = [name for name in STATE if not isinstance(state, Mapping) or name not in state]
    if lacks or not isinstance(state, Mapping):
        raise D2Error(f"the state of D2 has no {', '.join(lacks)}: give what d2.state_dict() returned")
    saved = state["hooks"]
    if not isinstance(saved, Mapping) or set(saved) != set(hooks):
        names = sorted(saved) if isinstance(saved, Mapping) else shown(saved)
        raise D2Error(
            f"the checkpoint was made with hooks {names or 'none'} but this run has {sorted(hooks) or 'none'}: "
            "resume with the same hooks"
        )
    of_hooks = [(name, *entry) for name, tensors in saved.items() for entry in _entries(name, tensors)]
    for name, what, tensor in [*of_hooks, ("d2", "inserted_at", state.get("inserted_at"))]:
        if isinstance(tensor, Tensor) and tensor.ndim > 0 and len(tensor) != count:
            raise D2Error(
                f"{what} of {name} in the checkpoint is of {len(tensor)} Gaussians but the backbone has {count}: "
                "restore the backbone from the same checkpoint before d2"
            )


def _entries(name: str, tensors: object) -> list[tuple[str, Any]]:
    if not isinstance(tensors, Mapping):
        raise D2Error(f"the state of D2 has {shown(tensors)} for {name}: give what d2.state_dict() returned")
    return list(tensors.items())
