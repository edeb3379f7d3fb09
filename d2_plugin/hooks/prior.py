"""The prior loader: D* of a view, from disk, checked against the camera that asks for it."""

from __future__ import annotations

import logging
import math
from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import Literal, NamedTuple, Protocol

import torch
import torch.nn.functional as F
from torch import Tensor

from d2_plugin.errors import D2Error
from d2_plugin.hooks.expected import check_colors, check_prior
from d2_plugin.protocol import CameraRecord, DepthPrior, Label, View, call_optional
from d2_plugin.store.maps import UNKNOWN, CodedPrior

log = logging.getLogger(__name__)


class Store(Protocol):
    """What the loader needs of a prior store (d2_plugin.store.store.PriorStore).

    Where it also has `camera(camera, frame) -> CameraRecord | None`, views are checked against it. Where it has
    `underway(camera, frame, quarter) -> (next frame, DepthPrior) | None`, instants between the trained ones are known.
    Where it has `tried() -> {"choice", "text"} | None`, that says what of it is worth inserting.
    Where it has `coded` and `coded_underway`, their `CodedPrior` is kept in memory in the place of the prior.
    """

    def prior(self, camera: str, frame: int) -> DepthPrior | None: ...


Key = tuple[str, int]
"""A camera and a frame."""

Belief = Literal["all", "stereo", "nothing"]
"""What of a prior is believed: `all` of it, `stereo` alone, or `nothing`."""


def believed(prior: DepthPrior, belief: Belief) -> DepthPrior:
    """The prior with those pixels left empty whose source is not believed."""
    if belief == "all":
        return prior
    kept = prior.labels == Label.VERIFIED if belief == "stereo" else torch.zeros_like(prior.labels, dtype=torch.bool)
    depth, labels = (torch.where(kept, map_, torch.zeros_like(map_)) for map_ in (prior.depth, prior.labels))
    return prior._replace(depth=depth, labels=labels)


Rename = Callable[[Store, "str | None"], Store]
"""From a store and the path of a trainer's image to the store under the names that the image's folder gives."""

JUDGES = 0.05
"""Largest sigma of a pixel that may judge a Gaussian: an error of 10 %, at which E_k saturates, is two of these."""

OUTLINE = 2
"""Pixels along the outline of a sky that say nothing: a Gaussian a pixel wide, two pixels inside of the surface, would
else stand in free space."""

RIM = 8
"""Pixels around what moves between two instants that are looked at with it: SSIM reaches 5 far."""

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
    def of(cls, prior: DepthPrior, unknown: float = math.inf) -> KnownMaps:
        """The maps of a prior whose sigma is `unknown` where nothing is; waits for its device to count."""
        known = prior.trusted if prior.sigma is None else prior.support & (prior.sigma < unknown)
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
        K = view.K.detach().double().cpu()
        size = K.new_tensor([view.width, view.height])
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
        centres = camera_centre(here), camera_centre(built)
        if angle > ANGLE_TOLERANCE or float((centres[0] - centres[1]).norm()) > slack:
            raise D2Error(
                f"the prior of camera {view.camera}, frame {view.frame} was built for a camera at {_text(centres[1])} "
                f"as seen from {first.camera} but the view is at {_text(centres[0])}, turned by {angle:.2f} degrees: "
                "the key names another camera, T_camera_world is inverted or in other axes, or the world is scaled"
            )


class Kept(NamedTuple):
    """One prior as it is kept in memory: as it is stored, or as a store of the user's own returned it."""

    maps: CodedPrior
    known: KnownMaps
    """Its depth and sigma are those of `maps`, codes where these are."""

    @classmethod
    def of(cls, read: CodedPrior, belief: Belief, pin: bool) -> Kept:
        """What of a prior may be used; in memory that a GPU copies from without a wait, where `pin` is set."""
        maps, coded = believed(read.codes, belief), read.range is not None
        empty = torch.zeros_like(maps.far) if coded else ~(torch.isfinite(maps.depth) & (maps.depth > 0))
        if maps.sigma is not None and not coded:
            empty |= ~(maps.sigma >= 0)
        if bool(maps.far.any()):
            empty |= _outline(maps.far)
        maps = maps._replace(labels=maps.labels.masked_fill(empty, int(Label.EMPTY)))
        if pin and not maps.depth.is_cuda:
            maps = DepthPrior._make(part if part is None else part.pin_memory() for part in maps)
        known = KnownMaps.of(maps, UNKNOWN if coded else math.inf)
        kind = known.kind.pin_memory() if pin and not known.kind.is_cuda else known.kind
        return cls(read._replace(codes=maps), known._replace(kind=kind))

    @classmethod
    def cut(cls, read: CodedPrior, part: tuple[slice, slice]) -> Kept:
        """Those rows and columns of what lies between two instants."""
        codes = DepthPrior._make(None if one is None else one[part].clone() for one in read.codes)
        return cls(read._replace(codes=codes), KnownMaps.of(codes, UNKNOWN if read.range is not None else math.inf))

    @property
    def bytes(self) -> int:
        """What it takes."""
        parts = [part for part in (*self.maps.codes, self.known.kind) if part is not None]
        return sum(part.numel() * part.element_size() for part in parts)

    def prior(self, device: torch.device) -> DepthPrior:
        """All maps on a device. Pixels judge Gaussians where sigma is small, whatever their label."""
        prior = self._decoded(self.maps.codes, device)
        if prior.sigma is None or prior.reliability is not None:
            return prior
        return prior._replace(reliability=(prior.support & (prior.sigma <= JUDGES)).to(prior.depth))

    def known_on(self, device: torch.device) -> KnownMaps:
        """What the depth loss reads: 4 bytes a pixel are copied where depth and sigma are codes."""
        moved = self._decoded(DepthPrior(self.known.depth, self.known.kind, sigma=self.known.sigma), device)
        return self.known._replace(kind=moved.labels, depth=moved.depth, sigma=moved.sigma)

    def _decoded(self, maps: DepthPrior, device: torch.device) -> DepthPrior:
        moved = DepthPrior._make(None if part is None else part.to(device, non_blocking=True) for part in maps)
        return self.maps._replace(codes=moved).decoded()


class PriorLoader:
    """Looks up D* by camera and frame, on the view's device.

    The last few stay in the host's memory, as they are stored: memory must not grow with the number of frames.
    """

    def __init__(
        self, store: Store, memory_mb: int = 2048, rename: Rename | None = None, believe: Belief | None = None
    ) -> None:
        """`memory_mb`: what the priors that are kept may take; the one in use is kept whatever it takes. `believe`:
        None for what trials with this prior showed."""
        if isinstance(store, type) or not callable(getattr(store, "prior", None)):
            raise D2Error(f"the store is a {type(store).__name__} without prior(camera, frame): give one that has it")
        self.store, self.keep_bytes, self._rename = store, memory_mb << 20, rename
        tried = None if believe else call_optional(store, "tried")
        self.believe: Belief = believe or ("all" if tried is None else tried["choice"])
        self.verdict: str = "" if tried is None else tried["text"]
        """What the trials showed, in words."""
        # By camera and frame; frame + 0.5 is halfway to the next.
        self._kept: OrderedDict[tuple[str, float], Kept | None] = OrderedDict()
        self._next: dict[tuple[str, float], tuple[int, torch.Size, tuple[slice, slice] | None]] = {}
        self._bytes = 0
        self._reading: dict[Key, Future[Kept | None]] = {}
        self._thread: ThreadPoolExecutor | None = None
        self._cameras = CameraCheck()
        self._checked: set[Key] = set()
        self._pin = self._dropped = False
        self._without: set[str] = set()
        self._flawed: set[str] = set()
        self.images: dict[tuple[str, int], Tensor] = {}
        """Colours of the images that are trained on (`small_image`), until the prior of their view is read."""
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
        kept = self._look_up(view)
        return None if kept is None else kept.prior(view.K.device)

    def known(self, view: View) -> KnownMaps | None:
        """What is known of the depth of the view's pixels, or None where nothing is of any."""
        kept = self._look_up(view)
        return None if kept is None or not kept.known.near + kept.known.far else kept.known_on(view.K.device)

    def prefetch(self, keys: Iterable[Key]) -> None:
        """Read these priors in a thread of its own, because their views come next. A failure waits until they do."""
        for key in keys:
            if self.named and key not in self._kept and key not in self._reading:
                self._thread = self._thread or ThreadPoolExecutor(1, "d2-prior")
                self._reading[key] = self._thread.submit(self._read, key)

    def _look_up(self, view: View) -> Kept | None:
        key = (view.camera, view.frame)
        self._pin = self._pin or view.K.is_cuda
        for other in [other for other, reading in self._reading.items() if other == key or reading.done()]:
            reading = self._reading.pop(other)
            if other == key or reading.exception() is None:
                self._keep(other, reading.result())
        if key not in self._kept:
            self._keep(key, self._read(key))
        self._kept.move_to_end(key)
        kept = self._kept[key]
        if kept is None:
            self.images.pop(key, None)
            if view.camera not in self._without:
                self._without.add(view.camera)
                have = ", ".join(map(str, getattr(self.store, "cameras", ()))) or "unknown"
                if frames := getattr(self.store, "frames", ()):
                    have += f" at frames {min(frames)} to {max(frames)}"
                message = "camera %s has no prior at frame %d and is trained without D2 there; the prior has cameras %s"
                log.warning(message, view.camera, view.frame, have)
        else:
            height, width = kept.known.kind.shape
            if (width, height) != (view.width, view.height):
                raise D2Error(
                    f"the prior of camera {view.camera}, frame {view.frame} is {width}x{height} pixels but the view is "
                    f"{view.width}x{view.height}: build the prior at the resolution that is trained at, or give "
                    "d2.loss views of the prior's size, whatever crop or scale is trained on"
                )
            if key not in self._checked:
                self._check(view, kept)
                self._checked.add(key)
        return kept

    def _read(self, key: Key) -> Kept | None:
        read = getattr(self.store, "coded", self.store.prior)(*key)
        if read is None:
            return None
        if not isinstance(read, CodedPrior):
            flaw = check_prior(read, f"the prior of camera {key[0]}, frame {key[1]}")
            if flaw and key[0] not in self._flawed:
                self._flawed.add(key[0])
                log.warning("%s", flaw)
            read = CodedPrior(read, None)
        return Kept.of(read, self.believe, self._pin)

    def _keep(self, key: tuple[str, float], kept: Kept | None) -> None:
        self._kept[key] = kept
        self._bytes += 0 if kept is None else kept.bytes
        while len(self._kept) > 1 and self._bytes > self.keep_bytes:
            _, dropped = self._kept.popitem(last=False)
            self._bytes -= 0 if dropped is None else dropped.bytes
            if not self._dropped:
                self._dropped = True
                message = "prior_memory_mb = %d holds the priors of %d views: the others are read from disk each time"
                log.info(message, self.keep_bytes >> 20, len(self._kept))

    def underway(self, view: View, instants: Sequence[View], quarter: int = 2) -> tuple[View, Kept] | None:
        """The view 1, 2 or 3 quarters of the way to the next of a camera's `instants`, and what is stored of it, cut to
        what moves.

        None where the store has none, nothing moves, or the next instant has not been seen yet.
        """
        key = (view.camera, view.frame + quarter / 4)
        if key not in self._kept:
            name = "coded_underway" if hasattr(self.store, "coded_underway") else "underway"
            stored = call_optional(self.store, name, view.camera, view.frame, quarter)
            if stored is None:
                return None
            coded = stored[1] if isinstance(stored[1], CodedPrior) else CodedPrior(stored[1], None)
            part = _moving_part(coded.codes)
            self._next[key] = stored[0], coded.codes.depth.shape, part
            self._keep(key, None if part is None else Kept.cut(coded, part))
        self._kept.move_to_end(key)
        (frame, shape, part), kept = self._next[key], self._kept[key]
        following = next((other for other in instants if other.frame == frame), None)
        if following is None or kept is None or part is None or shape != (view.height, view.width):
            return None
        time = view.time + quarter / 4 * (following.time - view.time)
        return replace(_window(view, part), time=time), kept

    def moving(self, view: View, instants: Sequence[View]) -> tuple[View, Tensor] | None:
        """The part of a view that moves on to the camera's next instant, at the last one that has come from the one
        before, and its image uint8 [H, W, 3]; None where `underway` knows nothing of it."""
        kept = self._look_up(view)
        earlier = [other for other in instants if other.frame < view.frame]
        for start in (view, *sorted(earlier, key=lambda other: other.frame)[-1:]):
            if self.underway(start, instants) is not None and kept is not None and kept.maps.codes.colors is not None:
                part = self._next[start.camera, start.frame + 0.5][2]
                assert part is not None, "underway says None there"
                return _window(view, part), kept.maps.codes.colors[part]
        return None

    def believed(self, prior: DepthPrior) -> DepthPrior:
        """What of a prior is believed."""
        kept = believed(prior, self.believe)
        return kept if kept.reliability is None else kept._replace(reliability=kept.reliability * kept.support)

    def _check(self, view: View, kept: Kept) -> None:
        describe = getattr(self.store, "camera", None)
        record = describe(view.camera, view.frame) if describe is not None else None
        if record is not None:
            some = DepthPrior(kept.known.depth[::4, ::4], kept.known.kind)  # a sample says how large the scene is
            self._cameras.check(view, record, kept.maps._replace(codes=some).decoded().depth)
        image, colors = self.images.pop((view.camera, view.frame), None), kept.maps.codes.colors
        if image is not None and colors is not None:
            check_colors(view, image, colors)


def _moving_part(maps: DepthPrior) -> tuple[slice, slice] | None:
    """Rows and columns that hold all pixels with a depth, which are those that move, and a rim; None without any."""
    sides = torch.nonzero(maps.depth, as_tuple=True)
    if not len(sides[0]):
        return None
    first, last = ([int(end) for end in ends] for ends in zip(*(side.aminmax() for side in sides)))
    rows, columns = (
        slice(max(a - RIM, 0), min(b + RIM + 1, size)) for a, b, size in zip(first, last, maps.depth.shape)
    )
    return rows, columns


def _window(view: View, part: tuple[slice, slice]) -> View:
    """Those rows and columns of a view."""
    rows, columns = part
    K = view.K.clone()
    K[0, 2] -= columns.start
    K[1, 2] -= rows.start
    return replace(view, K=K, width=columns.stop - columns.start, height=rows.stop - rows.start)


def _outline(far: Tensor) -> Tensor:
    """The far pixels [H, W] less than `OUTLINE` pixels inside of what is far, where a Gaussian of the surface in front
    spills over them; the rim of the image is no outline."""
    others = (~far).float()[None, None]
    return far & (F.max_pool2d(others, 2 * OUTLINE + 1, stride=1, padding=OUTLINE)[0, 0] > 0)


def _relative(pose: Tensor, first: Tensor) -> Tensor:
    """From the first camera's axes to this camera's; no rigid motion of the world changes it."""
    return pose @ torch.linalg.inv(first)


def _angle(rotation: Tensor) -> float:
    """Degrees; by its skew part, since the cosine alone turns an orthonormality of 1e-4 into half a degree."""
    sine = float((rotation - rotation.T).norm()) / (2 * math.sqrt(2))
    return math.degrees(math.atan2(sine, float((rotation.diagonal().sum() - 1) / 2)))


def camera_centre(pose: Tensor) -> Tensor:
    """Where the camera of a pose [4, 4] stands, [3]."""
    return -pose[:3, :3].T @ pose[:3, 3]


def _text(values: Tensor) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in values.tolist()) + ")"
