"""Textures: power at all scales, and pyramids of true averages."""

import numpy as np
import pytest

from odomap.simulation.texture import TEXTURES, Atlas, fractal, texture


@pytest.mark.parametrize("kind", sorted(TEXTURES))
def test_each_kind_is_textured_and_decided_by_its_seed(kind: str) -> None:
    first, again, other = (
        texture(kind, np.random.default_rng(seed), 256, 128) for seed in (1, 1, 2)
    )
    assert first.shape == (128, 256)
    assert first.dtype == np.float32
    assert first.min() >= 0.02
    assert first.max() <= 0.98
    assert first.std() > 0.02
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


def test_every_level_is_the_mean_of_the_texels_below() -> None:
    image = np.random.default_rng(0).uniform(0.1, 0.9, (16, 64)).astype(np.float32)
    atlas = Atlas.of([np.full((2, 2), 0.5, np.float32), image])
    offset, log_w, log_h = atlas.table[1]
    assert (log_w, log_h) == (6, 4)
    for level in range(5):
        h, w = 16 >> level, 64 >> level
        got = atlas.texels[offset : offset + h * w].reshape(h, w) / 255.0
        wanted = image.reshape(h, 1 << level, w, 1 << level).mean((1, 3))
        np.testing.assert_allclose(got, wanted, atol=0.5 / 255 + 1e-6)
        offset += h * w


def test_fractal_noise_is_periodic_and_smooth_at_its_scale() -> None:
    noise = fractal(np.random.default_rng(0), 128, 256, 32.0, 2)
    assert abs(noise.mean()) < 1e-5
    assert noise.std() == pytest.approx(1.0, abs=1e-4)
    inside = np.abs(np.diff(noise, axis=1)).max()
    assert np.abs(noise[:, 0] - noise[:, -1]).max() < 1.5 * inside
    assert inside < 0.5
