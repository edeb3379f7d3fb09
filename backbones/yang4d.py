"""Native 4D Gaussians after Yang et al. (ICLR 2024): one 4D Gaussian in (x, y, z, t), sliced at the rendered instant.

Mathematics as in fudan-zvg/4d-gaussian-splatting; where the scene has one instant or no motion the temporal
dimension is left out (`temporal=False`) and these are ordinary 3D Gaussians.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields

import torch
from torch import Tensor

from d2_plugin.errors import D2Error, unknown_name
from d2_plugin.rasterizer import RasterSettings, Render, Splats, View, rasterize

from . import spherical_harmonics as sh
from .densify import DensifySettings, densify
from .gaussians import Gaussians
from .native_slice import STATIC, TEMPORAL, can_slice, native_slice
from .rotation4d import (
    condition_on_time,
    covariances_from_factors,
    normalized_quaternions,
    rotation_matrices_3d,
    rotation_matrices_4d,
    temporal_marginal,
    time_row,
)
from .trainer import Trainer, TrainSettings

__all__ = ["TrainSettings", "Trainer", "Yang4D", "Yang4DSettings", "create", "initial_rows", "settings_from"]

MARGINAL_CUT = 0.05
"""A Gaussian whose temporal marginal F(t) is not above this is not drawn (forward.cu:334)."""

LOG_SCALE_LIMIT = 30.0
"""exp of a log-scale beyond +-this would leave the range where float32 squares are finite: such scales saturate."""


@dataclass(frozen=True)
class Yang4DSettings:
    """Model and optimizer of the backbone; learning rates are per step, positions' relative to the scene's extent."""

    temporal: bool = True
    """False leaves time out: no mean time, no temporal scale, one quaternion."""
    sh_degree: int = 0
    """Degree of the view-dependent colour, 0..3."""
    sh_time_degree: int = 0
    """Number of cosines in time that modulate the colour (0: constant in time)."""
    position_rate: float = 3e-4
    """Learning rate of positions times the extent of the scene, at the first step (studio, backbone alone, held-out
    PSNR after 1210 steps: 25.3 dB; 24.9 at 1e-4)."""
    position_rate_final: float = 3e-6
    """The same at the last step; exponential in between."""
    time_rate: float = 1.6e-3
    """Learning rate of mean times, relative to the duration."""
    scale_rate: float = 1e-2
    """Of log-scales (as above: 24.6 dB at 5e-3, 24.9 at 2e-2)."""
    rotation_rate: float = 2e-3
    opacity_rate: float = 5e-2
    """Of opacity logits (as above: 24.5 dB at 2e-2)."""
    color_rate: float = 1e-2
    """Of the constant term; higher harmonics learn at a twentieth of it."""
    initial_opacity: float = 0.1
    raster: RasterSettings = field(default_factory=RasterSettings)
    densify: DensifySettings = field(default_factory=DensifySettings)


class Yang4D:
    """N 4D Gaussians with their optimizer.

    Parameters (raw): positions [N, 3], log_scales [N, 3], left [N, 4], opacity_logits [N], base_colors [N, 1, 3],
    and where asked for: times [N], log_time_scales [N], right [N, 4], harmonics [N, C - 1, 3].
    """

    def __init__(self, rows: Mapping[str, Tensor], settings: Yang4DSettings, extent: float, duration: float) -> None:
        self.settings, self.extent, self.duration = settings, extent, max(duration, 1e-12)
        self.gaussians = Gaussians(rows, self._learning_rates(rows))
        self.gaussians.statistics = {name: rows["positions"].new_zeros(len(rows["positions"])) for name in _STATISTICS}
        self.screen_offsets: Tensor | None = None
        self._drawn: Tensor | None = None

    @classmethod
    def from_points(
        cls, positions: Tensor, colors: Tensor, times: Tensor, settings: Yang4DSettings, extent: float, duration: float
    ) -> Yang4D:
        """A model that starts at coloured points: positions [N, 3] world, colors [N, 3] in 0..1, times [N]."""
        scales = nearest_neighbour_scales(positions).clamp(max=0.1 * extent)
        opacities = torch.full_like(scales, settings.initial_opacity)
        rows = initial_rows(positions, colors, times, scales, opacities, settings, duration)
        return cls(rows, settings, extent, duration)

    def __len__(self) -> int:
        return len(self.gaussians)

    def slice_at(self, view: View) -> Splats:
        """The 3D Gaussians at `view.time` (paper: the selected temporal parameterization), differentiable.

        Raises:
            D2Error: the time is not a number; one outside the scene is fine, and shows less or nothing.
        """
        if self.settings.temporal and math.isnan(view.time):
            raise D2Error(f"the time of camera '{view.camera}', frame {view.frame} is NaN: give every view a time")
        names = TEMPORAL if self.settings.temporal else STATIC
        raw = {name: self.gaussians[name] for name in names}
        slice_in = native_slice if can_slice(raw) else reference_slice
        return Splats(*slice_in(raw, view.time, MARGINAL_CUT, LOG_SCALE_LIMIT))

    def colors(self, view: View, splats: Splats) -> Tensor:
        """RGB [M, 3] of the sliced Gaussians as seen in `view`."""
        g, s = self.gaussians, self.settings
        coefficients = g["base_colors"]
        if "harmonics" in g.parameters:
            coefficients = torch.cat([coefficients, g["harmonics"]], 1)
        if len(splats.rows) < len(g):
            coefficients = coefficients.index_select(0, splats.rows)
        centre = -view.T_camera_world[:3, :3].T @ view.T_camera_world[:3, 3]
        phase = (view.time - g["times"][splats.rows]) / self.duration if s.sh_time_degree else None
        return sh.colors(coefficients, splats.means - centre, phase, s.sh_degree, s.sh_time_degree)

    def render(self, view: View, background: Tensor | None = None) -> Render:
        """Colour, depth sum and alpha of one view, differentiable; remembers what `accumulate` needs afterwards."""
        splats = self.slice_at(view)
        colors = self.colors(view, splats)
        self._drawn = splats.rows
        self.screen_offsets = splats.means.new_zeros(len(splats.means), 2, requires_grad=torch.is_grad_enabled())
        return rasterize(
            splats, colors, view, self.settings.raster, background=background, screen_offsets=self.screen_offsets
        )

    @torch.no_grad()
    def accumulate(self, view: View) -> None:
        """After backward: add the last render's screen-space gradient, in units of half the image, per Gaussian."""
        gradient = self.screen_offsets.grad
        half = gradient.new_tensor([view.width / 2, view.height / 2])
        length = (gradient * half).norm(dim=-1)
        statistics = self.gaussians.statistics
        statistics["screen_gradient"].index_add_(0, self._drawn, length)
        statistics["seen"].index_add_(0, self._drawn, (length > 0).to(length))

    def optimize(self, step: int, iterations: int) -> None:
        """One optimizer step, gradients cleared, learning rate of positions for the next step set."""
        self.gaussians.optimizer.step()
        self.gaussians.optimizer.zero_grad(set_to_none=True)
        s, fraction = self.settings, min(step / max(iterations, 1), 1.0)
        log_rate = (1 - fraction) * math.log(s.position_rate) + fraction * math.log(s.position_rate_final)
        self.gaussians.set_learning_rate("positions", math.exp(log_rate) * self.extent)

    def densify(self, step: int, iterations: int, generator: torch.Generator) -> None:
        """The backbone's own clone, split, prune and opacity reset where `settings.densify` schedules them."""
        densify(self, self.settings.densify, step, iterations, generator)

    def append(self, rows: Mapping[str, Tensor]) -> None:
        """Add Gaussians (raw rows by name, [K, ...]) at the end. All growth goes through here."""
        self.gaussians.append(rows)

    def select(self, index: Tensor) -> None:
        """Keep the rows `index`. All shrinking and reordering goes through here."""
        self.gaussians.select(index)

    def state_dict(self) -> dict[str, object]:
        """Parameters, statistics and optimizer: enough for a bitwise continuation."""
        return self.gaussians.state_dict()

    def load_state_dict(self, state: Mapping[str, object]) -> None:
        """Continue from `state_dict()`."""
        self.gaussians.load_state_dict(state)

    def _learning_rates(self, rows: Mapping[str, Tensor]) -> dict[str, float]:
        s = self.settings
        rates = {
            "positions": s.position_rate * self.extent,
            "times": s.time_rate * self.duration,
            "log_scales": s.scale_rate,
            "log_time_scales": s.scale_rate,
            "left": s.rotation_rate,
            "right": s.rotation_rate,
            "opacity_logits": s.opacity_rate,
            "base_colors": s.color_rate,
            "harmonics": s.color_rate / 20,
        }
        return {name: rates[name] for name in rows}


def reference_slice(
    raw: Mapping[str, Tensor], time: float, marginal_cut: float = MARGINAL_CUT, log_scale_limit: float = LOG_SCALE_LIMIT
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The slice in torch: any dtype and device, and the oracle of `native_slice`, which documents the arguments."""
    if "times" not in raw:
        factors = rotation_matrices_3d(_unit(raw["left"])) * _scales(raw["log_scales"], log_scale_limit)
        rows = torch.arange(len(raw["positions"]), device=factors.device)
        return raw["positions"], covariances_from_factors(factors), torch.sigmoid(raw["opacity_logits"]), rows
    log_scales = torch.cat([raw["log_scales"], raw["log_time_scales"][:, None]], 1)
    parts = (raw["positions"], log_scales, raw["left"], raw["right"], raw["opacity_logits"], raw["times"])
    # A Gaussian outside its temporal support is never projected; without a gradient, none of it is 0 * inf.
    with torch.no_grad():
        last = time_row(_unit(raw["left"]), _unit(raw["right"])) * _scales(log_scales, log_scale_limit)
        rows = torch.nonzero(temporal_marginal(time - raw["times"], last.square().sum(0)) > marginal_cut).squeeze(-1)
    if len(rows) < len(log_scales):
        parts = tuple(part.index_select(0, rows) for part in parts)
    positions, log_scales, left, right, logits, times = parts
    factors = rotation_matrices_4d(_unit(left), _unit(right)) * _scales(log_scales, log_scale_limit)
    spatial, velocity = condition_on_time(factors)
    offset = time - times
    means = positions + (velocity * offset).T
    opacities = torch.sigmoid(logits) * temporal_marginal(offset, factors[3].square().sum(0))
    return means, covariances_from_factors(spatial), opacities, rows


def _unit(quaternions: Tensor) -> Tensor:
    return normalized_quaternions(_components(quaternions))


def _scales(log_scales: Tensor, limit: float) -> Tensor:
    return _components(log_scales).clamp(-limit, limit).exp()


def _components(rows: Tensor) -> Tensor:
    """[K, N] contiguous from [N, K]: what the functions of rotation4d work on."""
    return rows.T.contiguous()


_STATISTICS = ("screen_gradient", "seen")


def initial_rows(
    positions: Tensor,
    colors: Tensor,
    times: Tensor,
    scales: Tensor,
    opacities: Tensor,
    settings: Yang4DSettings,
    duration: float,
) -> dict[str, Tensor]:
    """Raw rows of isotropic Gaussians: positions [K, 3], colors [K, 3], times [K], scales [K], opacities [K].

    Rotations start at the identity and the temporal standard deviation at sqrt(duration / 5), as in the official
    code (a variance of a fifth of the duration, gaussian_model.py:280).
    """
    count = len(positions)
    identity = positions.new_zeros(count, 4)
    identity[:, 0] = 1
    coefficients = sh.coefficients_from_rgb(colors, settings.sh_degree, settings.sh_time_degree)
    rows = {
        "positions": positions,
        "log_scales": scales.log()[:, None].repeat(1, 3),
        "left": identity,
        "opacity_logits": torch.logit(opacities, eps=1e-6),
        "base_colors": coefficients[:, :1],
    }
    if coefficients.shape[1] > 1:
        rows["harmonics"] = coefficients[:, 1:]
    if settings.temporal:
        rows["times"] = times
        rows["log_time_scales"] = torch.full_like(scales, 0.5 * math.log(max(duration, 1e-12) / 5))
        rows["right"] = identity.clone()
    return rows


def nearest_neighbour_scales(positions: Tensor, neighbours: int = 3) -> Tensor:
    """Root mean square distance [N] to the nearest points, at least 1e-7; a lone point gets 1e-2.

    With fewer than `neighbours` other points, those that there are count.
    """
    count = len(positions)
    if count < 2:
        return positions.new_full((count,), 1e-2)
    k = min(neighbours, count - 1) + 1
    chunks = [torch.cdist(chunk, positions).topk(k, largest=False).values for chunk in positions.split(1024)]
    return torch.cat(chunks)[:, 1:].square().mean(-1).sqrt().clamp(min=1e-7)


def settings_from(table: Mapping[str, object], temporal: bool = True) -> Yang4DSettings:
    """`Yang4DSettings` from a plain table with tables "densify" and "raster" inside; a D2Error for unknown names."""
    chosen = dict(table)
    for name, kind in (("densify", DensifySettings), ("raster", RasterSettings), ("backbone", Yang4DSettings)):
        values = chosen if name == "backbone" else chosen.setdefault(name, {})
        known = {entry.name for entry in fields(kind)} - {"temporal"}
        for key in values:
            if key not in known:
                raise unknown_name(f"setting of {name}", key, known)
    chosen["densify"], chosen["raster"] = DensifySettings(**chosen["densify"]), RasterSettings(**chosen["raster"])
    return Yang4DSettings(temporal=temporal, **chosen)


def create(
    positions: Tensor,
    colors: Tensor,
    times: Tensor,
    *,
    extent: float,
    duration: float,
    temporal: bool,
    settings: Mapping[str, object] | None = None,
) -> Yang4D:
    """The entry point `d2_plugin.backbones`: a model from points, with plain `settings` over the defaults."""
    return Yang4D.from_points(positions, colors, times, settings_from(settings or {}, temporal), extent, duration)
