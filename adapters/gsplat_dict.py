"""A gsplat dict of parameters with its dict of optimizers (examples/simple_trainer.py, gsplat.strategy).

    adapter = GsplatAdapter(splats, optimizers, strategy_state)     # after strategy.initialize_state()
    d2 = D2Hooks.from_config("d2.toml", backbone=adapter, iterations=30_000)
    loss = loss + d2.loss(step, views)                              # before backward
    d2.step(step)                                                   # after strategy.step_post_backward and zero_grad

gsplat has no instance whose methods could be watched: strategies swap the dict's entries. But every operation on
Gaussians carries along each tensor in the strategy's `state` (ops.py: duplicate, split, remove, relocate, sample_add),
so a column of row numbers in there shows afterwards what became of each row.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, MutableMapping, Sequence
from typing import Any

import torch
from torch import Tensor

from d2_plugin.errors import D2Error
from d2_plugin.gaussians.rotation4d import identities, unit_quaternions
from d2_plugin.gaussians.spherical_harmonics import coefficients_from_rgb
from d2_plugin.protocol import Points, RasterSettings, Splats, View

from .keys import ViewsByPose
from .shared import Renders, Resizing, appended, finite, on_device, replaced, seen_colors, splats_of, with_rows

ROWS = "d2_rows"
"""The column in the strategy's state: the number of each row plus one, since gsplat marks what is new with zeros."""

GSPLAT = RasterSettings(near=0.01)
"""Of gsplat's rasterizer, where the user does not change them."""

SliceOf = Callable[[Mapping[str, Tensor], View], Splats]
RowsOf = Callable[[Points], Mapping[str, Tensor]]


class GsplatAdapter(Resizing):
    """A dict of parameters, one Adam each, as a `d2_plugin.protocol.Backbone`.

    Args:
        parameters: by name, [N, ...] each: means, scales (log), quats (w first), opacities [N] (logit), and sh0, shN or
            colors (logit).
        optimizers: one per name, as gsplat keeps them.
        state: the strategy's state; without it, only appended rows are understood (MCMC's `sample_add`), and anything
            else resets what hooks count, with a warning.
        view: from the trainer's camera to a `View`; not needed where the trainer passes views.
        parser: of gsplat's examples, in the place of `view`: items of its data sets are then known by their poses.
        scene: gsplat 1.6's `GaussianScene`, which keeps a component for every row.
        slice_at: the 3D Gaussians of a view, for models that change over time; by default the parameters as they are.
        new_rows: raw rows of further parameters (velocities, times, ...) for inserted points.
        settings: constants of the rasterizer.
    """

    def __init__(
        self,
        parameters: MutableMapping[str, Tensor],
        optimizers: Mapping[str, torch.optim.Optimizer],
        state: MutableMapping[str, Any] | None = None,
        *,
        view: Callable[[object], View] | None = None,
        parser: Any = None,
        scene: Any = None,
        slice_at: SliceOf | None = None,
        new_rows: RowsOf | None = None,
        settings: RasterSettings = GSPLAT,
    ) -> None:
        super().__init__()
        for name in ("means", "scales", "quats", "opacities"):
            if name not in parameters:
                raise D2Error(f"parameters have {', '.join(parameters)} but no '{name}', which gsplat's names include")
        for name in parameters:
            if optimizers and name not in optimizers:  # without any, it only renders
                raise D2Error(f"parameter '{name}' has no optimizer: give the adapter one of each, as gsplat has")
        self.parameters, self.optimizers, self.state = parameters, optimizers, state
        self.settings = settings
        self._view = view if parser is None else ViewsByPose(parser)
        self._slice, self._new_rows, self.scene = slice_at, new_rows, scene
        self._renders: Renders[tuple[Tensor, Tensor]] = {}
        self._known = 0
        self._renumber()

    def __len__(self) -> int:
        """N; what the strategy did in the meantime is reported to the listeners first."""
        self._report_changes()
        return self._count

    def view(self, camera: object) -> View:
        """The view of the trainer's camera, or a `View` as it is."""
        if isinstance(camera, View):
            return on_device(camera, self.parameters["means"])
        if self._view is None:
            raise D2Error(
                f"a camera of type {type(camera).__name__} is no View: pass views, or give the adapter `view`"
            )
        return on_device(self._view(camera), self.parameters["means"])  # data sets leave their items on the CPU

    def rendered(self, cameras: Sequence[object], depth_sums: Tensor, alphas: Tensor) -> list[View]:
        """Pass these to `D2Hooks.loss` instead of the cameras that were just drawn with `render_mode="RGB+D"`.

        D2 then uses the trainer's own depth, the fourth channel [C, H, W], and alpha [C, H, W], and draws nothing.
        """
        self._renders.clear()
        views = [self.view(camera) for camera in cameras]
        for view, depth_sum, alpha in zip(views, depth_sums, alphas):
            self._renders[view.camera, view.frame] = depth_sum, alpha
        return views

    def rendered_depth(self, view: View) -> tuple[Tensor, Tensor] | None:
        """Depth sum and alpha of the trainer's render of this view, or None; hands them out once."""
        return self._renders.pop((view.camera, view.frame), None)

    def slice_at(self, view: View) -> Splats:
        """The 3D Gaussians at `view.time`, differentiable."""
        if self._slice is not None:
            return self._slice(self.parameters, view)
        p = self.parameters
        rotations = unit_quaternions(p["quats"]).T
        return splats_of(p["means"], p["scales"].exp(), rotations, torch.sigmoid(p["opacities"]))

    def colors(self, view: View, splats: Splats) -> Tensor:
        """RGB [M, 3] from sh0 and shN, or from `colors` (logit)."""
        p = self.parameters
        if "sh0" not in p:
            return torch.sigmoid(p["colors"][splats.rows, :3])
        coefficients = torch.cat([p["sh0"], p["shN"]], 1) if "shN" in p else p["sh0"]
        return seen_colors(coefficients, view, splats, round(coefficients.shape[1] ** 0.5) - 1)

    def trained(self) -> dict[str, Tensor]:
        """The tensors that are trained, by name."""
        return dict(self.parameters)

    @torch.no_grad()
    def insert(self, points: Points) -> int:
        """Isotropic Gaussians at the finite ones of the points, at the end; returns their number.

        The strategy's evidence (grad2d, count, radii, ...) is kept, with zeros for the new rows.
        """
        self._report_changes()
        points = finite(points)
        rows, count = self._rows(points), len(points.positions)
        for name, old in list(self.parameters.items()):
            self.parameters[name] = with_rows(self.optimizers[name], old, rows[name])
        if self.scene is not None:
            self.scene.on_sample_add(torch.zeros(count, dtype=torch.long, device=points.positions.device))
        index = appended(self._known, self._count, points.positions.device)
        self._change_state(lambda old: torch.cat([old, old.new_zeros(count, *old.shape[1:])]), index)
        return count

    @torch.no_grad()
    def remove(self, mask: Tensor) -> None:
        """Delete the rows where `mask` [N] is True from parameters, moments and the strategy's state."""
        self._report_changes()
        index = torch.nonzero(~mask).squeeze(-1)
        for name, old in list(self.parameters.items()):
            kept = old.detach()[index]
            self.parameters[name] = replaced(self.optimizers[name], old, kept, lambda moment: moment[index])
        if self.scene is not None:
            self.scene.on_remove(mask)
        self._change_state(lambda old: old[index], index)

    @property
    def _count(self) -> int:
        return len(self.parameters["means"])

    def _rows(self, points: Points) -> dict[str, Tensor]:
        """Raw rows of every parameter; refuses a parameter whose starting value is not known."""
        count, like = len(points.positions), points.positions
        known = {
            "means": points.positions,
            "scales": points.scales.log()[:, None].repeat(1, 3),
            "quats": identities(count, like),
            "opacities": torch.logit(points.opacities, eps=1e-6),
            "sh0": coefficients_from_rgb(points.colors, 0, 0),
            "colors": torch.logit(points.colors, eps=1e-3),
        }
        if "shN" in self.parameters:
            known["shN"] = like.new_zeros(count, *self.parameters["shN"].shape[1:])
        if self._new_rows is not None:
            known |= self._new_rows(points)
        for name, parameter in self.parameters.items():
            if name not in known or known[name].shape[1:] != parameter.shape[1:]:
                raise D2Error(
                    f"parameter '{name}' of shape {tuple(parameter.shape)} is not one of gsplat's own: give the "
                    "adapter a function `new_rows` that returns its rows for inserted points"
                )
        return {name: known[name] for name in self.parameters}

    def _change_state(self, change: Callable[[Tensor], Tensor], index: Tensor) -> None:
        state = {} if self.state is None else self.state
        for key, value in state.items():
            if isinstance(value, Tensor) and key != "binoms" and value.shape[:1] == (self._known,):
                state[key] = change(value)
        self._renumber()
        self._report(index)

    def _report_changes(self) -> None:
        """Report what the strategy did: a row keeps its number, its copies and new rows are -1."""
        numbers = None if self.state is None else self.state.get(ROWS)
        if numbers is not None and numbers is self._seen and numbers._version == self._version:
            return  # the very tensor that was there, and nobody wrote into it: no need to wait for the device
        if numbers is None or len(numbers) != self._count:
            self._report_growth()
        elif len(numbers) != self._known or not torch.equal(numbers, self._numbers()):
            index = _first_occurrences(numbers - 1)
            self._renumber()
            self._report(index)
        else:
            self._see(numbers)

    def _see(self, numbers: Tensor) -> None:
        assert self.state is not None
        self.state[ROWS], self._seen, self._version = numbers, numbers, numbers._version

    def _report_growth(self) -> None:
        """Without row numbers: growth means appended rows (gsplat's sample_add); D2Hooks notices shrinking."""
        if self._count != (known := self._known):
            self._renumber()
            if self._count > known:
                self._report(appended(known, self._count, self.parameters["means"].device))

    def _renumber(self) -> None:
        self._known = self._count
        if self.state is not None:
            self._see(self._numbers())

    def _numbers(self) -> Tensor:
        return torch.arange(1, self._count + 1, device=self.parameters["means"].device)


def gsplat_view(camera: str, frame: int, time: float, camtoworld: Tensor, K: Tensor, width: int, height: int) -> View:
    """The view of one camera of gsplat's data sets: camtoworld [4, 4] or [1, 4, 4] in OpenCV axes, K likewise."""
    pose = torch.linalg.inv_ex(camtoworld.reshape(4, 4)).inverse
    return View(camera, frame, time, pose, K.reshape(3, 3), width, height)


def _first_occurrences(rows: Tensor) -> Tensor:
    """`rows` [N] with -1 for every repetition of a number: a clone starts anew, its original goes on."""
    ordered, order = torch.sort(rows, stable=True)
    return rows.index_fill(0, order[1:][ordered[1:] == ordered[:-1]], -1)
