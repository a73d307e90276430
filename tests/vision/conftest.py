"""A texture that is a function: it can be sampled anywhere, so that shifts are exact."""

import numpy as np
import pytest


class Texture:
    """A sum of waves of 9 to 60 pixels, of all directions; `at` takes any coordinates."""

    def __init__(self, seed, waves=40):
        rng = np.random.default_rng(seed)
        length = np.exp(rng.uniform(np.log(9.0), np.log(60.0), waves))
        direction = rng.uniform(0, 2 * np.pi, waves)
        self._k = 2 * np.pi / length * np.stack([np.cos(direction), np.sin(direction)])
        self._phase = rng.uniform(0, 2 * np.pi, waves)
        self._scale = 42.0 / np.sqrt(waves / 2)

    def at(self, x, y):
        """Return brightness 0..255, mean 128, as floats."""
        total = np.zeros(np.broadcast(x, y).shape)
        for (kx, ky), phase in zip(self._k.T, self._phase):
            total += np.sin(kx * x + ky * y + phase)
        return np.clip(128.0 + self._scale * total, 0, 255)

    def image(self, shape, map=lambda x, y: (x, y)):
        """Return (H, W) uint8 with the brightness of map(x, y) at pixel (x, y)."""
        y, x = np.mgrid[: shape[0], : shape[1]].astype(float)
        return np.round(self.at(*map(x, y))).astype(np.uint8)


@pytest.fixture(scope="session")
def texture():
    return Texture(3)


@pytest.fixture(scope="session")
def other_texture():
    return Texture(11)


@pytest.fixture(scope="session")
def scene():
    """Return (300, 440) uint8 with corners everywhere: squares of any grey on a soft ground."""
    rng = np.random.default_rng(5)
    image = Texture(8).image((300, 440)).astype(float) * 0.3 + 60
    for _ in range(620):
        x, y = rng.integers(0, 440), rng.integers(0, 300)
        w, h = rng.integers(4, 16, 2)
        image[y : y + h, x : x + w] = rng.uniform(0, 255)
    return np.round(image).clip(0, 255).astype(np.uint8)
