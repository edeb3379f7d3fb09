"""What the adapters of all descendants of Inria's trainer share; each adds its slice and its raw rows.

They keep Gaussians in attributes `_xyz`, `_features_dc`, `_features_rest`, `_opacity`, `_scaling`, `_rotation` with one
named Adam group each, and change their number in two methods only: `densification_postfix` appends raw rows at the end
and `prune_points` deletes those of a mask. Both are overridden on the instance, which internal calls through `self.`
reach too; nothing of the repository is imported, its rasterizer included.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from d2_plugin.errors import D2Error
from d2_plugin.gaussians.rotation4d import identities
from d2_plugin.gaussians.spherical_harmonics import coefficients_from_rgb
from d2_plugin.protocol import Points, RasterSettings, ResizeListener, Splats, View
from d2_plugin.rasterizer import rasterize

from .cameras import inria_view
from .keys import KeyOf, PriorKey, key_from_image_name
from .probe import Probe, probe_package
from .shared import Renders, Resizing, appended, finite, on_device, optional, seen_colors, steps_of_adam

log = logging.getLogger(__name__)

Report = Callable[[], Tensor]
"""The index of a change, once it is done."""


class RawRows(NamedTuple):
    """Raw (pre-activation) rows of K new Gaussians that every descendant of Inria's model has."""

    xyz: Tensor  # [K, 3]
    features_dc: Tensor  # [K, 1, 3]
    features_rest: Tensor  # [K, C - 1, 3]
    opacity: Tensor  # [K, 1] logit
    scaling: Tensor  # [K, S] log
    rotation: Tensor  # [K, 4] identity


@dataclass(frozen=True)
class RenderedCamera:
    """A camera together with what the trainer has just rendered for it. Not a tuple: that would be read as a batch."""

    camera: Any
    package: Mapping[str, Any]


class InriaAdapter(Resizing, ABC):
    """Base of the adapters: everything of the contract but `slice_at` and `_append`.

    `key` finds the prior of a camera object; by default it is read from the image's name. What the trainer's network
    `field` returns when it draws a view is kept, with its graph, where a hook is on: D2's depth of the view uses that.
    """

    appending: ClassVar[tuple[str, ...]] = ("densification_postfix",)
    """Methods that append rows at the end."""
    pruning: ClassVar[tuple[str, ...]] = ("prune_points",)
    """Methods that delete the rows of a mask [N], True = delete."""
    evidence: ClassVar[dict[str, float]] = {"xyz_gradient_accum": 0.0, "denom": 0.0, "max_radii2D": 0.0}
    """Statistics of existing Gaussians that the repository's insertion would erase, with the value for a new row."""

    def __init__(self, gaussians: Any, key: KeyOf | None = None, field: Any = None) -> None:
        super().__init__()
        self.gaussians, self.settings = gaussians, RasterSettings()
        self._network = field
        self.probe: Probe | None = None
        self._key = key
        self._renders: Renders[Mapping[str, Any]] = {}
        self._evaluations: Renders[tuple[Tensor, ...]] = {}
        self._unassigned: deque[tuple[Tensor, ...]] = deque(maxlen=64)  # of one batch
        self._watched: Any = None
        self._asking = False
        self._step = 0
        self._overridden: dict[str, Any] = {}
        self._logged: set[str] = set()
        self._attach()

    def __len__(self) -> int:
        return len(self.gaussians._xyz)

    def view(self, camera: Any) -> View:
        """The view of a camera object, of a `RenderedCamera` (see `rendered`), or a `View` as it is."""
        package = None
        if isinstance(camera, RenderedCamera):
            camera, package = camera.camera, camera.package
        if isinstance(camera, View):
            return on_device(camera, self.gaussians._xyz)
        for name in ("world_view_transform", "projection_matrix"):
            if optional(camera, name) is None:
                kind = type(camera).__name__
                raise D2Error(f"a camera of type {kind} has no {name}: pass the trainer's own, or a d2_plugin View")
        view = inria_view(camera, self._key_of(camera), self._time(camera), self.gaussians._xyz)
        if package is not None:
            self._renders[view.camera, view.frame] = package
        if self._unassigned:  # views are asked for in the order in which they were drawn
            self._evaluations[view.camera, view.frame] = self._unassigned.popleft()
        return view

    def prior_key(self, camera: Any) -> PriorKey:
        """Camera and frame of the prior of a camera object."""
        return PriorKey(camera.camera, camera.frame) if isinstance(camera, View) else self._key_of(camera)

    def image_name(self, camera: Any) -> str | None:
        """Path of the image that a camera shows, where its object says it: an export's names are found by it."""
        if isinstance(camera, RenderedCamera):
            camera = camera.camera
        path = optional(camera, "image_path")
        return None if path is None else str(path)

    def image(self, camera: Any) -> Tensor | None:
        """The image that a camera shows [3, H, W], where its object keeps it."""
        return optional(camera.camera if isinstance(camera, RenderedCamera) else camera, "original_image")

    def begin_step(self, step: int) -> None:
        """Note the training step; renders of earlier steps are out of date and forgotten."""
        if step != self._step:
            self._renders.clear()
            self._evaluations.clear()
        self._step = step

    def pace(self, step: int) -> float:
        """As how many of Adam's steps the optimizer's first `step` count."""
        return steps_of_adam(optional(self.gaussians, "optimizer"), step)

    @abstractmethod
    def slice_at(self, view: View) -> Splats:
        """The 3D Gaussians at `view.time`, differentiable."""

    def colors(self, view: View, splats: Splats) -> Tensor:
        """RGB [M, 3] of the sliced Gaussians as seen in `view`, from the spherical harmonics."""
        return seen_colors(self._harmonics(), view, splats, int(optional(self.gaussians, "active_sh_degree", 0)))

    def _harmonics(self) -> Tensor:
        """Spherical harmonics [N, C, 3] of all rows."""
        return torch.cat([self.gaussians._features_dc, self.gaussians._features_rest], 1)

    def trained(self) -> dict[str, Tensor]:
        """The tensors that the trainer's optimizer changes, by the names of its groups."""
        found: dict[str, Tensor] = {}
        for group in optional(optional(self.gaussians, "optimizer"), "param_groups", ()):
            name, values = group.get("name", "parameter"), group["params"]
            found |= {name if len(values) == 1 else f"{name}.{i}": value for i, value in enumerate(values)}
        return found

    @torch.no_grad()
    def insert(self, points: Points) -> int:
        """Isotropic Gaussians at the points, by the repository's own function; returns how many were added.

        Points that are not finite are dropped. The evidence that the backbone gathered for its own densification is
        put back afterwards: its `densification_postfix` zeroes it for all Gaussians.
        """
        before = len(self)
        with self._evidence_kept():
            self._append(finite(points))
        return len(self) - before

    @torch.no_grad()
    def remove(self, mask: Tensor) -> None:
        """Delete the rows where `mask` [N] is True, by the repository's own function."""
        self.gaussians.prune_points(mask)

    def rendered(self, camera: Any, package: Mapping[str, Any]) -> RenderedCamera:
        """Pass this to `D2Hooks.loss` instead of the camera where the trainer's `package` may save a second render.

        Only a render with depth, alpha and gradients to both is used; the first one is probed, and the log says so.
        """
        return RenderedCamera(camera, package)

    def rendered_depth(self, view: View) -> tuple[Tensor, Tensor] | None:
        """Depth sum and alpha [H, W] of the package that came with this view in the present step, or None; hands it out
        once."""
        package = self._renders.pop((view.camera, view.frame), None)
        if package is None:
            self._log_once("no render of the trainer was passed along: D2 renders depth with its own rasterizer")
            return None
        if self.probe is None or not self.probe.final:
            self.probe = self._probed(view, package)
        if not self.probe.usable:
            return None
        return package["depth"].reshape(view.height, view.width), package["alpha"].reshape(view.height, view.width)

    def on_resize(self, listener: ResizeListener) -> None:
        """Register a listener; D2Hooks does so only where a hook is on."""
        super().on_resize(listener)
        if self._watched is None and isinstance(self._network, torch.nn.Module):
            self._watched = self._network.register_forward_hook(lambda _, __, result: self._keep(result))

    def _keep(self, result: tuple[Any, ...]) -> tuple[Any, ...]:
        """Keep an evaluation for the view that comes next, if the trainer made it with gradients; returns it."""
        if torch.is_grad_enabled() and not self._asking:
            self._unassigned.append(result)
        return result

    def _evaluated(self, view: View, field: Callable[..., Any], *inputs: Any) -> Any:
        """What the trainer's own evaluation for this view returned in the present step, else ours of `field`."""
        if self._unassigned:  # more evaluations than views: which is whose is not known
            self._unassigned.clear()
            self._evaluations.clear()
        known = self._evaluations.pop((view.camera, view.frame), None) if torch.is_grad_enabled() else None
        return known if known is not None and len(known[0]) == len(self) else self._own(field, *inputs)

    def _own(self, field: Callable[..., Any], *inputs: Any) -> Any:
        self._asking = True
        try:
            return field(*inputs)
        finally:
            self._asking = False

    def _log_once(self, sentence: str) -> None:
        if sentence not in self._logged:
            self._logged.add(sentence)
            log.info("%s", sentence)

    def detach(self) -> None:
        """Restore the instance's own methods; a later adapter of the same instance calls this on the earlier one."""
        for name, earlier in self._overridden.items():
            if earlier is None:
                delattr(self.gaussians, name)
            else:
                setattr(self.gaussians, name, earlier)
        self._overridden.clear()
        self._listeners.clear()
        if self._watched is not None:
            self._watched.remove()

    @abstractmethod
    def _append(self, points: Points) -> None:
        """Append the raw rows of finite points."""

    def _time(self, camera: Any) -> float:
        return float(camera.timestamp)

    def _key_of(self, camera: Any) -> PriorKey:
        return self._key(camera) if self._key is not None else self._default_key(camera)

    def _default_key(self, camera: Any) -> PriorKey:
        return key_from_image_name(self.image_name(camera) or str(camera.image_name))

    def _attach(self) -> None:
        """Override the structural methods; stages attach again to the same instance, so the last adapter wins."""
        earlier = optional(self.gaussians, "d2_adapter")
        if earlier is not None:
            earlier.detach()
        for name in self.appending:
            self._override(name, self._before_append)
        for name in self.pruning:
            if hasattr(self.gaussians, name):
                self._override(name, self._before_prune)
        object.__setattr__(self.gaussians, "d2_adapter", self)

    def _override(self, name: str, prepare: Callable[..., Report]) -> None:
        original = optional(self.gaussians, name)
        if original is None:
            raise D2Error(
                f"{type(self.gaussians).__name__} has no {name}, which {type(self).__name__} needs: "
                "choose the adapter of this codebase"
            )
        self._overridden[name] = vars(self.gaussians).get(name)

        def reporting(*arguments: Any, **named: Any) -> Any:
            report = prepare(*arguments, **named)
            result = original(*arguments, **named)
            self._report(report())
            return result

        object.__setattr__(self.gaussians, name, reporting)

    def _before_append(self, *_: Any, **__: Any) -> Report:
        count = len(self)
        return lambda: appended(count, len(self), self.gaussians._xyz.device)

    def _before_prune(self, mask: Tensor, *_: Any, **__: Any) -> Report:
        index = torch.nonzero(~mask).squeeze(-1)
        return lambda: index

    @contextmanager
    def _evidence_kept(self) -> Iterator[None]:
        """Lets an insertion run, then restores the accumulators of the old rows, with fresh ones for the new rows."""
        known = {name: optional(self.gaussians, name) for name in self.evidence}
        before = {name: value for name, value in known.items() if isinstance(value, Tensor) and value.numel()}
        count = len(self.gaussians._xyz)
        yield
        added = len(self.gaussians._xyz) - count
        for name, value in before.items():
            fresh = value.new_full((added, *value.shape[1:]), self.evidence[name])
            setattr(self.gaussians, name, torch.cat([value, fresh]))

    def _raw_rows(self, points: Points) -> RawRows:
        model, count = self.gaussians, len(points.positions)
        rest = optional(model, "_features_rest")
        return RawRows(
            xyz=points.positions,
            features_dc=coefficients_from_rgb(points.colors, 0, 0),
            features_rest=points.positions.new_zeros(count, *(rest.shape[1:] if rest is not None else (0, 3))),
            opacity=torch.logit(points.opacities, eps=1e-6)[:, None],
            scaling=points.scales.log()[:, None].repeat(1, model._scaling.shape[1]),
            rotation=identities(count, points.positions),
        )

    def _probed(self, view: View, package: Mapping[str, Any]) -> Probe:
        """Whether the trainer's render of this view can be used, judged against our own render of it."""
        with torch.no_grad():
            splats = self.slice_at(view)
            own = rasterize(splats, splats.means.new_zeros(len(splats.means), 1), view, self.settings)
        probe = probe_package(package, own, (self.gaussians._xyz, self.gaussians._opacity))
        self._log_once(probe.sentence)
        return probe
