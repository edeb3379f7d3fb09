"""A small furnished room with things that move: rendered exactly, with true depth and emulated monocular maps.

Cameras stand on an arc and look at the middle of the room. `train0`, `train1`, ... are evenly spaced; `test0`, ...
stand between them, a little higher or lower, and are meant to be held out. The brick wall and the floor are well
textured, the plaster walls at the sides are not: stereo must fail there, as it does in real rooms.

The monocular maps are EMULATED: exact inverse depth with blurred edges, times a smooth local bias, then a random scale
and shift per frame. They stand for a network's output, and `Recording.mono_emulated` says so.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache, partial

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.recordings.cameras.camera import look_at, pinhole
from d2_plugin.recordings.recording import Camera, Recording, Source
from d2_plugin.recordings.synthetic import materials
from d2_plugin.recordings.synthetic.raycast import Room, Scene, Solid, render_color, render_depth
from d2_plugin.values import checked_arguments

CACHE_BYTES = 64 * 2**20  # images kept after rendering them, oldest forgotten first
TARGET = np.array([0.0, 0.1, 0.75])  # world point (metres, z up) that every camera looks at

ROOM_LOW, ROOM_HIGH = np.array([-2.6, -5.0, 0.0]), np.array([2.6, 2.0, 2.9])
"""Corners of the room; the cameras stand inside."""

EDGE_BLUR = 0.006
"""Of an emulated monocular map: the standard deviation of its blur, as a fraction of the image's width."""

FIXED_BIAS, FRAME_BIAS = 0.07, 0.03
"""Its relative local bias, standard deviation: the same in all frames of a camera, and drawn anew for every frame."""

SCALE, SHIFT = (4.0, 16.0), (-1.0, 2.0)
"""Ranges of its random scale, and of the shift that is added after scaling, of a frame."""


@checked_arguments
def synthetic_recording(
    cameras: int = 4,
    held_out: int | None = None,
    frames: int = 10,
    width: int = 240,
    height: int = 135,
    seed: int = 0,
    fps: float = 12.0,
    arc_degrees: float = 50.0,
    moving: bool = True,
) -> Recording:
    """The recording of `d2 demo`; the same arguments give the same images.

    Args:
        cameras: number of training cameras, `train0` and on, spread over `arc_degrees`.
        held_out: number of cameras `test0` and on, between the training cameras; one per gap by default.
        frames: number of frames, at `fps` per second; the motion is periodic, so any number makes sense.
        width, height: pixels of every image.
        seed: of textures and of the emulated maps.
        moving: False stops the ball and the toy where they are at time 0.
    """
    held_out = max(cameras - 1, 0) if held_out is None else held_out
    if cameras < 1 or held_out < 0 or frames < 1 or min(width, height) < 8 or not fps > 0:
        raise D2Error(
            f"a synthetic recording of {cameras}+{held_out} cameras, {frames} frames, {width}x{height} pixels at "
            f"{fps:g} fps is not possible: give at least one camera and frame, 8x8 pixels and fps above 0"
        )
    placed = arc_cameras(cameras, held_out, width, height, arc_degrees)
    source = SyntheticSource(furnished_room(seed, moving), placed, fps, seed)
    return Recording(
        name="synthetic",
        cameras=placed,
        frames=tuple(range(frames)),
        fps=fps,
        source=source,
        mono_kind="relative",
        mono_emulated=True,
        notes=("rendered, not recorded",),
    )


def split(recording: Recording) -> tuple[list[str], list[str]]:
    """(training cameras, held-out cameras) of a synthetic recording, by their names."""
    train = [name for name in recording.cameras if name.startswith("train")]
    return train, [name for name in recording.cameras if name not in train]


def arc_cameras(cameras: int, held_out: int, width: int, height: int, arc_degrees: float) -> dict[str, Camera]:
    """Cameras 4 m from the target on an arc; held-out ones in the middle of the gaps, 12 cm higher or lower."""
    angles = np.radians(arc_degrees) * (np.linspace(0, 1, cameras) - 0.5 if cameras > 1 else np.zeros(1))
    between = np.radians(arc_degrees) * ((np.arange(held_out) + 0.5) / max(held_out, 1) - 0.5)
    placed = {f"train{i}": _look_at(f"train{i}", angle, 1.45, width, height) for i, angle in enumerate(angles)}
    for i, angle in enumerate(between):
        placed[f"test{i}"] = _look_at(f"test{i}", angle, 1.45 + 0.12 * (-1) ** i, width, height)
    return placed


@lru_cache(maxsize=4)
def furnished_room(seed: int, moving: bool) -> Scene:
    """Brick wall, plaster walls, plank floor, furniture, a rolling ball and a toy that turns while it travels."""
    rng = np.random.default_rng(seed)
    plaster = materials.plaster(rng)
    walls = ((plaster, plaster), (plaster, materials.bricks(rng)), (materials.planks(rng), plaster))
    room = Room(ROOM_LOW, ROOM_HIGH, walls)
    solids = (
        _box((1.55, 1.72, 0.95), (0.55, 0.26, 0.95), 0, materials.books(rng), 1.1),
        _box((-1.45, 1.1, 0.35), (0.35, 0.35, 0.35), 24, materials.crate(rng), 0.7),
        _box((-1.35, 1.12, 0.88), (0.2, 0.15, 0.18), -15, materials.confetti(rng, (0.2, 0.42, 0.38)), 0.6),
        _box((-0.2, 1.98, 1.55), (0.55, 0.015, 0.4), 0, materials.confetti(rng, (0.93, 0.9, 0.8)), 1.1),
        _box((0.1, 0.1, 0.008), (1.2, 0.8, 0.008), 0, materials.confetti(rng, (0.5, 0.16, 0.18), 120, muted=0.45), 1.2),
        Solid(partial(_rolling, moving), materials.beach_ball(rng), np.full(3, 0.27), radius=0.27),
        Solid(partial(_turning, moving), materials.confetti(rng, (0.92, 0.72, 0.16), 40), np.full(3, 0.2), repeat=0.4),
    )
    spread = 0.09 * np.array([(-1, -1, 0), (1, -1, 0), (-1, 1, 0), (1, 1, 0)])
    return Scene(room, solids, np.array([-0.9, -1.6, 2.75]) + spread)


@dataclass(eq=False)
class SyntheticSource(Source):
    """Renders an image or a map when it is asked for; images stay in a small cache."""

    scene: Scene
    cameras: dict[str, Camera]
    fps: float
    seed: int
    _cache: OrderedDict[tuple[str, str, int], np.ndarray] = field(default_factory=OrderedDict, repr=False)

    def image(self, camera: str, frame: int) -> np.ndarray:
        return self._kept("image", camera, frame, render_color)

    def depth(self, camera: str, frame: int) -> np.ndarray:
        return self._kept("depth", camera, frame, render_depth)

    def mono(self, camera: str, frame: int) -> np.ndarray:
        number = list(self.cameras).index(camera)
        depth = self.depth(camera, frame)
        fixed = np.random.default_rng([self.seed, 1, number])
        changing = np.random.default_rng([self.seed, 2, number, frame])
        bias = FIXED_BIAS * smooth_field(fixed, depth.shape) + FRAME_BIAS * smooth_field(changing, depth.shape)
        scale, shift = changing.uniform(*SCALE), changing.uniform(*SHIFT)
        inverse = blurred(1 / depth.astype(np.float64), EDGE_BLUR * depth.shape[1])
        return (scale * inverse * (1 + bias) + shift).astype(np.float32)

    def _kept(
        self, what: str, camera: str, frame: int, render: Callable[[Scene, Camera, float], np.ndarray]
    ) -> np.ndarray:
        key = (what, camera, frame)
        if key not in self._cache:
            self._cache[key] = render(self.scene, self.cameras[camera], frame / self.fps)
            while sum(array.nbytes for array in self._cache.values()) > CACHE_BYTES and len(self._cache) > 1:
                self._cache.popitem(last=False)
        return self._cache[key].copy()


def _look_at(name: str, angle: float, camera_height: float, width: int, height: int, distance: float = 4.0) -> Camera:
    centre = TARGET + distance * np.array([math.sin(angle), -math.cos(angle), 0.0])
    centre[2] = camera_height
    pose, focal = look_at(centre, TARGET, np.array([0.0, 0.0, 1.0])), 0.85 * width
    farthest = np.maximum(pose[2, :3] * (ROOM_LOW - centre), pose[2, :3] * (ROOM_HIGH - centre)).sum()
    return Camera(name, width, height, pinhole(focal, focal, width / 2, height / 2), pose, (1.0, float(farthest)))


def _box(
    centre: tuple[float, float, float],
    half_size: tuple[float, float, float],
    degrees: float,
    texture: np.ndarray,
    repeat: float,
) -> Solid:
    pose = (_about_z(math.radians(degrees)), np.array(centre))
    return Solid(lambda seconds: pose, texture, np.array(half_size), repeat=repeat)


def _rolling(moving: bool, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    radius, amplitude, period = 0.27, 0.85, 4.0
    x = amplitude * math.sin(2 * math.pi * (seconds if moving else 0.0) / period - 0.6)
    angle = x / radius
    rolled = np.array([[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]])
    return rolled, np.array([x, -0.35, radius + 0.016])


def _turning(moving: bool, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    phase = 2 * math.pi * (seconds if moving else 0.0) / 5.0
    centre = np.array([0.55 * math.cos(phase), 0.55 + 0.3 * math.sin(phase), 0.75 + 0.15 * math.sin(2 * phase)])
    return _about_z(1.5 * math.sin(phase)), centre


def _about_z(angle: float) -> np.ndarray:
    return np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])


def smooth_field(rng: np.random.Generator, shape: tuple[int, ...], cells: int = 4) -> np.ndarray:
    """Random field [H, W] of about unit variance with `cells` bumps across, from a few cosines."""
    v, u = (np.arange(size) / size for size in shape)
    waves = rng.uniform(-cells / 2, cells / 2, (12, 2))
    phases = rng.uniform(0, 2 * math.pi, 12)
    turns = waves[:, 0, None, None] * u[None, None, :] + waves[:, 1, None, None] * v[None, :, None]
    return np.cos(2 * math.pi * turns + phases[:, None, None]).sum(axis=0) / math.sqrt(6)


def blurred(values: np.ndarray, sigma: float) -> np.ndarray:
    """Gaussian blur of [H, W] with edge values repeated."""
    reach = max(1, math.ceil(3 * sigma))
    taps = np.exp(-0.5 * (np.arange(-reach, reach + 1) / max(sigma, 1e-6)) ** 2)
    taps /= taps.sum()
    for axis in (0, 1):
        padded = np.pad(values, [(reach, reach) if axis == side else (0, 0) for side in (0, 1)], mode="edge")
        length = values.shape[axis]
        values = sum(tap * np.take(padded, range(i, i + length), axis) for i, tap in enumerate(taps))
    return values
