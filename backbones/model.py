"""What the bundled backbones share: Gaussians that are rendered, watched, grown, optimized and saved."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, TypeVar

import torch
from torch import Tensor

from d2_plugin.errors import D2Error
from d2_plugin.gaussians import spherical_harmonics as sh
from d2_plugin.gaussians.moving import Harmonics, MovingGaussians
from d2_plugin.protocol import Points
from d2_plugin.rasterizer import RasterSettings, Render, Splats, View, rasterize
from d2_plugin.settings import LearningRate, Range, Settings, Share

from .appearance import Appearance, changed
from .background import Background
from .densify import DensifySettings, densify
from .gaussians import Gaussians
from .jitter import jittered
from .starting import nearest_neighbour_scales

STATISTICS = ("screen_gradient", "seen")
"""Per Gaussian: summed length of the screen-space gradient, and the number of views that had one."""

INITIAL_OPACITY = 0.1
"""Opacity of the Gaussians at the start."""
LAST_POSITION_RATE = 0.01
"""Learning rate of positions at the last step, as a share of that at the first; exponential in between."""
ROTATION_RATE = 2e-3
"""Learning rate of quaternions."""
TIME_RATE = 1.6e-3
"""Learning rate of mean times, relative to the duration."""
COLOR_RATE = 1e-2
"""Learning rate of the constant colour; higher harmonics learn at a twentieth of it."""
SETTLING = 0.3
"""Share of a run, at its end, in which all learning rates fall: Gaussians that follow each image come to rest."""
LONG = 2000
"""Steps below which that share falls in proportion, and `dispensable` by the square: a short run has still to learn."""
LAST_RATE = 0.05
"""What is left of the learning rates at the last step."""
PROBES = 80
"""At least so many images of random signs tell what Gaussians are worth to the training images."""


@dataclass(frozen=True)
class SplatSettings(Settings):
    """Gaussians and their optimizer; learning rates are per step, those of positions relative to the extent."""

    temporal: bool = True
    """False leaves time out: these are ordinary 3D Gaussians."""
    sh_degree: Annotated[int, Range(0, 3)] = 0
    """Degree of the view-dependent colour."""
    position_rate: Annotated[float, Range(1e-9, 100)] = 1e-3
    """Learning rate of positions at the first step, times the extent of the scene."""
    scale_rate: LearningRate = 2e-2
    """Learning rate of log-scales."""
    opacity_rate: LearningRate = 5e-2
    """Learning rate of opacity logits."""
    jitter: Annotated[float, Range(0, 10)] = 0.2
    """How far aside each Gaussian stands in a training step, at random (its own standard deviations), in runs of 1000
    steps and more: with few cameras Gaussians otherwise rely on one another's exact places. 0: not at all."""
    background: bool = True
    """Whether directions have a colour of their own at infinity, behind all Gaussians: for skies, and for what no
    training camera has seen, which is black without it."""
    dispensable: Share = 0.01
    """Those that the training images miss least are left out before the last steps: as many as together change these
    images by this share of the squared error that is left, by less of it in a short run. 0 keeps all that show."""
    appearance: bool = False
    """Whether each training camera has an affine change of colour of its own. `d2 train` switches it on where the
    cameras' exposures differ."""
    raster: RasterSettings = field(default_factory=RasterSettings)
    """Constants of the rasterizer."""
    densify: DensifySettings = field(default_factory=DensifySettings)
    """The backbone's own density control."""


class Observer:
    """Callbacks of a model, an entry of `SplatModel.observers`; by default they do nothing."""

    def resized(self, index: Tensor) -> None:
        """The Gaussians changed: row r was row index[r] before, -1 for a new one."""

    def rendered(self, view: View, render: Render) -> None:
        """The model has rendered a view."""

    def optimized(self) -> None:
        """The parameters have changed their values."""


Model = TypeVar("Model", bound="SplatModel")


class SplatModel(ABC):
    """N Gaussians with their optimizer; a backbone adds `initial_rows`, `slice_at` and `rotations`.

    Raw parameters that every backbone has: positions [N, 3], log_scales [N, 3], opacity_logits [N],
    base_colors [N, 1, 3], and where asked for harmonics [N, C - 1, 3].
    """

    settings_kind: type[SplatSettings]

    def __init__(self, rows: Mapping[str, Tensor], settings: SplatSettings, extent: float, duration: float) -> None:
        self.settings, self.extent, self.duration = settings, extent, max(duration, 1e-12)
        rates = learning_rates(settings, extent, self.duration)
        self.gaussians = Gaussians(rows, {name: rates[name] for name in rows})
        self.gaussians.statistics = {name: rows["positions"].new_zeros(len(rows["positions"])) for name in STATISTICS}
        self.background = Background(self.gaussians.device) if settings.background else None
        self.appearance = Appearance(self.gaussians.device) if settings.appearance else None
        self.observers: list[Observer] = []
        self.screen_offsets: Tensor | None = None
        self._drawn: Tensor | None = None

    @classmethod
    def settings_from(cls, table: Mapping[str, Any], temporal: bool = True) -> Any:
        """Settings of the backbone, a `settings_kind`, from a plain table with tables inside.

        Raises:
            D2Error: an unknown name; a value of the wrong type or out of range.
        """
        if "temporal" in table:
            raise D2Error(
                "unknown setting of backbone 'temporal': whether there is time is decided by `[plan] temporal`"
            )
        return replace(cls.settings_kind.from_dict(table, "backbone"), temporal=temporal)

    @classmethod
    def create(
        cls: type[Model],
        positions: Tensor,
        colors: Tensor,
        times: Tensor,
        *,
        extent: float,
        duration: float,
        temporal: bool,
        settings: Mapping[str, Any] | None = None,
    ) -> Model:
        """A model that starts at coloured points: positions [N, 3] world, colors [N, 3] in 0..1, times [N].

        `settings` are plain, over the defaults: the entry point `d2_plugin.backbones`.
        """
        chosen = cls.settings_from(settings or {}, temporal)
        scales = nearest_neighbour_scales(positions).clamp(max=0.1 * extent)
        points = Points(positions, colors, times, scales, torch.full_like(scales, INITIAL_OPACITY))
        return cls(cls.initial_rows(points, chosen, duration), chosen, extent, duration)

    def __len__(self) -> int:
        return len(self.gaussians)

    @staticmethod
    @abstractmethod
    def initial_rows(points: Points, settings: Any, duration: float) -> dict[str, Tensor]:
        """Raw rows of isotropic Gaussians at K points, with their lifetimes where the model has such."""

    @abstractmethod
    def slice_at(self, view: View) -> Splats:
        """The 3D Gaussians at `view.time` (paper: the selected temporal parameterization), differentiable."""

    @abstractmethod
    def rotations(self, rows: Mapping[str, Tensor]) -> Tensor:
        """Rotation matrices [D, D, K] of raw rows, D = 3 or, with time as the last axis, 4."""

    def colors(self, view: View, splats: Splats) -> Tensor:
        """RGB [M, 3] of the sliced Gaussians as seen in `view`, by the mean camera where exposures are learnt."""
        return self.harmonic_colors(view, splats)

    def colors_seen(self, view: View, splats: Splats) -> Tensor:
        """RGB [M, 3] of the sliced Gaussians as the view's camera saw them."""
        return changed(self.colors(view, splats), self.change(view))

    def change(self, view: View) -> Tensor | None:
        """The change of colour [3, 4] from the mean camera to that of a view; None where there is none."""
        return None if self.appearance is None else self.appearance.change(view.camera)

    def harmonic_colors(self, view: View, splats: Splats, phase: Tensor | None = None, time_degree: int = 0) -> Tensor:
        """Spherical harmonics in the direction of view, with `phase` [M] (fraction of the duration) also in time."""
        coefficients = self.harmonics().coefficients
        if len(splats.rows) < len(self):
            coefficients = coefficients.index_select(0, splats.rows)
        if not (self.settings.sh_degree or time_degree):
            return sh.constant_colors(coefficients)
        centre = -view.T_camera_world[:3, :3].T @ view.T_camera_world[:3, 3]
        return sh.colors(coefficients, splats.means - centre, phase, self.settings.sh_degree, time_degree)

    def harmonics(self) -> Harmonics:
        """The colours of all Gaussians, differentiable."""
        coefficients = self.gaussians["base_colors"]
        if "harmonics" in self.gaussians.parameters:
            coefficients = torch.cat([coefficients, self.gaussians["harmonics"]], 1)
        return Harmonics(coefficients, self.settings.sh_degree)

    def moving(self) -> MovingGaussians | None:
        """The Gaussians as straight lines that fade in time, exactly; None where the model is not of that form."""
        return None

    def render(self, view: View, background: Tensor | None = None, generator: torch.Generator | None = None) -> Render:
        """Colour, depth sum and alpha of one view, differentiable; remembers what `accumulate` needs afterwards.

        The colour is as the view's camera saw it where it trained and exposures are learnt.

        A given `background` colour takes the place of the model's own background. With a `generator` of the CPU, for a
        training step, Gaussians stand aside as `settings.jitter` says.
        """
        splats = self.slice_at(view)
        colors = self.colors_seen(view, splats)
        if generator is not None and self.settings.jitter:
            splats = jittered(splats, self.settings.jitter, generator)
        self._drawn = splats.rows
        self.screen_offsets = splats.means.new_zeros(len(colors), 2, requires_grad=torch.is_grad_enabled())
        if background is not None:
            background = changed(background, self.change(view))
        render = rasterize(
            splats, colors, view, self.settings.raster, background=background, screen_offsets=self.screen_offsets
        )
        if background is None:
            render = self.behind(render, view)
        for observer in self.observers:
            observer.rendered(view, render)
        return render

    def behind(self, render: Render, view: View) -> Render:
        """The render with the background, which is black without a model of it, as the view's camera saw it."""
        change = self.change(view)
        if self.background is not None:
            return self.background.behind(render, view, change)
        if change is None:
            return render
        return render._replace(color=render.color + (1 - render.alpha)[..., None] * change[:, 3])

    def regularization(self) -> Tensor | float:
        """A term of the training loss that concerns no image; 0.0 where there is none."""
        return 0.0

    @torch.no_grad()
    def accumulate(self, view: View) -> None:
        """After backward: add the last render's screen-space gradient, in units of half the image, per Gaussian."""
        if self.screen_offsets is None or self.screen_offsets.grad is None or self._drawn is None:
            raise D2Error("there is no screen-space gradient yet: render a view and go backward before accumulate")
        gradient, statistics = self.screen_offsets.grad, self.gaussians.statistics
        half = gradient.new_tensor([view.width / 2, view.height / 2])
        length = (gradient * half).norm(dim=-1)
        statistics["screen_gradient"].index_add_(0, self._drawn, length)
        statistics["seen"].index_add_(0, self._drawn, (length > 0).to(length))

    def optimize(self, step: int, iterations: int) -> None:
        """One optimizer step, gradients cleared, learning rates for the next step set."""
        self.gaussians.optimizer.step()
        self.gaussians.optimizer.zero_grad(set_to_none=True)
        share = settled(step, iterations)
        if self.background is not None:
            self.background.optimize(share)
        if self.appearance is not None:
            self.appearance.optimize(share)
        rates = learning_rates(self.settings, self.extent, self.duration)
        rates["positions"] *= decayed(LAST_POSITION_RATE, step, iterations)
        for group in self.gaussians.optimizer.param_groups:
            group["lr"] = share * rates[group["name"]]
        for observer in self.observers:
            observer.optimized()

    def densify(self, step: int, iterations: int, generator: torch.Generator) -> None:
        """The backbone's own clone, split and prune where `settings.densify` schedules them."""
        densify(self, self.settings.densify, step, iterations, generator)

    def append(self, rows: Mapping[str, Tensor]) -> None:
        """Add Gaussians (raw rows by name, [K, ...]) at the end. All growth goes through here."""
        before = len(self)
        self.gaussians.append(rows)
        index = torch.arange(len(self), device=self.gaussians.device)
        index[before:] = -1
        self._report_resize(index)

    def select(self, index: Tensor) -> None:
        """Keep the rows `index`. All shrinking and reordering goes through here."""
        self.gaussians.select(index)
        self._report_resize(index)

    def leave_out_dispensable(
        self,
        iterations: int,
        views: Sequence[View],
        image: Callable[[int], Tensor],
        weights: Callable[[int], Tensor | None] = lambda index: None,
    ) -> None:
        """Delete the Gaussians that the views, and those halfway to the next instant of their camera, would miss least.

        `settings.dispensable` says how many in a run of `LONG` iterations, by the squared error of the render of each
        view against `image(index)` [H, W, 3], in which each pixel counts as much as `weights(index)` [H, W] says.
        """
        if not self.settings.dispensable:
            return
        ordered = sorted(views, key=lambda view: (view.camera, view.time))
        following = ordered[1:]
        between = [replace(a, time=(a.time + b.time) / 2) for a, b in zip(ordered, following) if a.camera == b.camera]
        energies, error = torch.zeros(len(self), device=self.gaussians.device), 0.0
        generator, looks = torch.Generator().manual_seed(0), [*views, *between]
        rounds = -(-PROBES // len(looks))
        for index, view in enumerate(looks):
            weight = weights(index) if index < len(views) else None
            for _ in range(rounds):
                color = self.add_energies(energies, view, generator, weight)
            if index < len(views):
                squares = (color - image(index)).square().sum(-1)
                error += float((squares if weight is None else squares * weight).sum()) / len(views)
        energies, rows = energies.sort()
        share = self.settings.dispensable * min(iterations / LONG, 1.0) ** 2
        few = energies.cumsum(0) <= share * error * rounds * len(looks)
        self.select(rows[~few].sort().values)

    def add_energies(
        self, energies: Tensor, view: View, generator: torch.Generator, weights: Tensor | None = None
    ) -> Tensor:
        """Add to `energies` [N] what a view would differ by without each Gaussian; returns the view [H, W, 3].

        Without Gaussian k a pixel differs by o_k dC/do_k, since its colour C is affine in every opacity. The energy of
        that difference, summed over an image, is the mean of (o_k d<s, C>/do_k)^2 over images s of random signs
        (Hutchinson 1990): one backward pass for all Gaussians together, and one image of signs for each call.
        Speedy-Splat (Hanson et al. 2025) prunes by a similar sum. `weights` [H, W]: how much each pixel counts.
        """
        with torch.no_grad():
            splats = self.slice_at(view)
            colors = self.colors_seen(view, splats)
        opacities = splats.opacities.requires_grad_()
        color = self.behind(rasterize(splats, colors, view, self.settings.raster), view).color
        signs = torch.randint(0, 2, color.shape, generator=generator).to(color) * 2 - 1
        signs = signs if weights is None else signs * weights.sqrt()[..., None]
        [gradient] = torch.autograd.grad((signs * color).sum(), opacities)
        energies.index_add_(0, splats.rows, (opacities * gradient).detach().square())
        return color.detach()

    def _report_resize(self, index: Tensor) -> None:
        for observer in self.observers:
            observer.resized(index)

    def state_dict(self) -> dict[str, Any]:
        """Parameters, statistics and optimizer: enough for a bitwise continuation."""
        parts = {"background": self.background, "appearance": self.appearance}
        return self.gaussians.state_dict() | {name: part.state_dict() for name, part in parts.items() if part}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from `state_dict()`; the state says whether there is a background and an appearance."""
        self.gaussians.load_state_dict(state)
        self.background = Background(self.gaussians.device) if "background" in state else None
        if self.background is not None:
            self.background.load_state_dict(state["background"])
        self.appearance = Appearance(self.gaussians.device) if "appearance" in state else None
        if self.appearance is not None:
            self.appearance.load_state_dict(state["appearance"])


def learning_rates(settings: SplatSettings, extent: float, duration: float) -> dict[str, float]:
    """Learning rates of the tensors that a backbone may have."""
    return {
        "positions": settings.position_rate * extent,
        "log_scales": settings.scale_rate,
        "opacity_logits": settings.opacity_rate,
        "base_colors": COLOR_RATE,
        "harmonics": COLOR_RATE / 20,
        "times": TIME_RATE * duration,
        "log_time_scales": settings.scale_rate,
        **dict.fromkeys(("left", "right", "rotations"), ROTATION_RATE),
    }


def settled(step: int, iterations: int) -> float:
    """Share of the learning rates after `step` of `iterations`: 1, and linear to `LAST_RATE` over the last steps."""
    last = SETTLING * iterations * min(iterations / LONG, 1.0)
    return LAST_RATE + (1 - LAST_RATE) * min(max(iterations - step, 0) / max(last, 1.0), 1.0)


def decayed(last: float, step: int, iterations: int) -> float:
    """Share of a learning rate after `step` of `iterations`: exponential from 1 to `last`."""
    return last ** min(step / max(iterations, 1), 1.0)
