"""What the bundled backbones share: Gaussians that are rendered, watched, grown, optimized and saved."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
import torch
from torch import Tensor

from d2_plugin.errors import D2Error
from d2_plugin.gaussians import spherical_harmonics as sh
from d2_plugin.gaussians.moving import Harmonics, MovingGaussians
from d2_plugin.gaussians.native_image import add_screen_gradients, can_draw, constant_colors
from d2_plugin.rasterizer import RasterSettings, Render, Splats, View, rasterize
from d2_plugin.settings import NotNegative, Positive, Range, Settings

from .appearance import Appearance
from .background import Background
from .clocks import Clocks, ClockSettings
from .densify import DensifySettings, densify
from .dropout import Dropout
from .early_stop import EarlyStopSettings
from .gaussians import Gaussians

STATISTICS = ("screen_gradient", "seen")
"""Per Gaussian: summed length of the screen-space gradient, and the number of views that had one."""


@dataclass(frozen=True)
class SplatSettings(Settings):
    """Gaussians and their optimizer; learning rates are per step, those of positions relative to the extent."""

    temporal: bool = True
    """False leaves time out: these are ordinary 3D Gaussians."""
    sh_degree: Annotated[int, Range(0, 3)] = 0
    """Degree of the view-dependent colour."""
    position_rate: Positive = 3e-4
    """Learning rate of positions at the first step, times the extent of the scene.
    Studio, native 4D Gaussians alone, held-out PSNR after 1210 steps: 25.3 dB at 3e-4, 24.9 at 1e-4."""
    position_rate_final: Positive = 3e-6
    """The same at the last step; exponential in between."""
    scale_rate: NotNegative = 1e-2
    """Learning rate of log-scales. As above: 24.6 dB at 5e-3, 25.3 at 1e-2, 24.9 at 2e-2."""
    rotation_rate: NotNegative = 2e-3
    """Learning rate of quaternions."""
    opacity_rate: NotNegative = 5e-2
    """Learning rate of opacity logits. As above: 24.5 dB at 2e-2, 25.3 at 5e-2."""
    color_rate: NotNegative = 1e-2
    """Learning rate of the constant colour; higher harmonics learn at a twentieth of it."""
    initial_opacity: Annotated[float, Range(0, 1, open_low=True)] = 0.1
    """Opacity of the Gaussians at the start."""
    opacity_weight: NotNegative = 0.0
    """Weight of the mean opacity in the loss; what no image needs fades and is pruned. 3DGS-MCMC: 0.01.
    At 0.01, 500 steps, one seed: studio -.04 dB with D2 and -.01 without, plaza -.75 and +.43; SSIM1 never rises."""
    scale_weight: NotNegative = 0.0
    """Weight of the mean standard deviation, in extents of the scene, in the loss. 3DGS-MCMC: 0.01 in its own unit.
    At 0.1, 500 steps, one seed: studio +.22 dB with D2 and -.19 without, plaza -.91 and -.81."""
    dropout: Annotated[float, Range(0, 1, open_high=True)] = 0.0
    """Chance that a training render leaves a Gaussian out, at the last step; it grows from none. DropGaussian: 0.2.
    At 0.2, 500 steps, one seed: studio +.26 dB with D2 and -1.29 without, plaza -.57 and +.58."""
    background: bool = True
    """Whether directions have a colour of their own at infinity, behind all Gaussians: for skies, and for what no
    training camera has seen, which is black without it. 500 steps with D2, seed 0: studio 25.95 dB without, 30.73 with;
    plaza 19.97 and 21.84."""
    appearance: bool = False
    """Whether each training camera has an affine change of colour of its own. `d2 train` switches it on where the
    cameras' exposures differ.
    Studio with gains from .8 to 1.2, alone, 500 steps, one seed: 20.83 dB without, 23.88 with."""
    clocks: ClockSettings = field(default_factory=ClockSettings)
    """Shifts in time that cameras learn."""
    raster: RasterSettings = field(default_factory=RasterSettings)
    """Constants of the rasterizer."""
    densify: DensifySettings = field(default_factory=DensifySettings)
    """The backbone's own density control."""
    early_stop: EarlyStopSettings = field(default_factory=EarlyStopSettings)
    """Whether held-out patches end a run before its last step."""


class Observer:
    """What somebody may want to hear of a model: an entry of `SplatModel.observers`; here nothing is done with it."""

    def resized(self, index: Tensor) -> None:
        """The Gaussians changed: row r was row index[r] before, -1 for a new one."""

    def rendered(self, view: View, render: Render) -> None:
        """The model has rendered a view."""

    def optimized(self) -> None:
        """The parameters have changed their values."""


class SplatModel(ABC):
    """N Gaussians with their optimizer; a backbone adds `slice_at` and `rotations`.

    Raw parameters that every backbone has: positions [N, 3], log_scales [N, 3], opacity_logits [N],
    base_colors [N, 1, 3], and where asked for harmonics [N, C - 1, 3].
    """

    def __init__(
        self, rows: Mapping[str, Tensor], learning_rates: Mapping[str, float], settings: SplatSettings, extent: float
    ) -> None:
        self.settings, self.extent = settings, extent
        self.gaussians = Gaussians(rows, {name: learning_rates[name] for name in rows})
        self.gaussians.statistics = {name: rows["positions"].new_zeros(len(rows["positions"])) for name in STATISTICS}
        self.background = Background(self.gaussians.device) if settings.background else None
        self.appearance = Appearance(self.gaussians.device) if settings.appearance else None
        self.dropout = Dropout(settings.dropout) if settings.dropout else None
        self.clocks = Clocks(settings.clocks) if settings.clocks.learn and settings.temporal else None
        self.observers: list[Observer] = []
        self.screen_offsets: Tensor | None = None
        self._drawn: Tensor | None = None

    def __len__(self) -> int:
        return len(self.gaussians)

    @abstractmethod
    def slice_at(self, view: View) -> Splats:
        """The 3D Gaussians at `view.time` (paper: the selected temporal parameterization), differentiable."""

    @abstractmethod
    def rotations(self, rows: Mapping[str, Tensor]) -> Tensor:
        """Rotation matrices [D, D, K] of raw rows, D = 3 or, with time as the last axis, 4."""

    def colors(self, view: View, splats: Splats) -> Tensor:
        """RGB [M, 3] of the sliced Gaussians as seen in `view`."""
        return self.harmonic_colors(view, splats)

    def harmonic_colors(self, view: View, splats: Splats, phase: Tensor | None = None, time_degree: int = 0) -> Tensor:
        """Spherical harmonics in the direction of view, with `phase` [M] (fraction of the duration) also in time."""
        base = self.gaussians["base_colors"]
        if not (self.settings.sh_degree or time_degree) and can_draw(base):
            return constant_colors(base, splats.rows if len(splats.rows) < len(self) else None)
        coefficients = self.harmonics().coefficients
        if len(splats.rows) < len(self):
            coefficients = coefficients.index_select(0, splats.rows)
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

    def render(self, view: View, background: Tensor | None = None) -> Render:
        """Colour, depth sum and alpha of one view, differentiable; remembers what `accumulate` needs afterwards.

        The colour is as the view's camera saw it where it trained and exposures are learnt.

        A given `background` colour takes the place of the model's own background.
        """
        splats = self.slice_at(view)
        colors = self.colors(view, splats)
        self._drawn = splats.rows
        if self.dropout is not None and torch.is_grad_enabled():
            splats = splats._replace(opacities=self.dropout.thinned(splats.opacities))
        self.screen_offsets = _zeros(splats.means).requires_grad_(torch.is_grad_enabled())
        render = rasterize(
            splats, colors, view, self.settings.raster, background=background, screen_offsets=self.screen_offsets
        )
        own = self.background if background is None else None
        shown = render if own is None else own.joined(render, view)
        for observer in self.observers:
            observer.rendered(view, render._replace(alpha=shown.alpha))
        render = shown
        return render if self.appearance is None else self.appearance.seen_by(view.camera, render)

    def look_at(self, views: Sequence[View], images: Callable[[int], Tensor]) -> None:
        """What the model takes from the training images before the first step: background colours, frame rates."""
        if self.background is not None:
            self.background.start_from(views, images)
        if self.clocks is not None:
            self.clocks.look_at(views)

    def regularization(self) -> Tensor | float:
        """A term of the training loss that concerns no image; 0.0 where there is none."""
        s = self.settings
        total: Tensor | float = 0.0
        if s.opacity_weight:
            total = total + s.opacity_weight * torch.sigmoid(self.gaussians["opacity_logits"]).mean()
        if s.scale_weight:
            total = total + s.scale_weight / self.extent * self.gaussians["log_scales"].exp().mean()
        return total

    @abstractmethod
    def feel_time(self, clocks: Clocks, view: View) -> None:
        """After backward: tell the clocks how the loss changes with the time of the view."""

    @torch.no_grad()
    def accumulate(self, view: View) -> None:
        """After backward: add the last render's screen-space gradient, in units of half the image, per Gaussian."""
        if self.screen_offsets is None or self.screen_offsets.grad is None or self._drawn is None:
            raise D2Error("there is no screen-space gradient yet: render a view and go backward before accumulate")
        if self.clocks is not None:
            self.feel_time(self.clocks, view)
        gradient, statistics = self.screen_offsets.grad, self.gaussians.statistics
        if can_draw(gradient, *statistics.values()):
            sums = statistics["screen_gradient"], statistics["seen"]
            add_screen_gradients(gradient, self._drawn, (view.width, view.height), *sums)
            return
        half = gradient.new_tensor([view.width / 2, view.height / 2])
        length = (gradient * half).norm(dim=-1)
        statistics["screen_gradient"].index_add_(0, self._drawn, length)
        statistics["seen"].index_add_(0, self._drawn, (length > 0).to(length))

    def optimize(self, step: int, iterations: int) -> None:
        """One optimizer step, gradients cleared, learning rate of positions for the next step set."""
        self.gaussians.optimizer.step()
        self.gaussians.optimizer.zero_grad(set_to_none=True)
        if self.background is not None:
            self.background.optimize()
        if self.appearance is not None:
            self.appearance.optimize()
        if self.clocks is not None:
            self.clocks.optimize(step, iterations)
        if self.dropout is not None:
            self.dropout.advance(step, iterations)
        s = self.settings
        rate = decayed_rate(s.position_rate, s.position_rate_final, step, iterations)
        self.gaussians.set_learning_rate("positions", rate * self.extent)
        for observer in self.observers:
            observer.optimized()

    def densify(self, step: int, iterations: int, generator: torch.Generator) -> None:
        """The backbone's own clone, split, prune and opacity reset where `settings.densify` schedules them."""
        densify(self, self.settings.densify, step, iterations, generator)

    def append(self, rows: Mapping[str, Tensor]) -> None:
        """Add Gaussians (raw rows by name, [K, ...]) at the end. All growth goes through here."""
        before = len(self)
        self.gaussians.append(rows)
        index = torch.arange(len(self), device=self.gaussians.device)
        index[before:] = -1
        self._tell(index)

    def select(self, index: Tensor) -> None:
        """Keep the rows `index`. All shrinking and reordering goes through here."""
        self.gaussians.select(index)
        self._tell(index)

    def _tell(self, index: Tensor) -> None:
        for observer in self.observers:
            observer.resized(index)

    def state_dict(self) -> dict[str, Any]:
        """Parameters, statistics and optimizer: enough for a bitwise continuation."""
        parts = {"background": self.background, "appearance": self.appearance, "dropout": self.dropout}
        clocks = {} if self.clocks is None else {"clocks": self.clocks.state_dict()}
        return clocks | self.gaussians.state_dict() | {name: part.state_dict() for name, part in parts.items() if part}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from `state_dict()`; the state says whether there is a background and an appearance."""
        self.gaussians.load_state_dict(state)
        self.background = Background(self.gaussians.device) if "background" in state else None
        if self.background is not None:
            self.background.load_state_dict(state["background"])
        if self.dropout is not None:
            self.dropout.load_state_dict(state["dropout"])
        if self.clocks is not None:
            self.clocks.load_state_dict(state["clocks"])
        self.appearance = Appearance(self.gaussians.device) if "appearance" in state else None
        if self.appearance is not None:
            self.appearance.load_state_dict(state["appearance"])


def _zeros(means: Tensor) -> Tensor:
    """Offsets [M, 2] of centres [M, 3]. On the CPU not by torch, which wakes threads of its own for many."""
    if means.device.type == "cpu" and means.dtype == torch.float32:
        return torch.from_numpy(np.zeros((len(means), 2), np.float32))
    return means.new_zeros(len(means), 2)


def shared_rates(settings: SplatSettings, extent: float) -> dict[str, float]:
    """Learning rates of the tensors that every backbone has."""
    return {
        "positions": settings.position_rate * extent,
        "log_scales": settings.scale_rate,
        "opacity_logits": settings.opacity_rate,
        "base_colors": settings.color_rate,
        "harmonics": settings.color_rate / 20,
    }


def decayed_rate(first: float, last: float, step: int, iterations: int) -> float:
    """Learning rate after `step` of `iterations`: exponential from `first` to `last`."""
    fraction = min(step / max(iterations, 1), 1.0)
    return math.exp((1 - fraction) * math.log(first) + fraction * math.log(last))
