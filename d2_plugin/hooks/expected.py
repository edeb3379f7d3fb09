"""What a trainer hands over, held against the contract once: what was expected and what was got, in a sentence."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any

import torch
import torch.nn.functional as F
from torch import Tensor

from d2_plugin.errors import D2Error
from d2_plugin.protocol import Backbone, DepthPrior, Label, Splats, View, call_optional
from d2_plugin.values import Range, fitting, shown

_log = logging.getLogger(__name__)

MEMBERS = ("settings", "__len__", "view", "slice_at", "insert", "remove", "on_resize")
"""What every backbone has (see `d2_plugin.protocol.Backbone`)."""

SKEWED = 0.01
"""Largest entry of R R^T - 1 of a pose: float32 and calibrations in text stay far below."""

BLOCK = 8
"""Side in pixels of the blocks over which the colours of two images are averaged before they are compared."""
OTHER_COLOR, OTHER_BLOCKS = 0.1, 0.01
"""Two images show different instants where colours (0..1) differ by more than the one in more than the other of the
blocks, less what they differ by in the median: compression, resizing and exposure stay below, what moves does not."""

STATE = ("hooks", "views", "generator", "idle", "retired")
"""What `D2Hooks.state_dict` gives."""


def check_backbone(backbone: object) -> None:
    """Refuse what is no backbone, with the members that it lacks."""
    if isinstance(backbone, type):
        raise D2Error(f"the backbone is the class {backbone.__name__}: give an object of it, {backbone.__name__}(...)")
    lacks = [name for name in MEMBERS if not hasattr(type(backbone), name) and not hasattr(backbone, name)]
    if lacks:
        raise D2Error(
            f"the backbone is a {type(backbone).__name__} without {', '.join(lacks)}: give an adapter of "
            "d2_plugin.adapters, or a class with these (docs/your-backbone.md)"
        )


def converted(backbone: Backbone, camera: object) -> View:
    """The trainer's camera as a view, its frame a plain number: two tensors of one number would be two keys."""
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
    return replace(view, frame=view.frame.item()) if isinstance(view.frame, Tensor) and view.frame.ndim == 0 else view


def check_view(view: View) -> None:
    """Refuse a view that no image can have; waits for its device, so once per view is enough."""
    for what, kind in {"camera": str, "frame": int, "time": float, "width": int, "height": int}.items():
        fitting(kind, getattr(view, what), f"the {what} of a view")
    name = f"the view of camera {shown(view.camera)} at frame {shown(view.frame)}"
    K, T = view.K, view.T_camera_world
    for matrix, shape, what in ((K, (3, 3), "K"), (T, (4, 4), "T_camera_world")):
        if not _has_numbers(matrix) or tuple(matrix.shape) != shape:
            got = f"{matrix.dtype} {tuple(matrix.shape)}" if isinstance(matrix, Tensor) else type(matrix).__name__
            raise D2Error(f"{what} of {name} is {got}, expected a plain tensor {shape}: mend the adapter's view()")
        if not bool(torch.isfinite(matrix).all()):
            raise D2Error(f"{what} of {name} has a number that is not finite: correct the camera")
    fx, fy = float(K[0, 0]), float(K[1, 1])
    if not (fx > 0 and fy > 0):
        raise D2Error(f"{name} has focal lengths {fx:g} and {fy:g}, expected positive pixels: correct the camera")
    if not (view.width >= 1 and view.height >= 1):
        raise D2Error(f"{name} has {view.width}x{view.height} pixels, expected at least one: correct the camera")
    rotation, fixed = T[:3, :3].detach().double().cpu(), [float(K[1, 0]), *K[2].tolist(), *T[3].tolist()]
    off = max(abs(got - must) for got, must in zip(fixed, (0, 0, 0, 1, 0, 0, 0, 1)))  # 1.5e-8 of an inverse in float32
    skewed = float((rotation @ rotation.T - torch.eye(3, dtype=torch.float64, device="cpu")).abs().max())
    if skewed > SKEWED or float(torch.linalg.det(rotation)) < 0 or off > 1e-5:
        raise D2Error(
            f"T_camera_world of {name} is no rotation and shift, or K has a number below its diagonal, or the last row "
            "of one of them is not 0 ... 0 1: correct the camera"
        )


def _has_numbers(tensor: object) -> bool:
    """Whether it is a tensor with a real number at every place, in memory."""
    if not isinstance(tensor, Tensor) or tensor.layout != torch.strided:
        return False
    return not (tensor.is_meta or tensor.is_complex() or tensor.is_quantized)


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


def check_prior(prior: object, name: str) -> str:
    """Refuse what a store gave and is no prior, with unknown labels or without a depth at most of the pixels that claim
    one; returns what is wrong with the others, in a sentence that begins with `name`, or nothing."""
    if not isinstance(prior, DepthPrior):
        raise D2Error(
            f"{name} is a {type(prior).__name__}, expected d2_plugin.protocol.DepthPrior or None: mend prior() of the "
            "store"
        )
    depth, labels, colors, sigma, reliability = prior
    if not all(m is None or _has_numbers(m) for m in prior) or depth is None or labels is None or depth.ndim != 2:
        raise D2Error(f"{name} has no depth as a map [H, W], or no labels: give tensors")
    exact = (torch.float32, torch.float64)  # 16 bits are too few for a depth
    if any(part is not None and part.dtype not in exact for part in (depth, sigma, reliability)):
        raise D2Error(f"{name} has maps that are not float32: give depth, sigma and reliability as float32")
    if any(part is not None and part.shape != depth.shape for part in (labels, sigma, reliability)):
        raise D2Error(f"{name} has maps of several sizes: give all of them {tuple(depth.shape)} as its depth")
    if colors is not None and (colors.shape != (*depth.shape, 3) or colors.dtype != torch.uint8):
        raise D2Error(f"{name} has colors {tuple(colors.shape)} of {colors.dtype}: give uint8 [H, W, 3]")
    if reliability is not None and not bool(((reliability >= 0) & (reliability <= 1)).all()):
        raise D2Error(f"{name} has a reliability outside of 0..1: mend prior() of the store")
    known = (labels != Label.EMPTY) & (labels != Label.CONFLICT)
    wrong = known & ~((depth > 0) & (depth < torch.inf) & (sigma is None or sigma >= 0))
    claimed, flawed, unknown = (int(mask.sum()) for mask in (known, wrong, labels.byte() > max(Label)))
    says = f"of {claimed} pixels labelled with a known depth {flawed} have NaN, infinity, 0 or less, or no such sigma"
    if unknown or 2 * flawed > claimed:
        last = int(max(Label))
        raise D2Error(
            f"{name} has {unknown} labels that are none of 0 to {last}, and {says}: mend prior() of the store"
        )
    return f"{name}: {says}; these count as empty" if flawed else ""


def check_inserted(added: object, asked: int, grown: int) -> None:
    """Refuse what `insert` returned where the number of Gaussians did not grow by it."""
    if isinstance(added, bool) or not isinstance(added, int) or added != grown or not 0 <= added <= asked:
        raise D2Error(
            f"insert() was given {asked} points and returned {shown(added)}, and the backbone has {grown} Gaussians "
            "more: return how many were added"
        )


def mistake_of(what: str, index: Tensor, was: int, now: int) -> str | None:
    """What is wrong with one report of a change from `was` to `now` Gaussians, if anything."""
    if not isinstance(index, Tensor) or index.dtype != torch.int64 or index.ndim != 1:
        got = f"{index.dtype} {tuple(index.shape)}" if isinstance(index, Tensor) else f"a {type(index).__name__}"
        return f"{what} reports {got}, expected an index, int64 [N_new]"
    if len(index) != now:
        return f"{what} reports an index of {len(index)} rows when there are {now}: report N_new rows, after the change"
    if ((index < -1) | (index >= was)).any():
        return f"{what} reports rows outside -1..{was - 1}: row r of the index is where row r was, -1 if new"
    return None


def small_image(backbone: Backbone, camera: object) -> Tensor | None:
    """The colours of the image that a camera shows [3, h, w], averaged over blocks; None where nobody knows them."""
    image = call_optional(backbone, "image", camera)
    return None if image is None or image.ndim != 3 else _blocks(image)


def check_colors(view: View, image: Tensor, colors: Tensor) -> None:
    """Warn where a prior's colours [H, W, 3] are not those of the image (`small_image`) that is trained on."""
    made = _blocks(colors.permute(2, 0, 1).float().cpu() / 255)
    if image.shape != made.shape:  # with opacity, or cut by the trainer: nothing to compare
        return
    apart = image.cpu() - made
    apart = (apart - apart.flatten(1).median(1).values[:, None, None]).abs()
    share = float((apart.amax(0) > OTHER_COLOR).float().mean())
    if share > OTHER_BLOCKS:
        _log.warning(
            "the prior of camera %s, frame %d was made for an image whose colours differ from those of the trained one "
            "in %.0f %% of its area: does the key name another frame?", view.camera, view.frame, 100 * share,
        )  # fmt: skip


def _blocks(image: Tensor) -> Tensor:
    """Means of an image [3, H, W] over blocks, those at the rim smaller."""
    return F.avg_pool2d(image.detach().float()[None], BLOCK, ceil_mode=True)[0]


class StepOrder:
    """Step numbers rise from one `D2Hooks.step` to the next, and those of `loss` are the number of the step they are
    of."""

    def __init__(self) -> None:
        self.done, self.begun = -1, -1
        """The last step that `D2Hooks.step` ended, and the last one that either of the two was given."""
        self._warned, self._alone, self._ended = False, 0, False

    def check(self, step: int, ends: bool) -> None:
        """Warn, once, of a number out of its order; `ends` says that it is `D2Hooks.step`'s."""
        wrong = step <= self.done or step < self.begun or (ends and self.done < self.begun != step)
        if wrong and not self._warned:
            self._warned = True
            _log.warning(
                "d2.%s got step %d after d2.loss or d2.step got %d: give both the number of the optimizer's step, "
                "which rises from one to the next, or schedules run at other steps",
                "step" if ends else "loss", step, self.begun,
            )  # fmt: skip
        self._alone = self._alone + (step != self.begun) if ends == self._ended else 0
        if self._alone == 100:
            _log.warning(
                "d2.%s was not called in 100 steps: call d2.loss and d2.step in each", "loss" if ends else "step"
            )
        self.begun, self._ended = step, ends
        self.done = step if ends else self.done


def check_surroundings() -> None:
    """Refuse what torch was told to do to every tensor that is made, and D2 cannot work with."""
    made = torch.empty(0)
    if made.dtype != torch.float32 or made.device.type == "meta" or torch.is_inference_mode_enabled():
        raise D2Error(
            f"torch makes {made.dtype} on {made.device}{' in inference mode' if made.is_inference() else ''}: D2 needs "
            "float32 as the default dtype, a device with memory, and no inference mode"
        )


def check_step(step: object) -> None:
    """Refuse what is no number of an optimizer step."""
    fitting(Annotated[int, Range(0)], step, "the number of the optimizer's step, which d2.loss and d2.step take,")


def check_state(state: Mapping[str, Any], hooks: Mapping[str, Any], count: int) -> None:
    """Refuse a state that `state_dict` did not give, one of other hooks, or one of another number of Gaussians."""
    lacks = [name for name in STATE if name not in state]
    if lacks:
        raise D2Error(f"the state of D2 has no {', '.join(lacks)}: give what d2.state_dict() returned")
    saved: Mapping[str, Mapping[str, Any]] = state["hooks"]
    if saved.keys() != hooks.keys():
        raise D2Error(
            f"the checkpoint was made with hooks {sorted(saved) or 'none'} but this run has {sorted(hooks) or 'none'}: "
            "resume with the same hooks"
        )
    of_hooks = [(name, *entry) for name, tensors in saved.items() for entry in tensors.items()]
    for name, what, tensor in [*of_hooks, ("d2", "inserted_at", state.get("inserted_at"))]:
        if isinstance(tensor, Tensor) and tensor.ndim > 0 and len(tensor) != count:
            raise D2Error(
                f"{what} of {name} in the checkpoint is of {len(tensor)} Gaussians but the backbone has {count}: "
                "restore the backbone from the same checkpoint before d2"
            )
