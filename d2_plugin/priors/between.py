"""The instants between: what each training camera would have seen 1, 2 and 3 quarters of the way to its next instant.

Every pixel goes its part of the way, from the earlier instant forwards and from the later one back; fast regions lie in
front of moving pixels, and those in front of still ones. Where both accounts have colours that differ, motion is not
known and the pixel counts for nothing. D* comes along where something moves, so that surfaces can be inserted there.

All of it is made from finished priors, which keep their images, and lies beside them, sealed like them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from d2_plugin.priors.scene_flow import (
    STILL_INSTANTS,
    Flight,
    Region,
    common_acceleration,
    dense_flow,
    foreground,
    regions,
    same_region,
    still_image,
)
from d2_plugin.protocol import CameraRecord, DepthPrior, Label
from d2_plugin.recordings.images import opencv
from d2_plugin.recordings.selection import spread
from d2_plugin.store.files import hash_of
from d2_plugin.store.maps import FusedPrior, empty_prior
from d2_plugin.store.store import QUARTERS, PriorStore

VERSION = 4
"""Of what is made from the same priors; raise it when that changes."""

MOVES = 0.6
"""A pixel moves whose flow is longer than so many pixels."""
CHANGED = 16
"""A channel, of 0 to 255, that differs by more than this from the next instant has changed."""
CONTRADICTS = 40
"""The two accounts of a pixel contradict each other if a channel differs by more than this."""
MOST_CHANGED = 0.5
"""Where more of an image changes, it is the light that changes, and nothing is known."""
LAYERS = (1e-3, 1.0, 30.0)
"""Weights of still pixels, moving ones and fast regions where they meet: what moves lies in front."""
EXACT = 0.15
"""Largest sigma of the depth that places a region in the world."""


def build_between(store: PriorStore, progress: Callable[[int], None] | None = None) -> int:
    """Make what is missing of the instants between those of a store; after how many views they were made now.

    Nothing is made while a prior is missing, or where there are fewer than three frames. `progress` is called with the
    number of views that are done.

    Raises:
        CannotWrite: the disk is full, broken or not ours.
    """
    records = {(camera, frame): store.record(camera, frame) for camera in store.cameras for frame in store.frames}
    if len(store.frames) < 3 or None in records.values():
        return 0
    key = hash_of(VERSION, [[camera, frame, record["key"]] for (camera, frame), record in records.items() if record])
    pairs = list(zip(store.frames, store.frames[1:]))
    entries = [
        (folder, camera, first) for folder in store.between.values() for camera in store.cameras for first, _ in pairs
    ]
    if all(folder.find_current(camera, first, key) for folder, camera, first in entries):
        return 0
    cameras = [CameraMotion(store, name) for name in store.cameras]
    even = len({second - first for first, second in pairs}) == 1
    flights = [flight for camera in cameras for interval in camera.flights for flight in interval if flight is not None]
    acceleration = common_acceleration(flights) if even else None
    done = 0
    with store.building(store.path):
        for camera in cameras:
            for index, (first, second) in enumerate(pairs):
                for quarter, seen in camera.underway(index, acceleration).items():
                    record = {"key": key, "next": second, "shares": seen.shares()}
                    store.write(camera.name, first, seen, record, store.between[quarter])
                done += 1
                if progress is not None:
                    progress(done)
    return done


class CameraMotion:
    """One camera of a store, and the regions that dense flow loses in each interval."""

    def __init__(self, store: PriorStore, name: str) -> None:
        self.store, self.name = store, name
        record = store.camera(name, store.frames[0])
        assert record is not None, "a prior of this version describes its camera"
        self.camera = record
        self.still = still_image([self._image(frame) for frame in spread(store.frames, STILL_INSTANTS)])
        self.regions: list[list[Region]] = []
        for first, second in zip(store.frames, store.frames[1:]):
            images = self._image(first), self._image(second)
            self.regions.append(regions(*images, self.still, *_flows(*images)))
        self.flights = [[self._flight(index, region) for region in each] for index, each in enumerate(self.regions)]

    def underway(self, index: int, acceleration: np.ndarray | None) -> dict[int, FusedPrior]:
        """The view at each quarter of an interval; nothing of it is known where too much of the image changes."""
        priors = [self._prior(frame) for frame in self.store.frames[index : index + 2]]
        images = [prior.colors.numpy() for prior in priors if prior.colors is not None]
        changed = (np.abs(np.subtract(*images, dtype=np.int16)) > CHANGED).any(-1)
        if changed.mean() > MOST_CHANGED:
            unknown = np.full(changed.shape, Label.CONFLICT, np.uint8)
            return dict.fromkeys(QUARTERS, replace(empty_prior(changed.shape), labels=unknown, colors=images[0]))
        for image in images:
            changed |= foreground(image, self.still)
        flows, bends = _flows(*images), [self._bend(flight, acceleration) for flight in self.flights[index]]
        return {quarter: _composed(self._sides(index, flows, bends, quarter / 4), changed) for quarter in QUARTERS}

    def flow(self, index: int) -> np.ndarray:
        """How far each pixel goes from one instant of an interval to the next, [H, W, 2] pixels."""
        flows = _flows(*(self._image(frame) for frame in self.store.frames[index : index + 2]))
        return self._sides(index, flows, [np.zeros(2)] * len(self.regions[index]), 1.0)[0].steps

    def _sides(self, index: int, flows: Sequence[np.ndarray], bends: Sequence[np.ndarray], part: float) -> list[_Side]:
        """Both instants of an interval, their pixels moved to where they are when that part of it has passed."""
        priors = [self._prior(frame) for frame in self.store.frames[index : index + 2]]
        sides = []
        for flow, which, prior, share in zip(flows, ("start", "end"), priors, (part, 1 - part)):
            steps, layer = share * flow, (np.hypot(flow[..., 0], flow[..., 1]) > MOVES).astype(np.uint8)
            for region, bend in zip(self.regions[index], bends):
                pixels = np.unravel_index(getattr(region, which), region.shape)
                way = region.shift if which == "start" else -region.shift
                steps[pixels] = share * way + 4 * part * (1 - part) * bend
                layer[pixels] = 2
            sides.append(_Side(prior, steps, layer, 1 - share))
        return sides

    def _flight(self, index: int, region: Region) -> Flight | None:
        """The region's way in the world, with that of the same region in the intervals beside; None without depth."""
        start, over = self._displacement(index, region)
        if over is None or start is None or not region.fast:
            return None
        before, after = None, None
        for other in self.regions[index - 1] if index else ():
            if same_region(other.end, region.start):
                before = self._displacement(index - 1, other)[1]
        for other in self.regions[index + 1] if index + 1 < len(self.regions) else ():
            if same_region(region.end, other.start):
                after = self._displacement(index + 1, other)[1]
        return Flight(start, over, before, after)

    def _displacement(self, index: int, region: Region) -> tuple[np.ndarray | None, np.ndarray | None]:
        """Where a region begins in the world [3], and how far it goes [3]; None where its depth is not known."""
        ends = zip((region.start, region.end), self.store.frames[index : index + 2])
        start, end = (_place(pixels, self._prior(frame), self.camera, region.shape) for pixels, frame in ends)
        return start, None if start is None or end is None else end - start

    def _bend(self, flight: Flight | None, acceleration: np.ndarray | None) -> np.ndarray:
        """How far the image [2] of a region halfway is from the middle of a straight line."""
        if flight is None or acceleration is None:
            return np.zeros(2)
        middle = flight.start + flight.over / 2
        return _pixel(middle + flight.bend(acceleration), self.camera) - _pixel(middle, self.camera)

    def _prior(self, frame: int) -> DepthPrior:
        prior = self.store.prior(self.name, frame)
        assert prior is not None, "checked before"
        return prior

    def _image(self, frame: int) -> np.ndarray:
        colors = self._prior(frame).colors
        assert colors is not None, "a store keeps them"
        return colors.numpy()


class _Side(NamedTuple):
    """One of the two instants: what its pixels are, how far each goes, and how much it counts for being near."""

    prior: DepthPrior
    steps: np.ndarray  # [H, W, 2] pixels
    layer: np.ndarray  # [H, W] index into LAYERS
    weight: float


def _flows(earlier: np.ndarray, later: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return dense_flow(earlier, later), dense_flow(later, earlier)


def _composed(sides: Sequence[_Side], changed: np.ndarray) -> FusedPrior:
    """The image from both instants' accounts, with the depth of what moves; `changed` [H, W] says where."""
    accounts = [2 * side.weight * _account(side) for side in sides]
    both = np.minimum(accounts[0][..., 3], accounts[1][..., 3]) > 1e-2 * LAYERS[0]
    colors = [account[..., :3] / np.maximum(account[..., 3:], 1e-9) for account in accounts]
    # A region that was found back is there, whatever its colours: a ball spins.
    found = np.minimum(accounts[0][..., 3], accounts[1][..., 3]) > 0.1 * LAYERS[2]
    differ = both & ~found & (np.abs(colors[0] - colors[1]).max(-1) > CONTRADICTS)
    together = accounts[0] + accounts[1]
    known = together[..., 3] > 0.1 * LAYERS[0]
    unknown = ~known | (opencv("scene flow").blur(differ.astype(np.float32), (3, 3)) > 0.3)
    depth, sigma, labels = _depths(sides)
    kept = (changed | (together[..., 3] > LAYERS[1] / 2)) & ~unknown & (depth > 0)
    image = np.rint(together[..., :3] / np.maximum(together[..., 3:], 1e-9)).astype(np.uint8)
    return FusedPrior(
        np.where(kept, depth, 0).astype(np.float32),
        np.where(unknown, np.uint8(Label.CONFLICT), np.where(kept, labels, np.uint8(Label.EMPTY))),
        np.where(kept, sigma, np.inf).astype(np.float32),
        image,
    )


def _account(side: _Side) -> np.ndarray:
    """Weighted colours and their weight [H, W, 4] of one side's pixels there, by linear splatting."""
    height, width = side.layer.shape
    rows, columns = np.nonzero(side.layer)
    assert side.prior.colors is not None
    colors = side.prior.colors.numpy().astype(np.float64)
    still = np.where(side.layer == 0, LAYERS[0], 0.0)[..., None]
    total = np.concatenate([colors * still, still], -1).reshape(-1, 4)
    x, y = columns + side.steps[rows, columns, 0], rows + side.steps[rows, columns, 1]
    values = np.concatenate([colors[rows, columns], np.ones((len(rows), 1))], 1)
    values *= np.array(LAYERS)[side.layer[rows, columns]][:, None]
    left, top = np.floor(x), np.floor(y)
    for column, row in ((0, 0), (0, 1), (1, 0), (1, 1)):
        share = (1 - np.abs(x - left - column)) * (1 - np.abs(y - top - row))
        inside = (left + column >= 0) & (left + column < width) & (top + row >= 0) & (top + row < height)
        place = ((top + row) * width + left + column)[inside].astype(np.int64)
        for channel in range(4):
            weights = (values[:, channel] * share)[inside]
            total[:, channel] += np.bincount(place, weights, minlength=height * width)
    return total.reshape(height, width, 4)


def _depths(sides: Sequence[_Side]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """D*, sigma and label [H, W] of what moves, each pixel carried to the nearest one; later layers win."""
    height, width = sides[0].layer.shape
    depth, labels = np.zeros((height, width)), np.zeros((height, width), np.uint8)
    sigma = np.full((height, width), np.inf)
    for layer in range(len(LAYERS)):
        for side in sides:
            known = (side.layer == layer) & (side.prior.depth.numpy() > 0)
            rows, columns = np.nonzero(known)
            step = np.rint(side.steps[rows, columns] * (layer > 0)).astype(int)
            column, row = columns + step[:, 0], rows + step[:, 1]
            inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
            to, source = (row[inside], column[inside]), (rows[inside], columns[inside])
            assert side.prior.sigma is not None
            depth[to], labels[to] = side.prior.depth.numpy()[source], side.prior.labels.numpy()[source]
            sigma[to] = side.prior.sigma.numpy()[source]
    return depth, sigma, labels


def _place(pixels: np.ndarray, prior: DepthPrior, camera: CameraRecord, shape: tuple[int, ...]) -> np.ndarray | None:
    """The world point [3] at the middle of some pixels (flat indices), at the median of their depth."""
    rows, columns = np.unravel_index(pixels, shape)
    depth = prior.depth.numpy()[rows, columns]
    exact = depth > 0 if prior.sigma is None else (depth > 0) & (prior.sigma.numpy()[rows, columns] < EXACT)
    if exact.sum() < 4:
        return None
    pose = camera.T_camera_world.numpy()
    ray = np.linalg.solve(camera.K.numpy(), [columns.mean() + 0.5, rows.mean() + 0.5, 1.0])
    point: np.ndarray = (ray * np.median(depth[exact]) - pose[:3, 3]) @ pose[:3, :3]
    return point


def _pixel(point: np.ndarray, camera: CameraRecord) -> np.ndarray:
    """Where a world point [3] is seen, (column, row)."""
    pose = camera.T_camera_world.numpy()
    seen = camera.K.numpy() @ (pose[:3, :3] @ point + pose[:3, 3])
    pixel: np.ndarray = seen[:2] / seen[2]
    return pixel
