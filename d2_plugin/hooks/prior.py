"""The prior loader: D* of a view, from disk, checked against the camera that asks for it."""

from __future__ import annotations

import logging
import math
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal, NamedTuple, Protocol

import torch
import torch.nn.functional as F
from torch import Tensor

from d2_plugin.errors import D2Error
from d2_plugin.protocol import CameraRecord, DepthPrior, Label, View, call_optional

log = logging.getLogger(__name__)


class Store(Protocol):
    """What the loader needs of a prior store (d2_plugin.store.store.PriorStore).

    Where it also has `camera(camera, frame) -> CameraRecord | None`, views are checked against it. Where it has
    `underway(camera, frame, quarter) -> (next frame, DepthPrior) | None`, instants between the trained ones are known.
    """

    def prior(self, camera: str, frame: int) -> DepthPrior | None: ...


Belief = Literal["all", "stereo", "nothing"]
"""What of a prior is believed: `all` of it, `stereo` alone, or `nothing`."""

BELIEVED: dict[str, tuple[Label, ...]] = {"stereo": (Label.VERIFIED,), "nothing": ()}
"""Labels of the pixels that keep their depth, where not all do."""


def believed(prior: DepthPrior, belief: Belief) -> DepthPrior:
    """The prior with those pixels left empty whose source is not believed."""
    if belief == "all":
        return prior
    kept = torch.zeros_like(prior.labels, dtype=torch.bool)
    for label in BELIEVED[belief]:
        kept |= prior.labels == label
    depth, labels = (torch.where(kept, map_, torch.zeros_like(map_)) for map_ in (prior.depth, prior.labels))
    return prior._replace(depth=depth, labels=labels)


Rename = Callable[[Store, "str | None"], Store]
"""From a store and the path of a trainer's image to the store under the names that the image's folder gives."""

JUDGES = 0.05
"""Largest sigma of a pixel that may judge a Gaussian: an error of 10 %, at which E_k saturates, is two of these."""

OUTLINE = 2
"""Pixels along the outline of a sky that say nothing: a Gaussian a pixel wide, two pixels inside of the surface, would
else stand in free space."""

FOCAL_TOLERANCE = 0.01
"""Largest relative difference of focal lengths."""

CENTRE_TOLERANCE = 0.01
"""Largest difference of principal points, relative to the image's width and height."""

ANGLE_TOLERANCE = 0.2
"""Largest difference of directions, in degrees."""

POSITION_TOLERANCE = 0.005
"""Largest difference of camera centres, relative to the median depth of the prior."""

NEAR, FAR = 1, 2
"""What `KnownMaps.kind` says where something is known."""


class KnownMaps(NamedTuple):
    """What may supervise one view, pixel by pixel: the prior's own maps, not copies of them, and one byte beside them.

    Known are pixels with a finite sigma, and far ones; in a prior without sigma, as in the paper, the trusted ones.
    Depth and sigma mean nothing where nothing is known.
    """

    kind: Tensor
    """uint8 [H, W]: 0 where nothing is known, `NEAR`, or `FAR`: there only a depth in front of `depth` is wrong."""
    depth: Tensor
    """[H, W], world units; at far pixels a lower bound."""
    sigma: Tensor | None
    """[H, W], relative standard deviation; far pixels count as if it were 0, and all do where there is none."""
    near: int
    """How many pixels are `NEAR`."""
    far: int
    """How many pixels are `FAR`."""

    @classmethod
    def of(cls, prior: DepthPrior) -> KnownMaps:
        """The maps of a prior; waits for its device to count."""
        known = prior.trusted if prior.sigma is None else prior.support & torch.isfinite(prior.sigma)
        kind = known.byte() * NEAR + prior.far.byte() * FAR
        near, far = (int(torch.count_nonzero(kind == which)) for which in (NEAR, FAR))
        return cls(kind, prior.depth, prior.sigma, near, far)


class CameraCheck:
    """Compares views with the cameras their priors were built for; the first view fixes how the world was moved.

    Depth along a pixel is only meaningful for the K and the pose it was computed with. Trainers may place the world
    anew, which changes no depth as long as it is a rotation and a shift, the same for all cameras; a change of scale
    does.
    """

    def __init__(self) -> None:
        self._first: tuple[View, Tensor, Tensor] | None = None

    def check(self, view: View, record: CameraRecord, depth: Tensor) -> None:
        """Refuse a view whose K or pose is not that of its prior; `depth` is D*, which says how large the scene is.

        Raises:
            D2Error: with the values of both.
        """
        self._check_intrinsics(view, record.K)
        pose, built = view.T_camera_world.detach().double().cpu(), record.T_camera_world
        if self._first is None:
            self._first = (view, pose, built)
            if not torch.allclose(pose, built, atol=1e-3):
                log.info("the trainer's world is not that of the prior: taken as moved by what %s shows", view.camera)
            return
        first, first_pose, first_built = self._first
        known = depth[depth > 0]
        if known.numel():
            slack = POSITION_TOLERANCE * float(known.median())
            self._check_pose(view, first, _relative(pose, first_pose), _relative(built, first_built), slack)

    def _check_intrinsics(self, view: View, built: Tensor) -> None:
        K, size = view.K.detach().double().cpu(), torch.tensor([view.width, view.height], dtype=torch.float64)
        focal = K.diagonal()[:2], built.diagonal()[:2]
        centre = K[:2, 2], built[:2, 2]
        if ((focal[0] / focal[1] - 1).abs() > FOCAL_TOLERANCE).any():
            raise D2Error(
                f"the prior of camera {view.camera}, frame {view.frame} was built for focal lengths {_text(focal[1])} "
                f"but the view has {_text(focal[0])}: build the prior with the cameras that are trained with"
            )
        if ((centre[0] - centre[1]).abs() > CENTRE_TOLERANCE * size).any():
            raise D2Error(
                f"the prior of camera {view.camera}, frame {view.frame} was built for the principal point "
                f"{_text(centre[1])} but the view has {_text(centre[0])}: build the prior with the trainer's cameras"
            )

    def _check_pose(self, view: View, first: View, here: Tensor, built: Tensor, slack: float) -> None:
        """Compare poses [4, 4] relative to the first view's; `slack` is a distance."""
        angle = _angle(here[:3, :3] @ built[:3, :3].T)
        centres = _centre(here), _centre(built)
        if angle > ANGLE_TOLERANCE or float((centres[0] - centres[1]).norm()) > slack:
            raise D2Error(
                f"the prior of camera {view.camera}, frame {view.frame} was built for a camera at {_text(centres[1])} "
                f"as seen from {first.camera} but the view is at {_text(centres[0])}, turned by {angle:.2f} degrees: "
                "the key names another camera, or the trainer's world is scaled; build the prior with its cameras"
            )


class PriorLoader:
    """Looks up D* by camera and frame, on the view's device; keeps the last few: memory must not grow with frames."""

    def __init__(
        self, store: Store, memory_mb: int = 512, rename: Rename | None = None, believe: Belief = "all"
    ) -> None:
        """`memory_mb`: what the priors that are kept may take; the one in use is kept whatever it takes."""
        self.store, self.keep_bytes, self._rename, self.believe = store, memory_mb << 20, rename, believe
        # By camera and frame; frame + 0.5 is halfway to the next.
        self._kept: OrderedDict[tuple[str, float], DepthPrior | None] = OrderedDict()
        self._known: dict[tuple[str, float], KnownMaps] = {}
        self._next: dict[tuple[str, int], int] = {}
        self._cameras = CameraCheck()
        self._without: set[str] = set()
        self.named = False
        """Whether `name_by` was called."""

    def name_by(self, image: str | None) -> None:
        """Learn, once, what the trainer calls cameras and frames, from the path of its first image.

        Where the image lies in an export of the prior's recording, priors are looked up by the export's names.
        """
        self.named = True
        if self._rename is not None:
            self.store = self._rename(self.store, image)

    def __call__(self, view: View) -> DepthPrior | None:
        """D* of the view, or None where the store has none; refuses one made for another size, K or pose."""
        key = (view.camera, view.frame)
        if key in self._kept:
            self._kept.move_to_end(key)
            return self._kept[key]
        prior = self.store.prior(*key)
        if prior is None and view.camera not in self._without:
            self._without.add(view.camera)
            log.warning(
                "camera %s has no prior at frame %d and is trained without D2 there; the prior has cameras %s",
                view.camera, view.frame, ", ".join(map(str, getattr(self.store, "cameras", ()))) or "unknown",
            )  # fmt: skip
        if prior is not None:
            self._check(view, prior)
            prior = self.usable(_on(view.K.device, prior))
        self._keep(key, prior)
        return prior

    def usable(self, prior: DepthPrior) -> DepthPrior:
        """What of a prior is believed and has a depth."""
        return _usable(believed(prior, self.believe))

    def underway(self, view: View, instants: Sequence[View], quarter: int = 2) -> tuple[View, DepthPrior] | None:
        """The view 1, 2 or 3 quarters of the way to the next of a camera's `instants`, and what is stored of it.

        None where the store has none, or the next instant has not been seen yet.
        """
        key = (view.camera, view.frame + quarter / 4)
        if key not in self._kept:
            stored = call_optional(self.store, "underway", view.camera, view.frame, quarter)
            if stored is None:
                return None
            self._next[view.camera, view.frame] = stored[0]
            self._keep(key, _on(view.K.device, stored[1]))
        self._kept.move_to_end(key)
        frame, prior = self._next[view.camera, view.frame], self._kept[key]
        following = next((other for other in instants if other.frame == frame), None)
        if following is None or prior is None or prior.depth.shape != (view.height, view.width):
            return None
        return replace(view, time=view.time + quarter / 4 * (following.time - view.time)), prior

    def _keep(self, key: tuple[str, float], prior: DepthPrior | None) -> None:
        self._kept[key] = prior
        while len(self._kept) > 1 and self._bytes() > self.keep_bytes:
            dropped, _ = self._kept.popitem(last=False)
            self._known.pop(dropped, None)

    def known(self, view: View) -> KnownMaps | None:
        """What is known of the depth of the view's pixels, or None where nothing is of any."""
        key, prior = (view.camera, view.frame), self(view)
        if prior is None:
            return None
        if key not in self._known:
            self._known[key] = KnownMaps.of(prior)
        known = self._known[key]
        return known if known.near + known.far else None

    def _bytes(self) -> int:
        tensors = [part for prior in self._kept.values() if prior is not None for part in prior if part is not None]
        tensors += [known.kind for known in self._known.values()]
        return sum(part.numel() * part.element_size() for part in tensors)

    def _check(self, view: View, prior: DepthPrior) -> None:
        height, width = prior.depth.shape
        if (width, height) != (view.width, view.height):
            raise D2Error(
                f"the prior of camera {view.camera}, frame {view.frame} is {width}x{height} pixels but the view is "
                f"{view.width}x{view.height}: build the prior at the resolution that is trained at"
            )
        describe = getattr(self.store, "camera", None)
        record = describe(view.camera, view.frame) if describe is not None else None
        if record is not None:
            self._cameras.check(view, record, prior.depth)


def _on(device: torch.device, prior: DepthPrior) -> DepthPrior:
    return DepthPrior._make(None if map_ is None else map_.to(device) for map_ in prior)


def _usable(prior: DepthPrior) -> DepthPrior:
    """The same prior, empty where the depth is no finite positive number: no store can put NaN into a loss.

    It is also empty at the outline of what is far: a Gaussian of the surface in front spills over it. Pixels judge
    Gaussians where sigma is small, whatever their label.
    """
    usable = torch.isfinite(prior.depth) & (prior.depth > 0) & ~(prior.far & ~_inside(prior.far))
    prior = prior._replace(labels=torch.where(usable, prior.labels, int(Label.EMPTY)))
    if prior.sigma is None or prior.reliability is not None:
        return prior
    return prior._replace(reliability=(prior.support & (prior.sigma <= JUDGES)).to(prior.depth))


def _inside(far: Tensor) -> Tensor:
    """The far pixels [H, W] at least `OUTLINE` pixels inside of what is far; the rim of the image is no outline."""
    others = (~far).float()[None, None]
    return F.max_pool2d(others, 2 * OUTLINE + 1, stride=1, padding=OUTLINE)[0, 0] == 0


def _relative(pose: Tensor, first: Tensor) -> Tensor:
    """From the first camera's axes to this camera's; no rigid motion of the world changes it."""
    return pose @ torch.linalg.inv(first)


def _angle(rotation: Tensor) -> float:
    """Degrees; by its skew part, since the cosine alone turns an orthonormality of 1e-4 into half a degree."""
    sine = float((rotation - rotation.T).norm()) / (2 * math.sqrt(2))
    return math.degrees(math.atan2(sine, float((rotation.diagonal().sum() - 1) / 2)))


def _centre(pose: Tensor) -> Tensor:
    return -pose[:3, :3].T @ pose[:3, 3]


def _text(values: Tensor) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in values.tolist()) + ")"
