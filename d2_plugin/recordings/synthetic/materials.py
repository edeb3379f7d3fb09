"""Painted textures of the synthetic scene: periodic images [size, size, 3] in 0..1, looked up bilinearly.

They have structure at several scales, so that stereo and feature matching work, and one has almost none, so that they
must fail there as they do on a plain wall.
"""

from __future__ import annotations

import math

import numpy as np

SIZE = 256  # texels along each side of a texture


def sample(texture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Colours [3, R] of a periodic texture at `uv` [2, R], one repeat per unit."""
    size = texture.shape[0]
    position = (uv - np.floor(uv)) * size - 0.5
    corner = np.floor(position)
    right, down = (position - corner)[..., None]
    column, row = corner.astype(np.int64) % size
    row, next_row = row * size, (row + 1) % size * size
    next_column = (column + 1) % size
    texels = texture.reshape(-1, 3)

    def blend(start_of_row: np.ndarray) -> np.ndarray:
        left = np.take(texels, start_of_row + column, axis=0)
        return left + right * (np.take(texels, start_of_row + next_column, axis=0) - left)

    above = blend(row)
    return (above + down * (blend(next_row) - above)).T


def clouds(rng: np.random.Generator, finest: float, slope: float = 1.0, stretch: float = 1.0) -> np.ndarray:
    """Periodic noise [size, size] of unit variance whose amplitude falls as frequency ** -slope.

    `finest` is the shortest wavelength in texels; `stretch` elongates the pattern along the columns (wood grain).
    """
    frequency = np.fft.fftfreq(SIZE)
    radius = np.hypot(frequency[:, None], frequency[None, :] * stretch)
    radius[0, 0] = np.inf  # no constant part
    shape = radius**-slope * np.exp(-((radius * finest) ** 2))
    noise = np.fft.ifft2(np.fft.fft2(rng.standard_normal((SIZE, SIZE))) * shape).real
    return noise / noise.std()


def plaster(rng: np.random.Generator) -> np.ndarray:
    """A wall with next to no texture (1 % variation over long distances)."""
    return _tinted((0.82, 0.79, 0.72), 0.01 * clouds(rng, finest=60))


def bricks(rng: np.random.Generator, rows: int = 16, columns: int = 8) -> np.ndarray:
    """Brickwork: every brick has its own tone, mortar between."""
    v, u = _grid()
    row = np.floor(v * rows).astype(int)
    shifted = u * columns + 0.5 * (row % 2)
    tone = rng.uniform(-0.14, 0.14, (rows, columns))[row, np.floor(shifted).astype(int) % columns]
    mortar = np.maximum(_near_integer(v * rows, 0.07), _near_integer(shifted, 0.035))[..., None]
    brick = _tinted((0.66, 0.42, 0.34), tone + 0.05 * clouds(rng, finest=8))
    return brick * (1 - mortar) + 0.74 * mortar


def planks(rng: np.random.Generator, boards: int = 8) -> np.ndarray:
    """Floor boards with grain along the columns, staggered joints and dark seams."""
    v, u = _grid()
    board = np.floor(v * boards).astype(int)
    along = u * 2 + rng.uniform(0, 1, boards)[board]
    tone = rng.uniform(-0.12, 0.12, (boards, 2))[board, np.floor(along).astype(int) % 2]
    grain = 0.07 * clouds(rng, finest=6, stretch=6.0)
    seam = np.maximum(_near_integer(v * boards, 0.05), _near_integer(along, 0.012))[..., None]
    return _tinted((0.62, 0.46, 0.30), tone + grain) * (1 - 0.6 * seam)


def books(rng: np.random.Generator, shelves: int = 3, count: int = 17) -> np.ndarray:
    """A shelf full of books: upright stripes of many colours, each with a pale band, boards between."""
    v, u = _grid()
    shelf = np.floor(v * shelves).astype(int)
    edges = np.sort(rng.uniform(0, 1, (shelves, count)), axis=1)
    book = (u[..., None] > edges[shelf]).sum(axis=-1) % count
    color = rng.uniform(0.12, 0.7, (shelves, count, 3))[shelf, book]
    height = (v * shelves) % 1
    band = np.abs(height - rng.uniform(0.3, 0.75, (shelves, count))[shelf, book]) < 0.05
    color = np.where(band[..., None], 0.5 * color + 0.45, color) + 0.04 * clouds(rng, finest=8)[..., None]
    wood = _near_integer(v * shelves, 0.08)[..., None]
    return np.clip(color * (1 - wood) + np.array([0.36, 0.25, 0.16]) * wood, 0, 1)


def confetti(
    rng: np.random.Generator, ground: tuple[float, float, float], spots: int = 60, muted: float = 0.0
) -> np.ndarray:
    """Coloured disks of many sizes on a plain ground, `muted` (0..1) towards it: posters, toys, patterned cloth."""
    texture = _tinted(ground, 0.05 * clouds(rng, finest=10))
    radii = np.sort(rng.uniform(0.02, 0.11, spots))[::-1] * SIZE
    colors = muted * np.array(ground) + (1 - muted) * rng.uniform(0.05, 0.95, (spots, 3))
    for radius, centre, color in zip(radii, rng.uniform(0, SIZE, (spots, 2)), colors):
        reach = math.ceil(radius) + 1
        rows, columns = (np.arange(int(middle) - reach, int(middle) + reach + 1) for middle in centre)
        distance = np.hypot(rows[:, None] + 0.5 - centre[0], columns + 0.5 - centre[1])
        inside = np.clip(0.5 * (radius - distance), 0, 1)[..., None]
        patch = np.ix_(rows % SIZE, columns % SIZE)
        texture[patch] += inside * (color - texture[patch])
    return texture


def beach_ball(rng: np.random.Generator, wedges: int = 6) -> np.ndarray:
    """Coloured wedges around the poles, with dots; for latitude and longitude as texture coordinates."""
    v, u = _grid()
    colors = np.array([(0.85, 0.2, 0.16), (0.95, 0.93, 0.88), (0.16, 0.36, 0.74), (0.97, 0.78, 0.2)])
    texture = colors[np.floor(u * wedges).astype(int) % len(colors)]
    dots = np.hypot((u * 2 * wedges) % 1 - 0.5, (v * wedges) % 1 - 0.5) < 0.22
    texture = np.where(dots[..., None], 0.75 - 0.6 * texture, texture)
    return np.clip(_blurred(texture, 2.0) + 0.04 * clouds(rng, finest=8)[..., None], 0, 1)


def crate(rng: np.random.Generator) -> np.ndarray:
    """The side of a wooden crate: boards, a frame and a diagonal bar."""
    v, u = _grid()
    boards = planks(rng, boards=5)
    frame = (np.minimum(np.minimum(u, 1 - u), np.minimum(v, 1 - v)) < 0.11) | (np.abs(u - v) < 0.08)
    bar = _tinted((0.72, 0.56, 0.36), 0.06 * clouds(rng, finest=6, stretch=4.0))
    return _blurred(np.where(frame[..., None], bar, 0.8 * boards), 1.5)


def _grid() -> tuple[np.ndarray, np.ndarray]:
    """(v, u) of the texel centres, each [size, size]."""
    axis = (np.arange(SIZE) + 0.5) / SIZE
    return np.meshgrid(axis, axis, indexing="ij")


def _tinted(color: tuple[float, float, float], tone: np.ndarray) -> np.ndarray:
    return np.clip(np.array(color) * (1 + tone[..., None]), 0, 1)


def _near_integer(values: np.ndarray, width: float) -> np.ndarray:
    """1 within `width` of an integer, falling to 0 over the same distance again."""
    distance = np.abs(values - np.round(values))
    return np.clip(2 - distance / width, 0, 1)


def _blurred(texture: np.ndarray, sigma: float) -> np.ndarray:
    frequency = np.fft.fftfreq(SIZE)
    gaussian = np.exp(-2 * (math.pi * sigma) ** 2 * (frequency[:, None] ** 2 + frequency[None, :] ** 2))
    return np.fft.ifft2(np.fft.fft2(texture, axes=(0, 1)) * gaussian[..., None], axes=(0, 1)).real
