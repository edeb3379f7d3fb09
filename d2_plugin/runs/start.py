"""From a recording to what a trainer takes: views, images, the points that Gaussians start from."""

from __future__ import annotations

import io
import itertools
import warnings
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from d2_plugin.durable import opened_archive, write_archive
from d2_plugin.errors import D2Error, MissingExtra
from d2_plugin.hooks.prior import Belief, believed
from d2_plugin.priors.colmap.points import triangulate_frames
from d2_plugin.priors.geometry import projected
from d2_plugin.priors.stereo.depth_range import FEWEST
from d2_plugin.protocol import DepthPrior, View
from d2_plugin.reading import parsing
from d2_plugin.recordings import Recording
from d2_plugin.recordings.cameras.camera import focus_of
from d2_plugin.recordings.recording import Camera
from d2_plugin.recordings.selection import spread

POINTS_FORMAT = 1
"""Of points.npz."""

MIN_POINTS = 1000
"""Fewer triangulated points than this are filled up with random ones; more random ones cost quality."""

FROM_STEREO = 12_000
"""Points of a prior's stereo, at most, from which a run starts where hooks insert: right from the first step on, and
none as large as random ones."""

NEIGHBOURS = 3
"""Triangulated points of which a random one that a single camera sees takes the depth of one."""


@dataclass(frozen=True, eq=False)
class TimedPoints:
    """Coloured points, each at an instant: those that were triangulated, and those that Gaussians start from."""

    positions: np.ndarray  # [N, 3] float64, world
    colors: np.ndarray  # [N, 3] in 0..1
    times: np.ndarray  # [N] seconds since the first frame

    def __len__(self) -> int:
        return len(self.positions)

    @classmethod
    def joined(cls, parts: Sequence[TimedPoints]) -> TimedPoints:
        """The points of all parts, in their order."""
        together = [(part.positions, part.colors, part.times) for part in parts]
        return cls(*(np.concatenate(values) for values in zip(*together, strict=True)))

    def save(self, path: Path) -> None:
        """Write an .npz with one array per attribute; an existing file is replaced in one step."""
        content = io.BytesIO()
        np.savez(content, positions=self.positions, colors=self.colors, times=self.times, format=POINTS_FORMAT)
        write_archive(path, content)

    @classmethod
    def load(cls, path: Path) -> TimedPoints:
        """Read what `save` wrote.

        Raises:
            D2Error: the file is damaged or that of another version.
        """
        remedy = "delete the file, it will be made again"
        with opened_archive(path, "points", remedy) as file, parsing(f"points from {path}", remedy):
            stored = np.load(file, allow_pickle=False)
            form = stored["format"].tolist() if "format" in stored else None
            points = cls(stored["positions"], stored["colors"], stored["times"])
            problem = points.problem() if form == POINTS_FORMAT else f"format {form}, expected {POINTS_FORMAT}"
        if problem:
            raise D2Error(f"cannot read points from {path} ({problem}): {remedy}")
        return points

    def problem(self) -> str:
        """What is wrong with the arrays, or nothing."""
        count = len(self.times) if self.times.ndim == 1 else -1
        if self.positions.shape != (count, 3) or self.colors.shape != (count, 3):
            shapes = [array.shape for array in (self.positions, self.colors, self.times)]
            return f"shapes {shapes}, expected [(N, 3), (N, 3), (N,)]"
        arrays = (self.positions, self.colors, self.times)
        return "" if all(np.isfinite(array).all() for array in arrays) else "numbers that are not finite"

    def tensors(self, device: torch.device | str = "cpu") -> tuple[Tensor, Tensor, Tensor]:
        """Positions, colours and times in float32."""
        parts = (self.positions, self.colors, self.times)
        positions, colors, times = (torch.tensor(part, dtype=torch.float32, device=device) for part in parts)
        return positions, colors, times


def make_view(recording: Recording, camera: str, frame: int, device: torch.device | str = "cpu") -> View:
    """The view of one camera at one frame; time is in seconds since the first frame, as this camera took it."""
    calibration = recording.cameras[camera]
    pose = torch.tensor(calibration.T_camera_world, dtype=torch.float32, device=device)
    intrinsics = torch.tensor(calibration.K, dtype=torch.float32, device=device)
    time = recording.seconds(frame, camera)
    return View(camera, frame, time, pose, intrinsics, calibration.width, calibration.height)


KEPT_IMAGES = 320 << 20
"""Bytes of decoded images that training keeps: four cameras of 20 frames at 1352x1014. A longer recording takes no
more memory than that; what it re-reads is a small part of a step at its size."""


class TrainingFrames:
    """Views and images of the training cameras; decoded images are kept up to `KEPT_IMAGES`, the rest re-read."""

    def __init__(
        self,
        recording: Recording,
        cameras: Sequence[str],
        device: torch.device | str = "cpu",
        background_weight: float = 1.0,
    ) -> None:
        self.recording, self.device = recording, device
        self.background_weight = background_weight
        self._recorded = {camera: recording.recorded(camera) for camera in cameras}
        self.views = [make_view(recording, camera, frame, device) for frame in recording.frames for camera in cameras]
        self._kept: OrderedDict[int, np.ndarray] = OrderedDict()

    def image(self, index: int) -> Tensor:
        """Image [H, W, 3] in 0..1 of `views[index]`."""
        return self.image_bytes(index).float() / 255

    def image_bytes(self, index: int) -> Tensor:
        """The same as it is kept: uint8, 0..255."""
        view = self.views[index]
        if index not in self._kept:
            self._kept[index] = self.recording.image(view.camera, view.frame)
            while len(self._kept) > 1 and sum(kept.nbytes for kept in self._kept.values()) > KEPT_IMAGES:
                self._kept.popitem(last=False)
        else:
            self._kept.move_to_end(index)
        return torch.from_numpy(self._kept[index]).to(self.device)

    def recorded(self, index: int) -> Tensor | None:
        """Which pixels [H, W] of `views[index]` were recorded, bool; None where all were."""
        recorded = self._recorded[self.views[index].camera]
        return None if recorded is None else torch.from_numpy(recorded).to(self.device)

    def weights(self, index: int) -> Tensor | None:
        """How much each pixel [H, W] of `views[index]` counts: `background_weight` outside the foreground mask, 0 where
        nothing was recorded; None where all pixels count alike."""
        view = self.views[index]
        mask = self.recording.mask(view.camera, view.frame) if self.background_weight < 1 else None
        recorded = self._recorded[view.camera]
        if mask is None and recorded is None:
            return None
        weights: np.ndarray = np.ones((view.height, view.width))
        if mask is not None:
            weights = self.background_weight + (1 - self.background_weight) * mask
        if recorded is not None:
            weights = weights * recorded
        return torch.from_numpy(weights.astype(np.float32)).to(self.device)


@dataclass(frozen=True)
class Extent:
    """The size of a scene as the training cameras see it, world units."""

    near: float
    far: float
    radius: float
    """What learning rates and size limits of Gaussians are relative to."""


def scene_extent(recording: Recording, cameras: Sequence[str], *points: np.ndarray) -> Extent:
    """From the first of several sets of world points [P, 3] that the cameras see `FEWEST` times, else that they see ten
    times, else from declared bounds, else from where the cameras look.

    The radius is half the median depth: the spread of the cameras, which dense-rig code uses, says little about the
    scene when there are two of them.
    """
    poses = [recording.cameras[name].T_camera_world for name in cameras]
    seen = [np.concatenate([positions @ T[2, :3] + T[2, 3] for T in poses]) for positions in points]
    for least, depths in itertools.product((FEWEST, 10), seen):
        if np.count_nonzero(depths > 0) >= least:
            low, middle, high = np.percentile(depths[depths > 0], [1, 50, 99])
            return Extent(0.75 * float(low), 1.25 * float(high), 0.5 * float(middle))
    bounds = [near_far for name in cameras if (near_far := recording.cameras[name].near_far) is not None]
    if bounds:
        near, far = min(b[0] for b in bounds), max(b[1] for b in bounds)
        return Extent(0.8 * near, 1.2 * far, 0.5 * float(np.sqrt(near * far)))
    centres = np.stack([recording.cameras[name].centre for name in cameras])
    focus = focus_of(centres, np.stack([T[2, :3] for T in poses]))
    away = float(np.median(np.linalg.norm(centres - focus, axis=1)))
    return Extent(0.25 * away, 8 * away, 0.5 * away)


def initial_points(
    recording: Recording,
    cameras: Sequence[str],
    triangulated: TimedPoints,
    extent: Extent,
    seed: int = 0,
    minimum: int = MIN_POINTS,
) -> TimedPoints:
    """Where Gaussians start: the triangulated points, filled up to `minimum` with random ones.

    A random point lies on the ray of a random pixel of a random training image, at a depth drawn uniformly in
    inverse depth between near and far, and takes the pixel's colour. Where no other training camera would see it,
    nothing ever moves it to its depth, and held-out cameras see it beside its place: there it begins at the depth of
    what was triangulated around the pixel.
    """
    missing, rng, parts = max(minimum - len(triangulated), 0), np.random.default_rng(seed), [triangulated]
    for place, camera in enumerate(cameras):
        share = len(range(place, missing, len(cameras)))
        drawn = _random_points(recording, camera, extent, share, rng)
        others = [recording.cameras[name] for name in cameras if name != camera]
        parts.append(_seen_alone_beside(drawn, recording.cameras[camera], others, triangulated))
    return TimedPoints.joined(parts)


def _seen_alone_beside(
    drawn: TimedPoints, own: Camera, others: Sequence[Camera], triangulated: TimedPoints
) -> TimedPoints:
    """The points with those that no other camera sees at the depth of a triangulated one near by in the own image; as
    they are where the own camera sees too few of these."""
    shown, depths, seen = projected(own, triangulated.positions)
    pixels, _, _ = projected(own, drawn.positions)
    alone = ~np.any([projected(camera, drawn.positions)[2] for camera in others], axis=0) if others else None
    if alone is None or not alone.any() or np.count_nonzero(seen) < FEWEST:
        return drawn
    apart = np.linalg.norm(pixels[alone][:, None] - shown[seen][None], axis=-1)
    nearest = np.argsort(apart, axis=1)[:, :NEIGHBOURS]
    chosen = nearest[np.arange(len(nearest)), np.arange(len(nearest)) % NEIGHBOURS]
    positions = drawn.positions.copy()
    positions[alone] = own.world(pixels[alone], depths[seen][chosen])
    return replace(drawn, positions=positions)


def _random_points(
    recording: Recording, camera: str, extent: Extent, count: int, rng: np.random.Generator
) -> TimedPoints:
    calibration, frame = recording.cameras[camera], recording.frames[int(rng.integers(len(recording.frames)))]
    columns, rows = rng.integers(calibration.width, size=count), rng.integers(calibration.height, size=count)
    if (recorded := recording.recorded(camera)) is not None and recorded.any():
        rows, columns = rng.choice(np.argwhere(recorded), count).T  # elsewhere an undistorted image is black
    depth = 1 / rng.uniform(1 / extent.far, 1 / extent.near, count)
    times = rng.uniform(0, max(recording.seconds(recording.frames[-1]), 1e-9), count)
    return replace(_back_projected(recording, camera, frame, rows, columns, depth), times=times)


def _back_projected(
    recording: Recording, camera: str, frame: int, rows: np.ndarray, columns: np.ndarray, depth: np.ndarray
) -> TimedPoints:
    """Pixels [K] of an image at planar depths [K]."""
    positions = recording.cameras[camera].world(np.stack([columns, rows], -1) + 0.5, depth)
    colors = recording.image(camera, frame)[rows, columns] / 255
    return TimedPoints(positions, colors, np.full(len(rows), recording.seconds(frame, camera)))


def with_stereo(
    points: TimedPoints,
    recording: Recording,
    cameras: Sequence[str],
    prior: Callable[[str, int], DepthPrior | None],
    belief: Belief = "all",
    seed: int = 0,
    most: int = FROM_STEREO,
) -> TimedPoints:
    """The points, and up to `most` trusted pixels of what is believed of the priors, as many of each view at five
    instants."""
    views, rng = list(itertools.product(spread(recording.frames, 5), cameras)), np.random.default_rng(seed)
    parts = [points]
    for frame, camera in views:
        if (known := prior(camera, frame)) is not None:
            pixels = np.argwhere(believed(known, belief).trusted.numpy())
            rows, columns = rng.permutation(pixels)[: most // len(views)].T
            parts.append(_back_projected(recording, camera, frame, rows, columns, known.depth.numpy()[rows, columns]))
    return TimedPoints.joined(parts)


def triangulated_points(recording: Recording, cameras: Sequence[str]) -> TimedPoints:
    """Points triangulated with the known poses at up to five frames spread over the recording.

    There are none for a single camera, or where pycolmap is not installed; the latter gives a warning.
    """
    try:
        triangulated = triangulate_frames(recording, cameras, spread(recording.frames, 5))
    except MissingExtra as error:
        warnings.warn(f"{error}; Gaussians start from random points instead", stacklevel=2)
        return TimedPoints(np.zeros((0, 3)), np.zeros((0, 3), np.float32), np.zeros(0))
    times = np.array([recording.seconds(int(frame)) for frame in triangulated.frames], dtype=float)
    return TimedPoints(triangulated.positions, triangulated.colors, times)
