"""The contract: plain data and one Protocol, shared by hooks, rasterizer, priors and adapters.

Conventions, everywhere: OpenCV axes (x right, y down, z forward); ``T_camera_world`` maps world points to camera
points; pixel i has its centre at i + 0.5; depth is planar z > 0; images are [H, W, 3] in 0..1; times are in the
backbone's own unit; covariances are stored as xx, xy, xz, yy, yz, zz.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Annotated, Any, NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor

from d2_plugin.settings import Range, Settings, Share

EXPORT_FILE = "export.json"
"""Beside exported images: which camera and frame of the source recording each camera and frame of the export is."""


class Label(IntEnum):
    """What is known about one pixel of a depth prior (paper, section "Dual-source Depth Consistency Prior")."""

    EMPTY = 0  # no depth
    MONO = 1  # aligned monocular depth only: may propose a Gaussian, never judge one
    VERIFIED = 2  # geometric depth confirmed by aligned monocular depth (Omega^v)
    CONFLICT = 3  # the two sources disagree: discarded
    AGREED = 4  # another camera's depth agrees, or a match that only a weak map finds: an addition to the paper
    FAR = 5  # sky and all beyond parallax, depth is only a lower bound: an addition to the paper


@dataclass(frozen=True, eq=False)
class View:
    """One camera at one instant.

    `T_camera_world` [4, 4] maps world to camera, `K` [3, 3] is in pixels; both are float tensors on the device of
    the backbone. `camera` and `frame` are the key of the depth prior; `time` is in the backbone's own unit.
    """

    camera: str
    frame: int
    time: float
    T_camera_world: Tensor
    K: Tensor
    width: int
    height: int

    def sees(self, points: Tensor, around: Tensor | float = 0.0) -> Tensor:
        """Which world points [K, 3] lie before the camera and in its image, hidden or not: bool [K].

        So must all that is within `around` [K] world units of them, to the sides and above and below.
        """
        pose = self.T_camera_world.to(points)
        x, y, z = ((points @ pose[:3, :3].T + pose[:3, 3]) @ self.K.to(points).T).unbind(-1)
        across, down = around * self.K[0, 0].to(points), around * self.K[1, 1].to(points)
        inside = (x >= across) & (x < self.width * z - across) & (y >= down) & (y < self.height * z - down)
        return (z > 0) & inside


class Splats(NamedTuple):
    """3D Gaussians at one instant, differentiable with respect to the backbone's parameters.

    `opacities` already include the temporal factor. `rows` says which of the backbone's N Gaussians each one is.
    """

    means: Tensor  # [M, 3] world
    covariances: Tensor  # [M, 6] xx xy xz yy yz zz
    opacities: Tensor  # [M] in 0..1
    rows: Tensor  # [M] int64, indices into 0..N-1


class Points(NamedTuple):
    """Gaussians to insert: what a depth prior knows about a surface point."""

    positions: Tensor  # [K, 3] world
    colors: Tensor  # [K, 3] in 0..1
    times: Tensor  # [K] in the backbone's unit
    scales: Tensor  # [K] isotropic standard deviation in world units
    opacities: Tensor  # [K] in 0..1
    lifetimes: Tensor | None = None  # [K] standard deviation in time; infinite, or None: as the backbone begins

    def select(self, which: Tensor) -> Points:
        """Those of a mask bool [K], or of indices."""
        which = torch.nonzero(which).squeeze(-1) if which.dtype == torch.bool else which  # one wait for a GPU, not six
        lifetimes = None if self.lifetimes is None else self.lifetimes[which]
        return self._replace(lifetimes=lifetimes, **{name: getattr(self, name)[which] for name in self._fields[:5]})

    @classmethod
    def joined(cls, parts: Sequence[Points]) -> Points:
        """All points of at least one part, in their order."""
        known = [torch.cat(values) for values in zip(*(part[:5] for part in parts))]
        if all(part.lifetimes is None for part in parts):
            return cls._make([*known, None])
        given = [torch.full_like(p.times, torch.inf) if p.lifetimes is None else p.lifetimes for p in parts]
        return cls._make([*known, torch.cat(given)])


class Edit(NamedTuple):
    """What a hook wants changed: rows to remove (bool [N]) and points to insert. None means nothing."""

    remove: Tensor | None = None
    insert: Points | None = None

    @property
    def changes(self) -> int:
        """How many Gaussians it removes and inserts."""
        removed = 0 if self.remove is None else int(self.remove.sum())
        return removed + (0 if self.insert is None else len(self.insert.positions))


class DepthPrior(NamedTuple):
    """D* of one view: `depth` [H, W] float32 (0 where there is none) and `labels` [H, W] uint8 (see `Label`).

    `colors` [H, W, 3] uint8 are the pixels of the image the prior was made for: inserted Gaussians start with them,
    and a trainer's camera need not keep its image in memory.

    `sigma` [H, W] float32 is the relative standard deviation of D*, infinite where nothing is known. `reliability`
    [H, W] float32 in 0..1, r(p), is how much a pixel counts where depth is judged. None stands for the paper: sigma is
    0 and r is 1 at trusted pixels; elsewhere sigma is infinite and r is 0. No map holds NaN.
    """

    depth: Tensor
    labels: Tensor
    colors: Tensor | None = None
    sigma: Tensor | None = None
    reliability: Tensor | None = None

    @property
    def verified(self) -> Tensor:
        """Omega^v: pixels where geometric and monocular depth confirm each other, bool [H, W]."""
        return self.labels == Label.VERIFIED

    @property
    def trusted(self) -> Tensor:
        """Pixels that may prune and supervise, bool [H, W]: Omega^v, and what the maps of two cameras agree on.

        Where the paper sums over Omega^v, the hooks sum over these."""
        return self.verified | (self.labels == Label.AGREED)

    @property
    def support(self) -> Tensor:
        """Omega^p: pixels that have a depth at all (trusted or mono-only), bool [H, W]."""
        return self.trusted | (self.labels == Label.MONO)

    @property
    def measured(self) -> bool:
        """Whether sigma was measured: the paper's 0 and infinity alone claim no error and know no free space."""
        return self.sigma is not None and bool(((self.sigma > 0) & self.sigma.isfinite()).any() | self.far.any())

    @property
    def far(self) -> Tensor:
        """Pixels whose depth is only a lower bound, bool [H, W]."""
        return self.labels == Label.FAR

    def near_edge(self, k: float) -> Tensor:
        """D_near(p) = D*(p) max(0, 1 - k sigma(p)), [H, W]: the prior says that space nearer than this is free.

        0 where nothing is known: no depth, or no finite sigma. At far pixels it is the depth itself, a lower bound.
        """
        sigma = torch.where(self.trusted, 0.0, torch.inf) if self.sigma is None else self.sigma
        sigma = torch.where(self.far, 0.0, sigma).to(self.depth)
        known = self.depth.isfinite() & (self.depth > 0) & sigma.isfinite() & (sigma >= 0)
        return torch.where(known, self.depth * (1 - k * sigma).clamp(min=0), 0.0)


class CameraRecord(NamedTuple):
    """The camera that a prior was built for, to be compared with the view that asks for it."""

    K: Tensor  # [3, 3] float64, pixels
    T_camera_world: Tensor  # [4, 4] float64


@dataclass(frozen=True)
class RasterSettings(Settings):
    """Constants of splatting, by default the Inria rasterizer's."""

    near: Annotated[float, Range(1e-9, unit="world units")] = 0.2
    """Gaussians with a view depth z <= near are not drawn."""
    blur: Annotated[float, Range(0, 1e6, unit="pixels squared")] = 0.3
    """Added to both diagonal entries of the projected covariance."""
    alpha_max: Annotated[float, Range(1e-6, 1, open_high=True)] = 0.99
    """Upper clamp of alpha; no gradient flows through a clamped alpha."""
    alpha_min: Share = 1 / 255
    """Contributions with a smaller alpha are skipped."""
    transmittance_min: Share = 1e-4
    """A pixel is finished before the Gaussian that would bring its transmittance to this value or below."""
    fov_clamp: Annotated[float, Range(1e-3, 1e6, infinite=True)] = 1.3
    """x/z and y/z are clamped to this multiple of tan(fov/2) in the projection's Jacobian."""
    antialiased: bool = False
    """Whether what the blur spreads is taken off the opacity (the 2D filter of Mip-Splatting, Yu et al. 2024): a
    Gaussian smaller than a pixel then looks alike from every distance."""


class Render(NamedTuple):
    """What a rasterizer returns for one view; every output has gradients."""

    color: Tensor  # [H, W, C] sum of w_i c_i (plus the background's share)
    depth_sum: Tensor  # [H, W] sum of w_i z_i, not normalised
    alpha: Tensor  # [H, W] A(p) = sum of w_i
    front: Tensor | None = None  # [H, W] sum of w_i max(0, 1 - z_i / D_near); None without a near edge


class Survey(NamedTuple):
    """Compositing weights of one view, gathered per Gaussian (M rows of the surveyed `Splats`) and per pixel.

    Per Gaussian, with w its weight at a pixel (paper: w_{k,q}), z its view depth, D* the prior, r its reliability (the
    paper: 1 at trusted pixels, 0 elsewhere), D_near the near edge of what it allows:
    """

    weight: Tensor  # [M] sum of w r
    error: Tensor  # [M] sum of w r |z - D*| / (D* + eps)
    max_weight: Tensor  # [M] maximum of w over all pixels; 0 where it contributes nowhere
    hits: Tensor  # [M] int32, number of pixels with r > 0 that it contributes to
    depth_sum: Tensor  # [H, W]
    alpha: Tensor  # [H, W]
    front: Tensor  # [M] sum of w max(0, 1 - z / D_near): weight where space is free; 0 without a near edge


ResizeListener = Callable[[Tensor], None]
"""Called with `index` [N_new] after a structural change: row r was row index[r] before, -1 for a new row."""


@runtime_checkable
class Backbone(Protocol):
    """What the hooks need from a 4D Gaussian model; structural, so nothing has to be inherited.

    Optional members:

    ``rendered_depth(view) -> (depth_sum, alpha) | None``
        where the trainer has rendered this view in the present step and its own output has both with gradients: saves a
        second render. The views of a batch are told apart by camera and frame.
    ``begin_step(step) -> None``
        called with the number of the training step before anything else is asked in it.
    ``image_name(camera) -> str | None``
        path of the image of a trainer's camera; priors of an exported recording are found by it.
    ``prior_key(camera) -> (camera, frame)``
        the key of the prior of a trainer's camera, without its view: what comes next is read ahead by it.
    ``image(camera) -> Tensor | None``
        RGB [3, H, W] in 0..1 of a trainer's camera: asked for once per view, and held against the prior's colours.
    ``active(step) -> bool``
        False while the hooks must wait (stages, warm-up); changes nothing.
    ``pace(step) -> float``
        as how many of Adam's steps the optimizer's first `step` count, where it takes smaller ones for a while, as
        RAdam does: schedules count these. It rises by one a step at most.
    ``colors(view, splats) -> Tensor``
        RGB [M, 3] of what `slice_at(view)` returned, as the view's camera saw them where exposures are learnt,
        differentiable: the live viewer shows them, and grey without; `motion` and `parallax` supervise them.
    ``trained() -> Mapping[str, Tensor]``
        the tensors that are trained, by name: training stops where one is not finite, and names it.
    ``behind(render, view) -> Render``
        the render with the backbone's own background, in the same colours, where the Gaussians leave some of a ray.
    """

    settings: RasterSettings

    def __len__(self) -> int:
        """N, the number of Gaussians."""

    def view(self, camera: Any) -> View:
        """The trainer's own camera object as a `View`."""

    def slice_at(self, view: View) -> Splats:
        """The 3D Gaussians at `view.time`, differentiable."""

    def insert(self, points: Points) -> int:
        """Add Gaussians together with their optimizer rows; returns how many were really added."""

    def remove(self, mask: Tensor) -> None:
        """Delete the rows where `mask` [N] is True together with their optimizer rows."""

    def on_resize(self, listener: ResizeListener) -> None:
        """Register a listener for every structural change, the backbone's own ones included."""


def covariance_matrices(covariances: Tensor) -> Tensor:
    """[M, 3, 3] from [M, 6]."""
    xx, xy, xz, yy, yz, zz = covariances.unbind(-1)
    return torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], -1).view(-1, 3, 3)


def call_optional(backbone: object, name: str, *arguments: Any, default: Any = None) -> Any:
    """What an optional member of a backbone returns (see `Backbone`), or `default` where the backbone has none."""
    method = getattr(backbone, name, None)
    return default if method is None else method(*arguments)


def schedule_step(backbone: object, step: int) -> int:
    """The step of the hooks' schedules at a step of the trainer, see `pace` of `Backbone`; the same without one."""
    return int(call_optional(backbone, "pace", step, default=step))
