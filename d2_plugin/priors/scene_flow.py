"""Where what moves goes from one instant of a camera to its next: dense flow, and fast regions matched as wholes.

Dense flow (OpenCV's DIS) follows what moves by a few pixels. A small thing that moves by more than its own size, a
thrown ball, it does not find: such a region differs from the still background and is not explained by the flow at
either instant, and it is matched as a whole (here), as a limb that turns about its joint (`limbs`), or where other
cameras saw it fly (`flights`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from d2_plugin.recordings.images import opencv

FINE_WIDTH = 320
"""Flow is followed, and regions are searched, in images about as wide; a wider one gives the last pixels alone."""
FOREGROUND = 20
"""A channel, of 0 to 255, that differs by more than this from the still image shows something else."""
STILL_INSTANTS = 9
"""Of how many instants, evenly spread, the still image is the median."""
RETURNS = 1.5
"""Flow is believed where forward and backward flow cancel within so many pixels, and ..."""
RESEMBLES = 30
"""... where the blurred images differ by less than this there."""
SMALLEST = 8
"""Pixels of a region that is matched."""
UNFOLLOWED = 0.4
"""A foreground component of which flow does not follow this share is matched whole, of others the part it loses."""
REACH = 5
"""A region is searched within the image's width over this."""
LANDS_BESIDE = 40.0
"""What is added to a match's root mean square difference if none of it lands on foreground."""
WORST_MATCH, WORST_ALONE = 32.0, 45.0
"""Largest such cost of a match; of one that lands on a thing of its own size. A striped ball that turns costs 40."""
ALONE = 0.6
"""It does where it covers more than this share of the foreground components that it touches."""
WORST_LED, LED = 55.0, 0.3
"""The same of a thing that other cameras see, and how far it may be from where they say it goes, of its radius."""
FAST = 0.7
"""A region is fast that goes further than this many of its radii."""


def still_image(images: Sequence[np.ndarray]) -> np.ndarray:
    """What a camera sees where nothing moves, [H, W, 3] float32: the median of `STILL_INSTANTS` of its images."""
    return np.median(images, axis=0).astype(np.float32)


def foreground(image: np.ndarray, still: np.ndarray) -> np.ndarray:
    """Pixels [H, W] that differ from the still image, without specks."""
    cv2 = opencv("scene flow")
    differs = (np.maximum.reduce(cv2.split(np.abs(image - still))) > FOREGROUND).astype(np.uint8)
    closed = cv2.morphologyEx(differs, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    return opened(closed)


def opened(mask: np.ndarray) -> np.ndarray:
    """A mask [H, W] without what is less than two pixels wide."""
    cv2, square = opencv("scene flow"), np.ones((2, 2), np.uint8)
    # Its own opening would move it by a pixel, as the square has no middle.
    return np.asarray(cv2.dilate(cv2.erode(mask.view(np.uint8), square, anchor=(1, 1)), square, anchor=(0, 0)) > 0)


def dense_flow(image: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Optical flow [H, W, 2] (columns, rows) in pixels from one RGB image to another."""
    cv2, (height, width) = opencv("scene flow"), image.shape[:2]
    method = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    method.setFinestScale(round(math.log2(max(width / FINE_WIDTH, 1))))
    grays = [cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY) for rgb in (image, other)]
    # OpenCV refuses images of fewer than 12 pixels, and halves a wide one until it has no row left: the rim repeats.
    rim = 0, max(12, width // 16, height) - height, 0, max(12 - width, 0)
    if any(rim):
        grays = [cv2.copyMakeBorder(gray, *rim, cv2.BORDER_REPLICATE) for gray in grays]
    return np.asarray(method.calc(*grays, None)[:height, :width])


def followed(image: np.ndarray, other: np.ndarray, flow: np.ndarray, back: np.ndarray) -> np.ndarray:
    """Pixels [H, W] of `image` that the flow follows: `back` returns, and the colours are alike."""
    cv2 = opencv("scene flow")
    rows, columns = np.indices(flow.shape[:2], np.float32)
    target = columns + flow[..., 0], rows + flow[..., 1]
    there = [cv2.remap(values, *target, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for values in (back, other)]
    returns = np.sqrt(sum(component**2 for component in cv2.split(flow + there[0]))) < RETURNS
    differs = np.maximum.reduce(cv2.split(cv2.absdiff(image, there[1]))).astype(np.float32)
    return returns & (cv2.GaussianBlur(differs, (0, 0), 1) < RESEMBLES)


@dataclass(frozen=True, eq=False)
class Region:
    """What flow does not follow, matched as a whole between two instants of a camera."""

    start: np.ndarray  # int [n], its pixels at the earlier instant, as flat indices
    end: np.ndarray  # int [m], at the later one
    shift: np.ndarray  # [2] pixels (columns, rows); of the joint, if it turns
    cost: float
    shape: tuple[int, ...]
    turn: float = 0.0  # radians
    joint: complex = 0.0  # what it turns about at the earlier instant: column + row i

    @property
    def radius(self) -> float:
        """Of a disc as large, pixels."""
        return math.sqrt(len(self.start) / math.pi)

    @property
    def fast(self) -> bool:
        """Whether all of it goes further than its own size."""
        return self.turn == 0 and float(np.hypot(*self.shift)) > FAST * self.radius

    def way(self, part: float) -> tuple[np.ndarray, np.ndarray]:
        """How far each pixel has gone when a part of the time has passed, from the start [n, 2] and the end [m, 2]."""
        start, end = (_complex(pixels, self.shape) for pixels in (self.start, self.end))
        began = (end - self.joint - complex(*self.shift)) * np.exp(-1j * self.turn) + self.joint
        gone = self.path(start, part) - start, self.path(began, part) - end
        return gone[0].view(float).reshape(-1, 2), gone[1].view(float).reshape(-1, 2)

    def path(self, start: np.ndarray, part: float) -> np.ndarray:
        """Where points that begin at `start` are when a part of the time has passed; column + row i."""
        turned = np.exp(1j * self.turn * part) * (start - self.joint)
        return np.asarray(turned + self.joint + part * complex(*self.shift))


def _complex(pixels: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Column + row i of flat indices."""
    rows, columns = np.unravel_index(pixels, shape)
    return np.asarray(columns + 1j * rows)


def regions(
    earlier: np.ndarray, later: np.ndarray, still: np.ndarray, flow: np.ndarray, back: np.ndarray
) -> list[Region]:
    """The regions that are found at both instants, matched from either and confirmed from the other, best match last.

    Args:
        earlier, later: RGB images [H, W, 3] uint8.
        still: of the camera, see `still_image`.
        flow, back: dense flow from the earlier image to the later one, and back.
    """
    fronts = foreground(earlier, still), foreground(later, still)
    ends = [(image, front, *_small(image, front)) for image, front in zip((earlier, later), fronts)]
    matched: list[Region] = []
    for one, other, flows in ((*ends, (flow, back)), (*ends[::-1], (back, flow))):
        for mask in _pieces(one[1], one[1] & ~followed(one[0], other[0], *flows)):
            shift, cost = _match(one, other, mask)
            landed = _moved(mask, shift) & other[1]
            if np.hypot(*shift) < 3 or np.count_nonzero(landed) <= SMALLEST or cost > _worst_cost(landed, other[1]):
                continue
            back_again, _ = _match(other, one, landed)
            if np.abs(shift + back_again).sum() <= 3:
                here, there = np.flatnonzero(mask), np.flatnonzero(landed)
                start, end, way = (here, there, shift) if one is ends[0] else (there, here, -shift)
                matched.append(Region(start, end, way, cost, still.shape[:2]))
    return sorted(matched, key=lambda region: -region.cost)


def led_region(
    earlier: np.ndarray, later: np.ndarray, still: np.ndarray, ends: np.ndarray, radii: np.ndarray
) -> Region | None:
    """A thing of some radii [2] that other cameras see go from one pixel to another, `ends` [2, 2] (columns, rows).

    None where the images do not show it. Where it comes into the image, or leaves it, one end shows it.
    """
    rows, columns = np.indices(still.shape[:2]) + 0.5
    discs = [np.hypot(columns - end[0], rows - end[1]) <= radius for end, radius in zip(ends, radii)]
    whole = [bool(disc.sum() > max(0.8 * math.pi * radius**2, SMALLEST)) for disc, radius in zip(discs, radii)]
    fronts = foreground(earlier, still), foreground(later, still)
    if not any(whole) or any(
        front[disc].mean() < 0.5 for disc, front, all_of_it in zip(discs, fronts, whole) if all_of_it
    ):
        return None
    shift, cost = ends[1] - ends[0], WORST_LED
    if all(whole):
        reach = 2 + round(LED * float(radii[0]))
        shift, cost = _search(earlier, later, discs[0], fronts[1], np.rint(shift).astype(int), reach)
        discs[1] = _moved(discs[0], shift)
    start, end = (np.flatnonzero(disc & front) for disc, front in zip(discs, fronts))
    return Region(start, end, shift, cost, still.shape[:2]) if cost <= WORST_LED else None


def _moved(mask: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """A mask [H, W] that went a whole number of pixels."""
    return np.asarray(_window(mask.view(np.uint8), -shift, mask.shape[::-1]) > 0)


def _pieces(front: np.ndarray, unexplained: np.ndarray) -> Iterator[np.ndarray]:
    """The masks of what is to be matched: whole foreground components, or the unexplained parts of them."""
    cv2 = opencv("scene flow")
    unexplained = opened(unexplained)
    for component in components(front, SMALLEST):
        lost = unexplained & component
        share = np.count_nonzero(lost) / np.count_nonzero(component)
        if share > UNFOLLOWED:
            yield component
        elif share > 0:
            for part in components(lost, 20):
                yield (cv2.dilate(part.view(np.uint8), np.ones((5, 5), np.uint8)) > 0) & component


def _worst_cost(landed: np.ndarray, front: np.ndarray) -> float:
    """Of a match: more if what its pixels land on is a thing of their size, not part of a larger one."""
    labels = opencv("scene flow").connectedComponents(front.view(np.uint8))[1]
    touched = np.bincount(labels.ravel())[np.unique(labels[landed])].sum()
    return WORST_ALONE if np.count_nonzero(landed) > ALONE * touched else WORST_MATCH


def components(mask: np.ndarray, least: int) -> Iterator[np.ndarray]:
    """The connected parts [H, W] of a mask that have so many pixels."""
    count, labels, statistics, _ = opencv("scene flow").connectedComponentsWithStats(mask.view(np.uint8))
    return (labels == index for index in range(1, count) if statistics[index, 4] >= least)


def _small(*maps: np.ndarray) -> list[np.ndarray]:
    cv2, factor = opencv("scene flow"), max(1, round(maps[0].shape[1] / FINE_WIDTH))
    size = [max(length // factor, 1) for length in maps[0].shape[1::-1]]
    return [cv2.resize(map_.astype(np.float32), size, interpolation=cv2.INTER_AREA) for map_ in maps]


def _match(one: Sequence[np.ndarray], other: Sequence[np.ndarray], mask: np.ndarray) -> tuple[np.ndarray, float]:
    """The shift [2] at which the pixels of a mask look alike at the other instant and land on its foreground; its cost.

    An instant is its image and foreground, and both `_small`. The nearer of two equal matches is taken.
    """
    factor, reach = max(1, round(mask.shape[1] / FINE_WIDTH)), mask.shape[1] // REACH
    near, small = np.zeros(2, int), _small(mask)[0] > 0.5
    if factor > 1 and small.any():
        shift, _ = _search(one[2], other[2], small, other[3] > 0.5, near, reach // factor)
        near, reach = factor * shift.astype(int), factor
    return _search(one[0], other[0], mask, other[1], near, reach)


def _search(
    image: np.ndarray, other: np.ndarray, mask: np.ndarray, front: np.ndarray, near: np.ndarray, reach: int
) -> tuple[np.ndarray, float]:
    """The best shift [2] of those that differ from `near` by `reach` at most, and its cost."""
    cv2 = opencv("scene flow")
    left, top, width, height = cv2.boundingRect(mask.view(np.uint8))
    box = slice(top, top + height), slice(left, left + width)
    corner, size = np.array([left, top]) + near - reach, (width + 2 * reach, height + 2 * reach)
    colors, lands = (_window(map_, corner, size).astype(np.float32) for map_ in (other, front.view(np.uint8)))
    weight = mask[box].astype(np.float32)
    channels = np.repeat(weight[..., None], 3, 2)
    squares = cv2.matchTemplate(colors, image[box].astype(np.float32), cv2.TM_SQDIFF, mask=channels)
    beside = 1 - cv2.matchTemplate(lands, weight, cv2.TM_CCORR) / weight.sum()
    cost = np.sqrt(np.maximum(squares, 0) / (3 * weight.sum())) + LANDS_BESIDE * beside
    down, across = np.mgrid[-reach : reach + 1, -reach : reach + 1] + near[::-1, None, None]
    row, column = np.unravel_index(np.argmin(cost + 0.05 * np.hypot(down, across)), cost.shape)
    return np.array([across[row, column], down[row, column]], float), float(cost[row, column])


def _window(values: np.ndarray, corner: np.ndarray, size: tuple[int, ...]) -> np.ndarray:
    """The part of an image that begins at (column, row) and has a size (columns, rows); 0 beyond the image."""
    cv2, moving = opencv("scene flow"), np.array([[1, 0, -corner[0]], [0, 1, -corner[1]]], np.float32)
    return np.asarray(cv2.warpAffine(values, moving, size, flags=cv2.INTER_NEAREST))
