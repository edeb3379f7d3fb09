"""The instants between: what each training camera would have seen 1, 2 and 3 quarters of the way to its next instant.

Every pixel goes its part of the way, from the earlier instant forwards and from the later one back, on a curve where
flow follows it over the interval beside as well; what flies lies in front of fast regions, those in front of moving
pixels, and those in front of still ones. Where both accounts have colours that differ, motion is not known and the
pixel counts for nothing. D* comes along where something moves, so that surfaces can be inserted there.

All of it is made from finished priors, which keep their images, and lies beside them, sealed like them.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from d2_plugin.priors.flights import Observation, Passage, common_acceleration, join, link, passages, pixels_across
from d2_plugin.priors.geometry import projected
from d2_plugin.priors.limbs import limbs
from d2_plugin.priors.scene_flow import (
    FINE_WIDTH,
    STILL_INSTANTS,
    Region,
    dense_flow,
    followed,
    foreground,
    led_region,
    regions,
    still_image,
)
from d2_plugin.protocol import DepthPrior, Label
from d2_plugin.recordings.images import opencv
from d2_plugin.recordings.recording import Camera
from d2_plugin.recordings.selection import spread
from d2_plugin.store.files import EntryFolder, hash_of
from d2_plugin.store.maps import FusedPrior, empty_prior
from d2_plugin.store.store import QUARTERS, PriorStore

if TYPE_CHECKING:
    from d2_plugin.priors.flow_network import FlowNetwork

VERSION = 6
"""Of what is made from the same priors; raise it when that changes."""

MOVES = 0.6
"""A pixel moves whose flow is longer than so many pixels."""
CHANGED = 16
"""A channel, of 0 to 255, that differs by more than this from the next instant has changed."""
CONTRADICTS = 40
"""The two accounts of a pixel contradict each other if a channel differs by more than this."""
MOST_CHANGED = 0.5
"""Where more of an image changes, it is the light that changes, and nothing is known."""
LEAST_FOLLOWED = 0.4
"""Where less of what stands before the still image is followed, by flow or as a region, the instants lie too far apart:
nothing is known of the rectangle that holds it."""
LAYERS = (1e-3, 1.0, 30.0, 1e3)
"""Weights of still pixels, moving ones, regions and what flies where they meet: what moves lies in front."""
SMOOTH = 2.0
"""Pixels over which the curvature of flow is averaged, in an image of `FINE_WIDTH`."""
KEPT = 1 << 28
"""Bytes of flow that are kept until the regions of all cameras are known; other flow is made a second time."""
EXACT = 0.15
"""Largest sigma of the depth that places a region in the world."""
SURE = 2
"""Cameras in which a thing must be found that is looked for where it would have flown."""


Pair = tuple[np.ndarray, np.ndarray]


def build_between(
    store: PriorStore, progress: Callable[[int], None] = lambda done: None, network: FlowNetwork | None = None
) -> int:
    """Make what is missing of the instants between those of a store; after how many views they were made now.

    Nothing is made while a prior is missing, or where there are fewer than three frames. `progress` is called with the
    number of views that are done. Dense flow is that of `network`, or OpenCV's.

    Raises:
        CannotWrite: the disk is full, broken or not ours.
    """
    records = {(camera, frame): store.record(camera, frame) for camera in store.cameras for frame in store.frames}
    if len(store.frames) < 3 or None in records.values():
        return 0
    made = [[camera, frame, record["key"]] for (camera, frame), record in records.items() if record]
    key = hash_of(VERSION, made, *([] if network is None else [network.fingerprint]))
    pairs = list(zip(store.frames, store.frames[1:]))
    entries = itertools.product(store.between.values(), store.cameras, store.frames[:-1])
    if all(folder.find_current(camera, first, key) for folder, camera, first in entries):
        return 0
    cameras = [CameraMotion(store, name, network) for name in store.cameras]
    acceleration = follow(cameras) if cameras[0].even else None
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


def follow(cameras: Sequence[CameraMotion]) -> np.ndarray | None:
    """Find what flies in all cameras of a store with even frames; its acceleration [3], None where nothing falls."""
    count = len(cameras[0].regions)
    seen = [
        [
            observation._replace(camera=which)
            for which, camera in enumerate(cameras)
            for observation in camera.observations[index]
        ]
        for index in range(count)
    ]
    intervals = [passages([camera.camera for camera in cameras], observations) for observations in seen]
    link(intervals)
    fall = common_acceleration(intervals)
    if fall is None:
        return None
    flying = [[passage for passage in each if passage.flies(fall)] for each in intervals]
    for index, each in enumerate(flying):
        for passage in each:
            for observation in passage.observations:
                cameras[observation.camera].flying[index][observation.region] = passage
            seeing = {observation.camera for observation in passage.observations}
            for which, camera in enumerate(cameras):
                if len(seeing) > 1 and which not in seeing and (region := camera.led(index, passage)) is not None:
                    camera.add(index, region, passage)
    for step in (1, -1):
        for index in range(count)[::step]:
            for passage in flying[index]:
                if (passage.after if step > 0 else passage.before) is not None or not 0 <= index + step < count:
                    continue
                beyond = passage.beyond(step, fall)
                found = [(camera, region) for camera in cameras if (region := camera.led(index + step, beyond))]
                if len(found) >= SURE:
                    join(*(passage, beyond)[::step])
                    flying[index + step].append(beyond)
                    for camera, region in found:
                        camera.add(index + step, region, beyond)
    return fall


class _Interval(NamedTuple):
    """What one camera saw at both ends of an interval."""

    priors: tuple[DepthPrior, DepthPrior]
    images: Pair  # [H, W, 3] uint8
    flows: Pair  # [H, W, 2], to the other end
    follows: Pair  # bool [H, W], where flow is right


class CameraMotion:
    """One camera of a store, and the regions that dense flow loses in each interval."""

    def __init__(self, store: PriorStore, name: str, network: FlowNetwork | None = None) -> None:
        self.store, self.name, self.network = store, name, network
        self.even = len({b - a for a, b in zip(store.frames, store.frames[1:])}) == 1
        record = store.camera(name, store.frames[0])
        assert record is not None, "a prior of this version describes its camera"
        self._seen = functools.lru_cache(maxsize=4)(self._read)
        self.still = still_image([self._seen(frame)[1] for frame in spread(store.frames, STILL_INSTANTS)])
        height, width = self.still.shape[:2]
        self.camera = Camera(name, width, height, record.K.numpy(), record.T_camera_world.numpy())
        self.kept: dict[int, tuple[Pair, Pair]] = {}
        self.regions: list[list[Region]] = []
        self.flying: list[dict[int, Passage]] = []
        """Of each interval, what flies of its regions, by their number."""
        self.observations: list[list[Observation]] = []
        for index in range(len(store.frames) - 1):
            priors, images, flows, follows = self._ends(index)
            found = regions(*images, self.still, *flows)
            self.regions.append([*found, *limbs(images, self.still, flows, follows, found)])
            self.flying.append({})
            self.observations.append(
                [_observation(number, region, priors) for number, region in enumerate(found) if region.fast]
            )

    def underway(self, index: int, acceleration: np.ndarray | None) -> dict[int, FusedPrior]:
        """The view at each quarter of an interval; nothing of it is known where too much of the image changes."""
        cv2, (priors, images, flows, _) = opencv("scene flow"), self._ends(index)
        difference = np.maximum.reduce(cv2.split(cv2.absdiff(*images)))
        changed = difference > CHANGED
        if changed.mean() > MOST_CHANGED:
            unknown = np.full(changed.shape, Label.CONFLICT, np.uint8)
            return dict.fromkeys(QUARTERS, replace(empty_prior(changed.shape), labels=unknown, colors=images[0]))
        fronts = np.stack([foreground(image, self.still) for image in images])
        changed |= fronts.any(0)
        layers = [(np.hypot(flow[..., 0], flow[..., 1]) > MOVES).astype(np.uint8) for flow in flows]
        moving = self._moving(index)
        for region, passage in moving:
            layers[0].flat[region.start] = layers[1].flat[region.end] = 2 if passage is None else 3
        ends = [_Side(*side, 0.0) for side in zip(priors, images, flows, layers)]
        curves = self._curves(index)
        maps = changed, difference >= CONTRADICTS, images[0].astype(int) << 8 | images[1], self._lost(index, fronts)
        return {
            quarter: _composed(self._sides(ends, curves, moving, acceleration, quarter / 4), *maps)
            for quarter in QUARTERS
        }

    def _lost(self, index: int, fronts: np.ndarray) -> np.ndarray:
        """Where nothing is known of the way [H, W], since hardly anything of what is in front [2, H, W] is followed."""
        known, lost = np.stack(self._ends(index).follows), np.zeros(fronts.shape[1:], bool)
        for region in self.regions[index]:
            known[0].flat[region.start] = known[1].flat[region.end] = True
        if fronts.any() and known[fronts].mean() < LEAST_FOLLOWED:
            left, top, width, height = opencv("scene flow").boundingRect(fronts.any(0).view(np.uint8))
            lost[top : top + height, left : left + width] = True
        return lost

    def flow(self, index: int) -> np.ndarray:
        """How far each pixel goes from one instant of an interval to the next, [H, W, 2] pixels."""
        flow = self._ends(index).flows[0].copy()
        for region, _ in self._moving(index):
            flow.reshape(-1, 2)[region.start] = region.way(1.0)[0]
        return flow

    def led(self, index: int, passage: Passage) -> Region | None:
        """The region of something that other cameras see, where the images show it."""
        pixels, depth, _ = projected(self.camera, passage.ends)
        if not (depth > 0).all():
            return None
        radii = passage.radius * pixels_across(self.camera, passage.ends)
        return led_region(*self._ends(index).images, self.still, pixels, radii)

    def add(self, index: int, region: Region, passage: Passage) -> None:
        """One more region of something that flies."""
        self.flying[index][len(self.regions[index])] = passage
        self.regions[index].append(region)

    def _moving(self, index: int) -> list[tuple[Region, Passage | None]]:
        """The regions of an interval and what flies of them; of others, what flow does not follow or turns."""
        moving, follows = [], self._ends(index).follows
        for number, region in enumerate(self.regions[index]):
            passage = self.flying[index].get(number)
            if passage is None and region.turn == 0:
                start, end = (
                    pixels[~follow.flat[pixels]] for pixels, follow in zip((region.start, region.end), follows)
                )
                region = replace(region, start=start, end=end)
            moving.append((region, passage))
        return moving

    def _curves(self, index: int) -> list[np.ndarray]:
        """How much more each pixel of both ends would go in another interval [H, W, 2] pixels, where flow says it."""
        cv2, here = opencv("scene flow"), self._ends(index)
        curves = [np.zeros_like(flow) for flow in here.flows]
        if self.even:
            for end, beside in ((0, index - 1), (1, index + 1)):
                if 0 <= beside < len(self.regions):
                    other, flow = self._ends(beside), here.flows[end]
                    moves = np.hypot(flow[..., 0], flow[..., 1]) > MOVES
                    known = moves & here.follows[end] & other.follows[1 - end]
                    change = (flow + other.flows[1 - end]) * known[..., None]
                    width = SMOOTH * max(1.0, flow.shape[1] / FINE_WIDTH)
                    total, share = (
                        cv2.GaussianBlur(map_, (0, 0), width) for map_ in (change, moves.astype(np.float32))
                    )
                    curves[end] = total / np.maximum(share, 1e-3)[..., None]
        return curves

    def _sides(
        self,
        ends: Sequence[_Side],
        curves: Sequence[np.ndarray],
        moving: Sequence[tuple[Region, Passage | None]],
        acceleration: np.ndarray | None,
        part: float,
    ) -> list[_Side]:
        """Both instants of an interval, their pixels moved to where they are when that part of it has passed."""
        moved = [
            end._replace(steps=share * end.steps - part * (1 - part) / 2 * curve, weight=1 - share)
            for end, share, curve in zip(ends, (part, 1 - part), curves)
        ]
        for region, passage in moving:
            bend = np.zeros(2)
            if passage is not None and acceleration is not None:
                way = np.array([*passage.ends, passage.where(part, acceleration)])
                start, end, place = projected(self.camera, way)[0]
                bend = place - (1 - part) * start - part * end
            for side, pixels, way in zip(moved, (region.start, region.end), region.way(part)):
                side.steps.reshape(-1, 2)[pixels] = way + bend
        return moved

    def _ends(self, index: int) -> _Interval:
        """What was seen at both ends of an interval."""
        (prior, image), (next_prior, later) = (self._seen(frame) for frame in self.store.frames[index : index + 2])
        kept = self.kept.get(index)
        if kept is None:
            first, second = self.store.frames[index : index + 2]
            flow, back = self._flow(first, second), self._flow(second, first)
            kept = (flow, back), (followed(image, later, flow, back), followed(later, image, back, flow))
            if len(self.store.cameras) * (index + 1) * 2 * flow.nbytes < KEPT:
                self.kept[index] = kept
        return _Interval((prior, next_prior), (image, later), *kept)

    def _flow(self, frame: int, other: int) -> np.ndarray:
        """Dense flow [H, W, 2] from one frame to the one before it or behind it."""
        images = self._seen(frame)[1], self._seen(other)[1]
        if self.network is None:
            return dense_flow(*images)
        kept = EntryFolder(self.store.path / "cache" / "flow" / ("on" if other > frame else "back"), synced=False)
        return self.network.kept(kept, self.name, frame, *images)

    def _read(self, frame: int) -> tuple[DepthPrior, np.ndarray]:
        prior = self.store.prior(self.name, frame)
        assert prior is not None, "checked before"
        assert prior.colors is not None, "a store keeps them"
        return prior, prior.colors.numpy()


def _observation(number: int, region: Region, priors: Sequence[DepthPrior]) -> Observation:
    """Where a region of an interval is seen at both ends, with the median of its depth there."""
    ends, depths = [], []
    for pixels, prior in zip((region.start, region.end), priors):
        rows, columns = np.unravel_index(pixels, region.shape)
        depth = prior.depth.numpy()[rows, columns]
        exact = depth > 0 if prior.sigma is None else (depth > 0) & (prior.sigma.numpy()[rows, columns] < EXACT)
        ends.append([columns.mean() + 0.5, rows.mean() + 0.5])
        depths.append(np.median(depth[exact]) if exact.sum() >= 4 else np.nan)
    return Observation(0, number, np.array(ends), region.radius, np.array(depths))


class _Side(NamedTuple):
    """One of the two instants: what its pixels are, how far each goes, and how much it counts for being near."""

    prior: DepthPrior
    image: np.ndarray  # [H, W, 3]
    steps: np.ndarray  # [H, W, 2] pixels
    layer: np.ndarray  # [H, W] index into LAYERS
    weight: float


def _composed(
    sides: Sequence[_Side], changed: np.ndarray, unlike: np.ndarray, pairs: np.ndarray, lost: np.ndarray
) -> FusedPrior:
    """The image from both instants' accounts, with the depth of what moves; `changed` [H, W] says where, `lost` [H, W]
    where neither account counts.

    Where the weight is that of still pixels alone, and these are not `unlike` [H, W], the colours are looked up by
    `pairs` [H, W, 3]: 256 times the earlier one, and the later one.
    """
    accounts = [_account(side) for side in sides]
    mixed = unlike | (accounts[0][3] != LAYERS[0]) | (accounts[1][3] != LAYERS[0])
    accounts = [2 * side.weight * account[:, mixed] for side, account in zip(sides, accounts)]
    colors = [account[:3] / np.maximum(account[3], 1e-9) for account in accounts]
    least, differ = np.minimum(accounts[0][3], accounts[1][3]), np.zeros(changed.shape, np.float32)
    # A region that was found back, and so weighs much, is there whatever its colours: a ball spins. What flies is there
    # as other cameras see it.
    most = np.maximum(accounts[0][3], accounts[1][3])
    compared = (least > 1e-2 * LAYERS[0]) & (least <= 0.1 * LAYERS[2]) & (most <= 0.1 * LAYERS[3])
    differ[mixed] = compared & (np.abs(colors[0] - colors[1]).max(0) > CONTRADICTS)
    together = accounts[0] + accounts[1]
    unknown = lost | (opencv("scene flow").blur(differ, (3, 3)) > 0.3)
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
