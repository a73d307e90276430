"""Procedural surfaces: what walls, floors, facades and roads look like, from a seed.

Natural surfaces have power at all scales: a fractal sum of band-limited noises, octave k at half
the cell size and a fraction `persistence` of the amplitude of octave k-1, is the usual model;
man-made ones add edges, corners and print, which are drawn. A texture is a power-of-two grey image
that wraps around, kept with its pyramid of 2x2 box averages: a sampler that picks the level whose
texel is as large as the pixel's footprint never aliases, and aliasing would be motion that did not
happen.
Level l holds the mean over 2^l x 2^l texels, so its sample (i, j) sits at ((i + ½)2^l, (j + ½)2^l)
and no level is shifted against another.

Cost: O(texels) per texture; the pyramid adds one third.

Paper: L. Williams, "Pyramidal parametrics", SIGGRAPH 1983.
"""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["TEXTURES", "Atlas", "fractal", "texture"]

Grey = NDArray[np.float32]
Generator = np.random.Generator


@dataclass(frozen=True)
class Atlas:
    """All textures of a scene with their pyramids, in one run of bytes.

    Attributes:
        texels: (B,) uint8 albedo, 255 is white; levels follow each other, finest first.
        table: (T, 3) int64: first byte, log2 of the width, log2 of the height.
    """

    texels: NDArray[np.uint8]
    table: NDArray[np.int64]

    @classmethod
    def of(cls, images: list[Grey]) -> "Atlas":
        """Pack images (power-of-two sizes, values 0 to 1) with their pyramids."""
        parts, table, offset = [], [], 0
        for image in images:
            height, width = image.shape
            table.append((offset, width.bit_length() - 1, height.bit_length() - 1))
            level = image.astype(np.float32)
            while True:
                packed = np.clip(np.rint(level * 255.0), 1, 255).astype(np.uint8)
                parts.append(packed.ravel())
                offset += packed.size
                if min(level.shape) == 1:
                    break
                level = (level[::2] + level[1::2]) * 0.5
                level = (level[:, ::2] + level[:, 1::2]) * 0.5
        return cls(np.concatenate(parts), np.array(table, np.int64))


def fractal(
    rng: Generator, height: int, width: int, cell: float, octaves: int, persistence: float = 0.5
) -> Grey:
    """Sum octaves of smooth noise, periodic over the image.

    Args:
        rng: where the numbers come from.
        height: pixels, a power of two.
        width: pixels, a power of two.
        cell: size of the coarsest grain in pixels, taken to the nearest power of two.
        octaves: how many halvings of it.
        persistence: amplitude ratio from one octave to the next.

    Returns:
        (height, width) float32 with zero mean and unit deviation.
    """
    halvings = min(max(0, round(float(np.log2(cell)))), int(np.log2(min(height, width))) - 1)
    shape = height >> halvings, width >> halvings
    total = rng.standard_normal(shape, dtype=np.float32)
    amplitude = 1.0
    for octave in range(1, halvings + 1):
        total = _doubled(total)
        if octave < octaves:
            amplitude *= persistence
            total += np.float32(amplitude) * rng.standard_normal(total.shape, dtype=np.float32)
    scaled: Grey = (total - total.mean()) / max(float(total.std()), 1e-6)
    return scaled


def _doubled(image: Grey) -> Grey:
    """Enlarge a periodic image by two (cubic), keeping it periodic."""
    padded = np.pad(image, 2, mode="wrap")
    large = cv2.resize(padded, None, fx=2.0, fy=2.0, interpolation=cv2.INTER_CUBIC)
    return np.ascontiguousarray(large[4:-4, 4:-4], np.float32)


def texture(kind: str, rng: Generator, width: int, height: int) -> Grey:
    """Paint a surface.

    Args:
        kind: one of `TEXTURES`.
        rng: where the numbers come from.
        width: pixels, a power of two.
        height: pixels, a power of two.

    Returns:
        (height, width) float32 albedo between 0.02 and 0.98.
    """
    painted: Grey = np.clip(TEXTURES[kind](rng, height, width), 0.02, 0.98).astype(np.float32)
    return painted


def _rectangle(image: Grey, x: float, y: float, w: float, h: float, value: float) -> None:
    cv2.rectangle(image, (int(x), int(y)), (int(x + w), int(y + h)), value, -1)


def _lettering(
    rng: Generator, image: Grey, x: float, y: float, w: float, h: float, ink: float
) -> None:
    """Print a line of letters: uprights, bars and bowls of a common height."""
    cursor, stroke = x, max(1, int(h * 0.16))
    while cursor < x + w - h * 0.5:
        wide = h * rng.uniform(0.35, 0.7)
        shape = rng.integers(5)
        if shape < 3:
            _rectangle(image, cursor, y, stroke, h, ink)
            level = y + h * rng.choice([0.0, 0.42, 0.84])
            _rectangle(image, cursor, level, wide, stroke, ink)
        elif shape == 3:
            middle = (int(cursor + wide / 2), int(y + h / 2))
            cv2.ellipse(image, middle, (int(wide / 2), int(h / 2)), 0, 0, 360, ink, stroke)
        cursor += wide + h * 0.22


def _plaster(rng: Generator, height: int, width: int) -> Grey:
    """Wall: nearly even, with grain, stains, scuffs, cracks and filled holes."""
    base = 0.62 + 0.035 * fractal(rng, height, width, width / 4, 4, 0.55)
    image: Grey = base + 0.022 * fractal(rng, height, width, 10, 3, 0.8)
    stains = np.clip(fractal(rng, height, width, width / 12, 4) - 1.2, 0, 1.5)
    image -= 0.10 * stains
    for _ in range(width * height // 30000):
        x, y = rng.uniform(0, width), rng.uniform(0, height)
        tone = float(np.clip(0.62 + rng.choice([-0.25, -0.15, 0.15]) * rng.uniform(0.3, 1), 0, 1))
        cv2.circle(image, (int(x), int(y)), int(rng.integers(1, 5)), tone, -1)
    for _ in range(width * height // 150000):
        points = np.cumsum(rng.normal(0, 9, (12, 2)) + rng.normal(0, 9, 2), 0)
        points += rng.uniform(0, (width, height))
        cv2.polylines(image, [points.astype(np.int32)], False, float(rng.uniform(0.35, 0.5)), 1)
    return image


def _wood(rng: Generator, height: int, width: int) -> Grey:
    """Planks along x: grain stretched along the plank, knots, dark gaps."""
    image = np.empty((height, width), np.float32)
    grain = fractal(rng, height, width // 8, 6, 3, 0.8)
    stretched = cv2.resize(grain, (width, height), interpolation=cv2.INTER_CUBIC)
    image[:] = 0.5 + 0.05 * stretched + 0.04 * fractal(rng, height, width, 60, 4)
    plank, y = max(height // int(rng.integers(5, 10)), 8), 0
    while y < height:
        tone = float(rng.uniform(-0.10, 0.10))
        image[y : y + plank] += tone
        for x in np.sort(rng.uniform(0, width, max(1, width // 500))):
            image[y : y + plank, int(x) : int(x) + 2] = 0.2
        for _ in range(max(1, width // 220)):
            centre = (int(rng.uniform(0, width)), int(y + rng.uniform(0.2, 0.8) * plank))
            size = (int(rng.integers(3, 10)), int(rng.integers(2, 6)))
            cv2.ellipse(image, centre, size, 0, 0, 360, float(rng.uniform(0.15, 0.35)), -1)
        image[y : y + 2] = 0.18
        y += plank
    return image


def _tiles(rng: Generator, height: int, width: int) -> Grey:
    """Slabs with joints, each of its own tone, speckled and worn."""
    side = int(2 ** rng.integers(5, 7))
    tones = rng.normal(0, 0.06, (height // side, width // side)).astype(np.float32)
    image: Grey = 0.48 + np.kron(tones, np.ones((side, side), np.float32))
    image += 0.05 * fractal(rng, height, width, 40, 5, 0.75)
    image[::side] *= 0.6
    image[1::side] *= 0.75
    image[:, ::side] *= 0.6
    return image


def _fabric(rng: Generator, height: int, width: int) -> Grey:
    """Weave: fine ribs under folds."""
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    image: Grey = 0.45 + 0.06 * np.sin(x * (2 * np.pi / 8)) * np.sin(y * (2 * np.pi / 8))
    image += 0.05 * fractal(rng, height, width, 16, 4, 0.8)
    image += 0.10 * fractal(rng, height, width, width / 4, 2)
    return image


def _poster(rng: Generator, height: int, width: int) -> Grey:
    """Print: shapes, a picture and lines of letters on a ground."""
    ground = float(rng.uniform(0.25, 0.85))
    image = np.full((height, width), ground, np.float32)
    image += 0.12 * fractal(rng, height, width, height / 3, 5, 0.6)
    for _ in range(int(rng.integers(6, 14))):
        tone = float(rng.uniform(0.05, 0.95))
        points = rng.uniform(0, (width, height), (int(rng.integers(3, 6)), 2)) * 0.5
        points += rng.uniform(0, (width, height)) * 0.6
        cv2.fillConvexPoly(image, cv2.convexHull(points.astype(np.int32)), tone, cv2.LINE_AA)
    for line in range(int(rng.integers(3, 9))):
        size = height * rng.uniform(0.025, 0.09)
        ink = float(rng.choice([0.06, 0.93]))
        start = rng.uniform(0.04, 0.3) * width
        _lettering(rng, image, start, height * (0.08 + 0.1 * line), width * 0.6, size, ink)
    image[:6] = image[-6:] = 0.1
    image[:, :6] = image[:, -6:] = 0.1
    image += 0.015 * fractal(rng, height, width, 6, 2)
    return image


def _shelf(rng: Generator, height: int, width: int) -> Grey:
    """Shelves of books: upright spines with letters, dark gaps above."""
    image = np.full((height, width), 0.09, np.float32)
    shelf = height // int(rng.integers(3, 6))
    for y in range(0, height, shelf):
        x = 0.0
        while x < width:
            wide = width * rng.uniform(0.015, 0.06)
            tall = shelf * rng.uniform(0.55, 0.9)
            if rng.random() < 0.9:
                tone = float(rng.uniform(0.12, 0.9))
                _rectangle(image, x, y + shelf - tall, wide - 2, tall, tone)
                ink = float(np.clip(tone + rng.choice([-0.45, 0.45]), 0.05, 0.95))
                band = y + shelf - tall * rng.uniform(0.2, 0.8)
                _rectangle(image, x + wide * 0.2, band, wide * 0.5, shelf * 0.1, ink)
            x += wide
        image[y : y + max(4, shelf // 12)] = 0.5
    image += 0.03 * fractal(rng, height, width, 24, 4, 0.7)
    return image


def _cardboard(rng: Generator, height: int, width: int) -> Grey:
    """Box: paper fibre, tape, labels with print, dents."""
    image: Grey = 0.5 + 0.05 * fractal(rng, height, width, width / 3, 6, 0.7)
    image += float(rng.uniform(-0.15, 0.2))
    _rectangle(image, 0, height * rng.uniform(0.3, 0.6), width, height * 0.08, 0.7)
    for _ in range(int(rng.integers(1, 4))):
        w, h = width * rng.uniform(0.2, 0.4), height * rng.uniform(0.12, 0.3)
        x, y = rng.uniform(0, width - w), rng.uniform(0, height - h)
        _rectangle(image, x, y, w, h, 0.88)
        for line in range(3):
            _lettering(rng, image, x + 6, y + h * (0.15 + 0.28 * line), w * 0.8, h * 0.16, 0.12)
    image += 0.02 * fractal(rng, height, width, 5, 2)
    return image


def _asphalt(rng: Generator, height: int, width: int) -> Grey:
    """Road: grain of stones, tyre tracks, patches, tar-filled cracks."""
    image: Grey = 0.30 + 0.05 * fractal(rng, height, width, 5, 3, 0.85)
    image += 0.035 * fractal(rng, height, width, width / 4, 6, 0.7)
    for _ in range(14):
        w, h = rng.uniform(0.04, 0.2, 2) * width
        x, y = rng.uniform(0, width - w), rng.uniform(0, height - h)
        image[int(y) : int(y + h), int(x) : int(x + w)] += float(rng.uniform(-0.09, 0.07))
    for _ in range(40):
        points = np.cumsum(rng.normal(0, 14, (25, 2)) + rng.normal(0, 10, 2), 0)
        points += rng.uniform(0, (width, height))
        cv2.polylines(image, [points.astype(np.int32)], False, float(rng.uniform(0.1, 0.2)), 2)
    for _ in range(500):
        centre = (int(rng.uniform(0, width)), int(rng.uniform(0, height)))
        cv2.circle(image, centre, int(rng.integers(1, 5)), float(rng.uniform(0.1, 0.6)), -1)
    return image


def _foliage(rng: Generator, height: int, width: int) -> Grey:
    """Leaves or grass: strong contrast at small scale, clumps at large."""
    image: Grey = 0.26 + 0.085 * fractal(rng, height, width, 24, 5, 0.9)
    image += 0.06 * fractal(rng, height, width, width / 4, 3)
    return image


def _facade(rng: Generator, height: int, width: int) -> Grey:
    """House front: brick or render, storeys of framed windows with curtains, sills and a band."""
    tone = float(rng.uniform(0.3, 0.75))
    image: Grey = tone + 0.05 * fractal(rng, height, width, width / 5, 6, 0.6)
    if rng.random() < 0.5:
        course = 6
        image[::course] *= 0.82
        for row in range(height // course):
            image[row * course : (row + 1) * course, (row % 2) * 7 :: 14] *= 0.85
    image += 0.03 * fractal(rng, height, width, 8, 3, 0.8)
    storeys, columns = int(rng.integers(2, 5)), int(rng.integers(3, 7))
    high, wide = height / storeys, width / columns
    w, h = wide * rng.uniform(0.3, 0.6), high * rng.uniform(0.45, 0.65)
    for storey in range(storeys):
        for column in range(columns):
            if rng.random() < 0.1:
                continue
            x = column * wide + (wide - w) / 2
            y = storey * high + (high - h) * 0.45
            _window(rng, image, x, y, w, h)
        if rng.random() < 0.4:
            _rectangle(image, 0, (storey + 1) * high - 8, width, 5, float(rng.uniform(0.2, 0.9)))
    if rng.random() < 0.5:
        board = height * 0.82
        _rectangle(image, width * 0.1, board, width * 0.6, height * 0.07, 0.12)
        _lettering(rng, image, width * 0.13, board + 7, width * 0.5, height * 0.045, 0.9)
    return image


def _window(rng: Generator, image: Grey, x: float, y: float, w: float, h: float) -> None:
    """Draw a frame, dark or reflecting panes, a cross-bar and now and then a curtain."""
    frame = float(rng.choice([0.15, 0.85, 0.9]))
    _rectangle(image, x - 4, y - 4, w + 8, h + 8, frame)
    _rectangle(image, x, y, w, h, float(rng.uniform(0.05, 0.3)))
    if rng.random() < 0.4:
        _rectangle(image, x, y, w * rng.uniform(0.2, 0.5), h, float(rng.uniform(0.4, 0.8)))
    if rng.random() < 0.3:
        _rectangle(image, x, y, w, h * rng.uniform(0.2, 0.7), float(rng.uniform(0.5, 0.8)))
    _rectangle(image, x + w / 2 - 2, y, 4, h, frame)
    if rng.random() < 0.6:
        _rectangle(image, x, y + h * 0.35, w, 3, frame)
    _rectangle(image, x - 8, y + h + 4, w + 16, 5, 0.75)


def _car(rng: Generator, height: int, width: int) -> Grey:
    """Side of a parked car: body, doors, wheels, a highlight."""
    tone = float(rng.uniform(0.08, 0.85))
    image: Grey = np.full((height, width), tone, np.float32)
    image += np.linspace(0.1, -0.1, height, dtype=np.float32)[:, None]
    for x in (0.3, 0.55, 0.75):
        _rectangle(image, width * x, height * 0.02, width * 0.01, height * 0.75, tone * 0.5)
        _rectangle(image, width * (x - 0.06), height * 0.3, width * 0.04, height * 0.07, tone * 1.4)
    _rectangle(image, 0, height * 0.45, width, height * 0.04, tone * 0.7)
    _rectangle(image, 0, height * 0.82, width, height * 0.18, 0.06)
    for x in (0.2, 0.8):
        middle = (int(width * x), int(height * 0.8))
        cv2.circle(image, middle, int(height * 0.2), 0.05, -1)
        cv2.circle(image, middle, int(height * 0.11), 0.6, -1)
    _rectangle(image, width * 0.9, height * 0.5, width * 0.08, height * 0.1, 0.8)
    image += 0.02 * fractal(rng, height, width, 20, 4)
    return image


def _cabin(rng: Generator, height: int, width: int) -> Grey:
    """Windows of a car: dark panes with pillars between, the roof's edge above."""
    image: Grey = np.full((height, width), float(rng.uniform(0.1, 0.7)), np.float32)
    for x in (0.06, 0.38, 0.70):
        _rectangle(image, width * x, height * 0.15, width * 0.26, height * 0.75, 0.08)
    image += 0.04 * fractal(rng, height, width, width / 4, 6)
    return image


TEXTURES: dict[str, Callable[[Generator, int, int], Grey]] = {
    "asphalt": _asphalt,
    "cabin": _cabin,
    "car": _car,
    "cardboard": _cardboard,
    "fabric": _fabric,
    "facade": _facade,
    "foliage": _foliage,
    "plaster": _plaster,
    "poster": _poster,
    "shelf": _shelf,
    "tiles": _tiles,
    "wood": _wood,
}
