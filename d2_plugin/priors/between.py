"""The instants between: what each training camera would have seen 1, 2 and 3 quarters of the way to its next instant.

Every pixel goes its part of the way, from the earlier instant forwards and from the later one back; fast regions lie in
front of moving pixels, and those in front of still ones. Where both accounts have colours that differ, motion is not
known and the pixel counts for nothing. D* comes along where something moves, so that surfaces can be inserted there.

All of it is made from finished priors, which keep their images, and lies beside them, sealed like them.
"""

from __future__ import annotations

import functools
import itertools
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
KEPT = 1 << 28
"""Bytes of flow that are kept until the regions of all cameras are known; other flow is followed a second time."""
EXACT = 0.15
"""Largest sigma of the depth that places a region in the world."""


def build_between(store: PriorStore, progress: Callable[[int], None] = lambda done: None) -> int:
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
    entries = itertools.product(store.between.values(), store.cameras, store.frames[:-1])
    if all(folder.find_current(camera, first, key) for folder, camera, first in entries):
        return 0
    cameras = [CameraMotion(store, name) for name in store.cameras]
    even = len({second - first for first, second in pairs}) == 1
    flights = [flight for camera in cameras for interval in camera.flights for flight in interval if flight is not None]
    acceleration = common_acceleration(flights) if even else None
    done = 0
    with store.building():
        while cameras:
            camera = cameras.pop(0)
            for index, (first, second) in enumerate(pairs):
                for quarter, seen in camera.underway(index, acceleration).items():
                    record = {"key": key, "next": second, "shares": seen.shares()}
                    store.write(camera.name, first, seen, record, store.between[quarter])
                done += 1
                progress(done)
    return done


class CameraMotion:
    """One camera of a store, and the regions that dense flow loses in each interval."""

    def __init__(self, store: PriorStore, name: str) -> None:
        self.store, self.name = store, name
        record = store.camera(name, store.frames[0])
        assert record is not None, "a prior of this version describes its camera"
        self.camera = record
        self._seen = functools.lru_cache(maxsize=4)(self._read)
        self.still = still_image([self._seen(frame)[1] for frame in spread(store.frames, STILL_INSTANTS)])
        self.regions: list[list[Region]] = []
        self.kept: dict[int, Sequence[np.ndarray]] = {}
        for index in range(len(store.frames) - 1):
            _, (earlier, later), (flow, back) = self._ends(index)
            self.regions.append(regions(earlier, later, self.still, flow, back))
        self.flights = [[self._flight(index, region) for region in each] for index, each in enumerate(self.regions)]
        self._seen.cache_clear()

    def underway(self, index: int, acceleration: np.ndarray | None) -> dict[int, FusedPrior]:
        """The view at each quarter of an interval; nothing of it is known where too much of the image changes."""
        cv2, (priors, images, flows) = opencv("scene flow"), self._ends(index)
        difference = np.maximum.reduce(cv2.split(cv2.absdiff(*images)))
        changed = difference > CHANGED
        if changed.mean() > MOST_CHANGED:
            unknown = np.full(changed.shape, Label.CONFLICT, np.uint8)
            return dict.fromkeys(QUARTERS, replace(empty_prior(changed.shape), labels=unknown, colors=images[0]))
        for image in images:
            changed |= foreground(image, self.still)
        layers = [(np.hypot(flow[..., 0], flow[..., 1]) > MOVES).astype(np.uint8) for flow in flows]
        for region in self.regions[index]:
            layers[0].flat[region.start] = layers[1].flat[region.end] = 2
        ends = [_Side(*side, 0.0) for side in zip(priors, images, flows, layers)]
        maps = changed, difference >= CONTRADICTS, images[0].astype(int) << 8 | images[1]
        return {quarter: _composed(self._sides(index, ends, acceleration, quarter / 4), *maps) for quarter in QUARTERS}

    def flow(self, index: int) -> np.ndarray:
        """How far each pixel goes from one instant of an interval to the next, [H, W, 2] pixels."""
        flow = self._ends(index)[2][0].copy()
        for region in self.regions[index]:
            flow.reshape(-1, 2)[region.start] = region.shift
        return flow

    def _sides(self, index: int, ends: Sequence[_Side], acceleration: np.ndarray | None, part: float) -> list[_Side]:
        """Both instants of an interval, their pixels moved to where they are when that part of it has passed."""
        parts = part, 1 - part
        moved = [end._replace(steps=share * end.steps, weight=1 - share) for end, share in zip(ends, parts)]
        for region, flight in zip(self.regions[index], self.flights[index]):
            bend = 4 * part * (1 - part) * self._bend(flight, acceleration)
            moved[0].steps.reshape(-1, 2)[region.start] = part * region.shift + bend
            moved[1].steps.reshape(-1, 2)[region.end] = (1 - part) * -region.shift + bend
        return moved

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
        start, end = (_place(pixels, self._seen(frame)[0], self.camera, region.shape) for pixels, frame in ends)
        return start, None if start is None or end is None else end - start

    def _bend(self, flight: Flight | None, acceleration: np.ndarray | None) -> np.ndarray:
        """How far the image [2] of a region halfway is from the middle of a straight line."""
        if flight is None or acceleration is None:
            return np.zeros(2)
        middle = flight.start + flight.over / 2
        return _pixel(middle + flight.bend(acceleration), self.camera) - _pixel(middle, self.camera)

    def _ends(self, index: int) -> tuple[Sequence[DepthPrior], Sequence[np.ndarray], Sequence[np.ndarray]]:
        """The priors at both ends of an interval, their images, and dense flow from either to the other."""
        priors, images = zip(*(self._seen(frame) for frame in self.store.frames[index : index + 2]))
        flows = self.kept.get(index) or (dense_flow(*images), dense_flow(*images[::-1]))
        if len(self.store.cameras) * (index + 1) * 2 * flows[0].nbytes < KEPT:
            self.kept[index] = flows
        return priors, images, flows

    def _read(self, frame: int) -> tuple[DepthPrior, np.ndarray]:
        prior = self.store.prior(self.name, frame)
        assert prior is not None, "checked before"
        assert prior.colors is not None, "a store keeps them"
        return prior, prior.colors.numpy()


class _Side(NamedTuple):
    """One of the two instants: what its pixels are, how far each goes, and how much it counts for being near."""

    prior: DepthPrior
    image: np.ndarray  # [H, W, 3]
    steps: np.ndarray  # [H, W, 2] pixels
    layer: np.ndarray  # [H, W] index into LAYERS
    weight: float


def _composed(sides: Sequence[_Side], changed: np.ndarray, unlike: np.ndarray, pairs: np.ndarray) -> FusedPrior:
    """The image from both instants' accounts, with the depth of what moves; `changed` [H, W] says where.

    Where the weight is that of still pixels alone, and these are not `unlike` [H, W], the colours are looked up by
    `pairs` [H, W, 3]: 256 times the earlier one, and the later one.
    """
    accounts = [_account(side) for side in sides]
    mixed = unlike | (accounts[0][3] != LAYERS[0]) | (accounts[1][3] != LAYERS[0])
    accounts = [2 * side.weight * account[:, mixed] for side, account in zip(sides, accounts)]
    colors = [account[:3] / np.maximum(account[3], 1e-9) for account in accounts]
    least, differ = np.minimum(accounts[0][3], accounts[1][3]), np.zeros(changed.shape, np.float32)
    # A region that was found back, and so weighs much, is there whatever its colours: a ball spins.
    compared = (least > 1e-2 * LAYERS[0]) & (least <= 0.1 * LAYERS[2])
    differ[mixed] = compared & (np.abs(colors[0] - colors[1]).max(0) > CONTRADICTS)
    together = accounts[0] + accounts[1]
    unknown = opencv("scene flow").blur(differ, (3, 3)) > 0.3
    unknown[mixed] |= together[3] <= 0.1 * LAYERS[0]
    kept, origin = changed.copy(), _origin(sides)
    kept[mixed] |= together[3] > LAYERS[1] / 2
    kept &= ~unknown & (origin >= 0)
    still = LAYERS[0] * np.arange(256)
    table = (2 * sides[0].weight * still[:, None] + 2 * sides[1].weight * still) / (2 * LAYERS[0])
    image = np.rint(table).astype(np.uint8).take(pairs)
    image[mixed] = np.rint(together[:3] / np.maximum(together[3], 1e-9)).T
    seen = replace(empty_prior(kept.shape), colors=image)
    for name, values in (("depth", seen.depth), ("sigma", seen.sigma), ("labels", seen.labels)):
        values[kept] = np.stack([getattr(side.prior, name) for side in sides]).take(origin[kept])
    seen.labels[unknown] = Label.CONFLICT
    return seen


def _account(side: _Side) -> np.ndarray:
    """Weighted colours and their weight [4, H, W] of one side's pixels there, by linear splatting."""
    height, width = side.layer.shape
    total = np.zeros((4, height + 3, width + 3))  # what leaves the image lands on its rim
    inner = total[:, 1:-2, 1:-2]
    inner[3] = np.where(side.layer == 0, LAYERS[0], 0.0)
    inner[:3] = np.moveaxis(side.image, -1, 0) * inner[3]
    rows, columns = np.nonzero(side.layer)
    values = np.vstack([side.image[rows, columns].T, np.ones(len(rows))]) * np.array(LAYERS)[side.layer[rows, columns]]
    x = np.clip(columns + side.steps[rows, columns, 0], -1, width)
    y = np.clip(rows + side.steps[rows, columns, 1], -1, height)
    left, top = np.floor(x), np.floor(y)
    for column, row in ((0, 0), (0, 1), (1, 0), (1, 1)):
        share = (1 - np.abs(x - left - column)) * (1 - np.abs(y - top - row))
        place = ((top + row + 1) * (width + 3) + left + column + 1).astype(np.int64)
        for plane, value in zip(total, values):
            plane += np.bincount(place, value * share, plane.size).reshape(plane.shape)
    return inner


def _origin(sides: Sequence[_Side]) -> np.ndarray:
    """The pixel of both sides' [2 H W] that is carried to each one [H, W], -1 where none is; later layers win."""
    height, width = sides[0].layer.shape
    origin = np.full(height * width, -1)
    for layer in range(len(LAYERS)):
        for index, side in enumerate(sides):
            pixels = target = np.flatnonzero((side.layer == layer) & (side.prior.depth.numpy() > 0))
            if layer > 0:
                rows, columns = np.divmod(pixels, width)
                column, row = np.rint(side.steps.reshape(-1, 2)[pixels]).astype(int).T + (columns, rows)
                inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
                pixels, target = pixels[inside], (row * width + column)[inside]
            origin[target] = index * origin.size + pixels
    return origin.reshape(height, width)


def _place(pixels: np.ndarray, prior: DepthPrior, camera: CameraRecord, shape: tuple[int, ...]) -> np.ndarray | None:
    """The world point [3] at the middle of some pixels (flat indices), at the median of their depth."""
    rows, columns = np.unravel_index(pixels, shape)
    depth = prior.depth.numpy()[rows, columns]
    exact = depth > 0 if prior.sigma is None else (depth > 0) & (prior.sigma.numpy()[rows, columns] < EXACT)
    if exact.sum() < 4:
        return None
    pose = camera.T_camera_world.numpy()
    ray = np.linalg.solve(camera.K.numpy(), [columns.mean() + 0.5, rows.mean() + 0.5, 1.0])
    return np.asarray((ray * np.median(depth[exact]) - pose[:3, 3]) @ pose[:3, :3])


def _pixel(point: np.ndarray, camera: CameraRecord) -> np.ndarray:
    """Where a world point [3] is seen, (column, row)."""
    pose = camera.T_camera_world.numpy()
    seen = camera.K.numpy() @ (pose[:3, :3] @ point + pose[:3, 3])
    return np.asarray(seen[:2] / seen[2])
