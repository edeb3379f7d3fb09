"""What is checked once, before work begins: calibrations that contradict the images, empty images and masks.

What is impossible is refused where it is read. This notes what is possible and nearly always a mistake:
fields of view and positions out of the ordinary, cameras that see nothing that another one sees, images of one
colour, and rigs whose epipolar lines miss the features that two images share. Maps of true depth that cannot be read
are refused here already, not after the training that they are to score.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.recordings.cameras.calibrating.features import Features, find_features, match_all
from d2_plugin.recordings.cameras.calibration import LARGE_RIG
from d2_plugin.recordings.cameras.camera import field_of_view, rig_width, same_spot
from d2_plugin.recordings.cameras.epipolar import sampson
from d2_plugin.recordings.images import opencv
from d2_plugin.recordings.recording import Camera, Recording
from d2_plugin.recordings.selection import spread

USUAL_VIEW = (5.0, 170.0)  # degrees across or down that a camera usually sees
USUAL_RATE = 0.2, 5000.0  # frames per second
FAR_FROM_ORIGIN = 1e4  # A rig this many times as far from the origin as it is wide loses digits in float32

DEPTHS = np.geomspace(0.05, 1000, 25)
"""Where cameras without declared bounds may see the same thing, in widths of the rig."""

GRID = 12  # pixels across and down that stand for an image
NEARLY_BLACK = 16  # levels of 255 that 12 bits reach in a PNG of 16, and that masks of 0 and 1 do not
ONE_COLOUR = 2  # an image whose channels vary by no more levels of 255 than this shows nothing
NEARLY = f"nearly black, at most {NEARLY_BLACK} of 255,"
STRETCH = "white is 255, in a PNG of 16 bits 65535, so write numbers of 10 or 12 bits in full range"
SPARSE = 8  # where every eighth pixel each way varies, the others need not be asked

LOOKED_AT = 1 << 25
"""Pixels that are read, at most: all images of a small recording, some of each camera of a large one."""

LONG_SIDE = 640  # features are looked for in images of at most this many pixels along the longer side
MOST_PAIRS = 12  # pairs of cameras whose features are matched, at most
ENOUGH = 18  # matches on one geometry, any, below which two images say nothing: false matches reach 14
MOST_SWAPPED = 6  # cameras of a recording in which two that were swapped are looked for
MISSED = 0.007  # Sampson's distance, its median, in diagonals of the image, beyond which a calibration is named


class _Pair(NamedTuple):
    """Two cameras whose images share features, and the median of Sampson's distance in pixels."""

    one: str
    other: str
    distance: float
    missed: bool
    matches: int  # that say so


def check_recording(recording: Recording, cameras: Sequence[str], scored: Sequence[str] = ()) -> tuple[str, ...]:
    """What is most likely wrong with the named cameras of a recording, a sentence each; usually nothing.

    `scored` are those whose true depth will be read as well.

    Raises:
        D2Error: an image or a map that cannot be read, among those read.
    """
    rig = [recording.cameras[name] for name in cameras]
    for name in scored:
        for frame in _frames(recording, len(scored)):
            recording.depth(name, frame)
    masks = _empty_masks(recording, cameras, _frames(recording, len(cameras)))
    seen = (*_views(rig), *_origin(rig), *_units(recording, rig), *_alone(rig), *_plain(recording, cameras), *masks)
    said = _missed(_checked(recording, _features(recording, cameras)))
    return (*seen, said) if said else seen


def check_background_weight(recording: Recording, cameras: Sequence[str], weight: float) -> tuple[str, ...]:
    """Which images a weight below 1 leaves whole, since they have no foreground mask, a sentence for each camera.

    Raises:
        D2Error: that is all of those that are read.
    """
    if weight >= 1:
        return ()
    read = _frames(recording, len(cameras))
    without = {name: [frame for frame in read if recording.mask(name, frame) is None] for name in cameras}
    if all(len(frames) == len(read) for frames in without.values()):
        raise D2Error(
            f"--background-weight is {weight:g} and {recording.name} has no foreground mask: put masks at "
            "masks/CAMERA/FRAME.png, or leave the weight at 1"
        )
    return tuple(
        f"camera {name} has no foreground mask at frame {_some(frames)}: all of such an image is trained"
        for name, frames in without.items()
        if frames
    )


def _views(rig: Sequence[Camera]) -> Iterator[str]:
    for camera in rig:
        across, down = field_of_view(camera.K, (camera.width, camera.height))
        if max(across, down) < USUAL_VIEW[0] or max(across, down) > USUAL_VIEW[1]:
            yield (
                f"camera {camera.name} sees {across:.3g} x {down:.3g} degrees, expected {USUAL_VIEW[0]:g} to "
                f"{USUAL_VIEW[1]:g}: are its focal lengths in pixels of these images?"
            )
        if not (0 <= camera.K[0, 2] <= camera.width and 0 <= camera.K[1, 2] <= camera.height):
            yield f"the principal point of camera {camera.name} lies outside of its image: check cx and cy"


def _origin(rig: Sequence[Camera]) -> Iterator[str]:
    centres = np.stack([camera.centre for camera in rig])
    width = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())
    distance = float(np.linalg.norm(centres, axis=1).min())
    apart = any(not same_spot(rig[0], other) for other in rig)
    apart |= len(rig) > 1 and distance > 10 * FAR_FROM_ORIGIN  # so far away it is digits that make them one spot
    if apart and distance > FAR_FROM_ORIGIN * width:
        said = (
            f"the cameras stand {distance:.3g} from the origin and {width:.3g} from their middle: positions lose "
            "digits in float32, so move the origin to the scene"
        )
        if distance > 10 * FAR_FROM_ORIGIN * width:  # a step of float32 is a hundredth of the rig: pixels
            raise D2Error(said)
        yield said


def _units(recording: Recording, rig: Sequence[Camera]) -> Iterator[str]:
    """Units in which things move by much more or less than a unit of length in one of time: they are learnt worse."""
    if (width := rig_width(rig)) > LARGE_RIG:
        yield f"the cameras stand up to {width:.3g} apart: what moves is learnt worse in such units, so give metres"
    if len(recording.frames) > 1 and not USUAL_RATE[0] <= recording.rate <= USUAL_RATE[1]:
        yield (
            f"there are {recording.rate:.3g} frames per unit of time, expected {USUAL_RATE[0]:g} to {USUAL_RATE[1]:g}: "
            "give seconds, or minutes of a time lapse, since the scene is learnt worse so"
        )


def _alone(rig: Sequence[Camera]) -> Iterator[str]:
    """Cameras that see nothing that another one sees, at any depth."""
    centres = np.stack([camera.centre for camera in rig])
    width = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max()) or 1.0
    for camera in rig:
        near, far = camera.near_far or (0.0, np.inf)
        depths = np.clip(DEPTHS * width, near, far)
        if len(rig) > 1 and not any(_shares(camera, other, depths) for other in rig if other is not camera):
            yield f"camera {camera.name} sees nothing that another camera sees: check its R and t"


def _shares(one: Camera, other: Camera, depths: np.ndarray) -> bool:
    """Whether anything in the image of `one`, at one of the depths, lies in that of `other`."""
    steps = (np.arange(GRID) + 0.5) / GRID
    pixels = np.stack(np.meshgrid(steps * one.width, steps * one.height), -1)
    points = one.world(pixels, depths[:, None, None])
    seen = (points @ other.T_camera_world[:3, :3].T + other.T_camera_world[:3, 3]) @ other.K.T
    depth = seen[..., 2:]
    inside = (seen[..., :2] >= 0) & (seen[..., :2] <= depth * (other.width, other.height)) & (depth > 0)
    return bool(inside.all(axis=-1).any())


def _frames(recording: Recording, cameras: int) -> tuple[int, ...]:
    pixels = max(camera.width * camera.height for camera in recording.cameras.values())
    count = min(max(LOOKED_AT // (pixels * max(cameras, 1)), 2), len(recording.frames))
    return tuple(spread(recording.frames, count))


def _plain(recording: Recording, cameras: Sequence[str]) -> Iterator[str]:
    for name in cameras:
        blank: dict[str, list[int]] = {}
        for frame in _frames(recording, len(cameras)):
            image = recording.image(name, frame)
            if all(np.ptp(part, axis=(0, 1)).max() <= ONE_COLOUR for part in (image[::SPARSE, ::SPARSE], image)):
                blank.setdefault("black" if image.max() <= ONE_COLOUR else "of one colour", []).append(frame)
            elif image.max() <= NEARLY_BLACK:
                blank.setdefault(NEARLY, []).append(frame)
        for what, frames in blank.items():
            remedy = STRETCH if what == NEARLY else "nothing can be learned from that"
            yield f"camera {name} is {what} at frame {_some(frames)}: {remedy}"


def _some(frames: Sequence[int]) -> str:
    return ", ".join(map(str, frames[:5])) + (", ..." if len(frames) > 5 else "")


def _empty_masks(recording: Recording, cameras: Sequence[str], frames: Sequence[int]) -> Iterator[str]:
    """Foreground masks without foreground, or of 0 and 1, among the frames that are read, a sentence for each camera.

    Raises:
        D2Error: a camera of which nothing was recorded, or a mask that cannot be read.
    """
    for name in cameras:
        recorded = recording.recorded(name)
        if recorded is not None and not recorded.any():
            raise D2Error(
                f"nothing of camera {name} was recorded, as its mask in valid/ and its lens say: correct that mask, or "
                f"leave camera {name} out"
            )
        masks = {frame: recording.mask(name, frame) for frame in frames}
        highest = {frame: float(mask.max()) for frame, mask in masks.items() if mask is not None}
        empty = [frame for frame, most in highest.items() if most == 0]
        faint = [frame for frame, most in highest.items() if 0 < most <= NEARLY_BLACK / 255]
        for what, frames in (("empty", empty), ("nearly black", faint)):
            if frames:
                where = f"the foreground mask of camera {name} is {what} at frame {_some(frames)}"
                yield f"{where}: white, 255 of 255, counts as foreground"


def calibration_contradicted(recording: Recording) -> tuple[bool, str]:
    """(whether the calibration must be wrong, what `check_recording` says of it or whose swap would mend it; or "")."""
    features = _features(recording, recording.cameras)
    checked = _checked(recording, features)
    wrong = bool(_suspects(checked))
    swap = _swapped(recording, features) if wrong else None
    if swap is None:
        return wrong, _missed(checked)
    return wrong, f"cameras {swap[0]} and {swap[1]} are swapped: exchange their videos or their entries"


def _swapped(recording: Recording, features: Mapping[str, Features]) -> tuple[str, str] | None:
    """Two cameras of few whose calibrations, exchanged, miss nothing."""
    if not 2 < len(features) <= MOST_SWAPPED:
        return None
    for one, other in combinations(features, 2):
        a, b = recording.cameras[one], recording.cameras[other]
        exchanged = {one: replace(b, name=one), other: replace(a, name=other)}
        checked = _checked(replace(recording, cameras={**recording.cameras, **exchanged}), features)
        if checked and not any(pair.missed for pair in checked):
            return one, other
    return None


def _missed(checked: Sequence[_Pair]) -> str:
    wrong = [pair for pair in checked if pair.missed]
    listed = ", ".join(f"{pair.one} and {pair.other} by {pair.distance:.0f} pixels" for pair in wrong[:4])
    if not wrong:
        return ""
    suspects = _suspects(checked)
    if not suspects:
        return (
            f"the calibration misses features of {listed}, but not those of their other pairs, which are more: most "
            "likely a pattern that repeats, so it stands"
        )
    return (
        f"the calibration misses features that two images share, {listed}{', ...' if len(wrong) > 4 else ''} "
        f"(median; good calibrations miss by one): check R, t and K of {suspects}"
    )


def _checked(recording: Recording, features: Mapping[str, Features]) -> list[_Pair]:
    pairs = (_pair(recording, *pair, features) for pair in _neighbours(recording, features))
    return [pair for pair in pairs if pair is not None]


def _suspects(checked: Sequence[_Pair]) -> str:
    """The cameras that may be wrong; none where more matches of each speak for the calibration than against it."""
    against: Counter[str] = Counter()
    for pair in checked:
        for name in pair[:2]:
            against[name] += pair.matches if pair.missed else -pair.matches
    outweighed = sorted(name for name, matches in against.items() if matches > 0)
    if not outweighed:
        return ""
    # Whoever is in all missed pairs may be the only one. A turn can leave single pairs as they were, so the others'
    # good pairs clear nobody.
    any_one = set.intersection(*(set(pair[:2]) for pair in checked if pair.missed))
    if any_one:
        return f"camera {' or '.join(sorted(any_one))}"
    return f"cameras {' and '.join(outweighed)}" if 2 * len(outweighed) < len(against) else "these cameras"


def _neighbours(recording: Recording, cameras: Iterable[str]) -> list[tuple[str, str]]:
    """All pairs of a few cameras; of many, those that stand nearest to each other."""
    centres = {name: recording.cameras[name].centre for name in cameras}
    pairs = combinations(centres, 2)
    return sorted(pairs, key=lambda pair: float(np.linalg.norm(centres[pair[0]] - centres[pair[1]])))[:MOST_PAIRS]


def _features(recording: Recording, cameras: Iterable[str]) -> dict[str, Features]:
    """Of the first image of each camera, in pixels of the recording."""
    cv2 = opencv("checking a recording")
    features = {}
    for name in cameras:
        image = recording.image(name, recording.frames[0])
        factor = min(LONG_SIDE / max(image.shape[:2]), 1.0)
        small = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA) if factor < 1 else image
        found = find_features([small])
        features[name] = replace(found, pixels=found.pixels * image.shape[1::-1] / small.shape[1::-1])
    return features


def _pair(recording: Recording, one: str, other: str, features: Mapping[str, Features]) -> _Pair | None:
    """How far the calibration misses the features that two images share; None where they share too few.

    It misses them where another geometry explains more matches exactly than the calibration does roughly: patterns
    that repeat have a geometry of their own, but what the calibration explains is more.
    """
    cv2 = opencv("checking a recording")
    a, b = recording.cameras[one], recording.cameras[other]
    matches = match_all({one: features[one], other: features[other]})[one, other]
    if len(matches) < ENOUGH or np.allclose(a.centre, b.centre):
        return None
    p, q = features[one].pixels[matches[:, 0]], features[other].pixels[matches[:, 1]]
    diagonal = float(np.hypot(a.width, a.height))
    _, mask = cv2.findFundamentalMat(p, q, cv2.FM_RANSAC, max(diagonal / 500, 1.0), 0.999, 2000)
    inside = mask.ravel() > 0 if mask is not None else np.zeros(len(p), bool)
    if inside.sum() < ENOUGH:
        return None
    off, near = np.abs(sampson(a, b, p, q)), max(MISSED * diagonal, 3.0)
    distance, held = float(np.median(off[inside])), off < near
    missed = distance > near and inside.sum() > held.sum()
    return _Pair(one, other, distance, bool(missed), int((inside if missed else held).sum()))
