"""From light to bytes: what a real camera does to a picture.

Light is smeared along the exact flow of each pixel while the shutter is open, falls off towards the
corners as cos⁴, is scaled by a gain that drifts from frame to frame (and a little differently in
each camera), and gets the noise of counting photons and of reading them out,

    I = g v L,      Var I = shot² · I + read²,      byte = round(255 · min(1, I)^(1/γ)).

All noise is drawn from (seed, frame, camera), so any frame comes out the same in any order.

Cost: about 20 ns per pixel.

Paper: EMVA Standard 1288, "Characterization of image sensors and cameras" (linear camera model).
"""

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel
from odomap.simulation.render import Picture

__all__ = ["ImageNoise", "expose", "measure_depth", "warm_up"]

F32 = NDArray[np.float32]
LEVELS = 4096


@dataclass(frozen=True)
class ImageNoise:
    """How imperfect the cameras are."""

    shot: float = 0.012
    """Standard deviation of the photon noise at full scale, as a share of it."""
    read: float = 0.004
    """Standard deviation of the read-out noise, as a share of full scale."""
    vignetting: float = 0.6
    """Share of the cos⁴ law that reaches the image: 0 none, 1 all of it."""
    exposure_drift: float = 0.08
    """Standard deviation of the slow drift of the gain, as a share."""
    pair_drift: float = 0.02
    """The same for the gain of the second camera relative to the first."""
    shutter_s: float = 0.006
    """Exposure time in seconds: what moves meanwhile is smeared."""
    softness_px: float = 0.45
    """Standard deviation of the lens's blur in pixels."""
    gamma: float = 1.15
    """Bytes are light to the power 1/gamma."""

    @classmethod
    def none(cls) -> "ImageNoise":
        """Return a camera that only rounds to bytes, linearly."""
        return cls(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)

    def scaled(self, factor: float) -> "ImageNoise":
        """Return a camera with all imperfections times a factor."""
        if factor == 0:
            return ImageNoise.none()
        scaled = {f.name: factor * getattr(self, f.name) for f in fields(self)}
        scaled["vignetting"] = min(1.0, scaled["vignetting"])
        return replace(self, **{**scaled, "gamma": self.gamma})

    def gain(self, seed: int, time: float, camera: int) -> float:
        """Return the exposure of a camera at a time in seconds: smooth, mean about 1."""
        gain = 1.0
        for index, deviation in ((0, self.exposure_drift), (camera, self.pair_drift)):
            if index != camera and camera == 0:
                continue
            phases = np.random.default_rng([seed, 77, index]).uniform(0, 2 * np.pi, 3)
            waves = np.sin(2 * np.pi * np.array([0.07, 0.19, 0.53]) * time + phases)
            gain *= float(np.exp(deviation * waves.sum() * np.sqrt(2.0 / 3.0)))
        return gain


def expose(
    picture: Picture, noise: ImageNoise, pinhole: NDArray[np.float64], key: tuple[int, int, int],
    gain: float,
) -> NDArray[np.uint8]:  # fmt: skip
    """Take the photograph.

    Args:
        picture: light, depth and flow.
        noise: how imperfect the camera is.
        pinhole: (4,) fx, fy, cx, cy.
        key: seed, frame and camera, which decide the noise.
        gain: exposure.

    Returns:
        (H, W) uint8.
    """
    light, pinhole = picture.radiance, np.array(pinhole)
    if noise.softness_px > 0:
        import cv2

        border = cv2.BORDER_REPLICATE
        soft = cv2.GaussianBlur(light, (5, 5), noise.softness_px, borderType=border)
        light = np.asarray(soft, np.float32)
    if noise.shutter_s > 0:
        smeared = np.empty_like(light)
        smear_kernel(light, picture.flow, smeared)
        light = smeared
    rng = np.random.Generator(np.random.SFC64(np.random.SeedSequence([*key, 11])))
    dice = rng.standard_normal(light.shape, dtype=np.float32)
    curve = np.linspace(0.0, 1.0, LEVELS + 1) ** (1.0 / noise.gamma) * 255.0
    out = np.empty(light.shape, np.uint8)
    settings = np.array([gain, noise.vignetting, noise.shot, noise.read])
    expose_kernel(light, dice, pinhole, settings, curve.astype(np.float32), out)
    return out


def measure_depth(depth: F32, noise: float, key: tuple[int, int]) -> F32:
    """Measure depth as a structured-light camera does.

    The error grows with the square of the distance (1 mm at 1 m); there is nothing beyond 8 m, and
    nothing where the depth jumps.

    Args:
        depth: (H, W) true metres, 0 where there is only sky.
        noise: factor on the error; 0 returns the truth.
        key: seed and frame, which decide the noise.

    Returns:
        (H, W) metres, 0 where unknown.
    """
    if noise == 0:
        return depth
    rng = np.random.Generator(np.random.SFC64(np.random.SeedSequence([*key, 13])))
    dice = rng.standard_normal(depth.shape, dtype=np.float32)
    measured: F32 = depth + np.float32(0.001 * noise) * depth * depth * dice
    jump = np.zeros(depth.shape, np.bool_)
    limit = np.float32(0.05)
    for axis in (0, 1):
        step = np.abs(np.diff(depth, axis=axis)) > limit * np.delete(depth, -1, axis=axis)
        jump |= np.pad(step, [(0, 1), (0, 0)] if axis == 0 else [(0, 0), (0, 1)])
    measured[jump | (depth > 8.0)] = 0.0
    return measured


@kernel
def smear_kernel(light: F32, flow: F32, out: F32) -> None:
    """Average the light along each pixel's own flow, centred, about one sample per pixel."""
    height, width = light.shape
    for row in range(height):
        for column in range(width):
            fx, fy = flow[row, column, 0], flow[row, column, 1]
            length = np.sqrt(fx * fx + fy * fy)
            if length < 0.15:
                out[row, column] = light[row, column]
                continue
            samples = max(2, int(min(length, 40.0)))
            # As wide as a box of that length: the same second moment.
            wide = 1.0 / np.sqrt(1.0 - 1.0 / (samples * samples))
            fx, fy = fx * wide, fy * wide
            total = 0.0
            for k in range(samples):
                f = (k + 0.5) / samples - 0.5
                x = min(max(column + f * fx, 0.0), width - 1.001)
                y = min(max(row + f * fy, 0.0), height - 1.001)
                i, j = int(x), int(y)
                wx, wy = x - i, y - j
                upper = light[j, i] * (1.0 - wx) + light[j, i + 1] * wx
                lower = light[j + 1, i] * (1.0 - wx) + light[j + 1, i + 1] * wx
                total += upper * (1.0 - wy) + lower * wy
            out[row, column] = total / samples


@kernel
def expose_kernel(
    light: F32, dice: F32, pinhole: NDArray[np.float64], settings: NDArray[np.float64],
    curve: F32, out: NDArray[np.uint8],
) -> None:  # fmt: skip
    """I = g v L + noise, through the tone curve, to bytes."""
    height, width = light.shape
    gain, vignetting, shot, read = settings[0], settings[1], settings[2], settings[3]
    for row in range(height):
        y = (row - pinhole[3]) / pinhole[1]
        for column in range(width):
            x = (column - pinhole[2]) / pinhole[0]
            cos2 = 1.0 / (1.0 + x * x + y * y)
            fall = 1.0 - vignetting * (1.0 - cos2 * cos2)
            value = gain * fall * light[row, column]
            value += np.sqrt(shot * shot * max(value, 0.0) + read * read) * dice[row, column]
            place = min(max(value, 0.0), 1.0) * (len(curve) - 1.0)
            i = min(int(place), len(curve) - 2)
            w = place - i
            out[row, column] = int(curve[i] * (1.0 - w) + curve[i + 1] * w + 0.5)


def warm_up() -> None:
    """Compile the kernels."""
    light = np.full((4, 4), 0.5, np.float32)
    picture = Picture(light, light, np.ones((4, 4, 2), np.float32))
    expose(picture, ImageNoise(), np.array([4.0, 4, 2, 2]), (0, 0, 0), 1.0)
