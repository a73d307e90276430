"""ORB in NumPy: corners, an angle, 256 bits that turn with it; and what levels are for.

Run it with `python examples/19_features_by_hand.py`; docs/lesson/03_orb_slam.md explains it.
"""

import cv2
import numpy as np

from odomap import World
from odomap.vision.brief import rotated_brief
from odomap.vision.fast import fast_corners
from odomap.vision.orb_pattern import PAIRS

RING = np.rint(3.0 * np.exp(2j * np.pi * np.arange(16) / 16))  # offsets, x + i y
V, U = np.array([(v, u) for v, u in np.ndindex(31, 31) if np.hypot(v - 15, u - 15) < 15.5]).T - 15


def fast_scores(image: np.ndarray) -> np.ndarray:
    """Return by how much nine neighbours in a row on a ring are all brighter, or all darker."""
    ring = [np.roll(image.astype(int), (-int(c.imag), -int(c.real)), (0, 1)) for c in RING]
    apart, arcs = np.stack(ring) - image, [(k + np.arange(9)) % 16 for k in range(16)]
    return np.max([np.maximum(apart[a].min(0), -apart[a].max(0)) for a in arcs], axis=0)


def angles(image: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return the direction from each pixel to the centroid of the grey values around it."""
    grey = image[at[:, 1:] + V, at[:, :1] + U].astype(float)
    return np.arctan2(grey @ V, grey @ U)


def bits(image: np.ndarray, at: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return 256 answers per pixel: is one point darker than another, both turned by an angle?"""
    turned = np.exp(1j * angle)[:, None] * (PAIRS.reshape(-1, 2) @ [1, 1j])  # (N, 512)
    x, y = (np.rint(part).astype(int) for part in (turned.real, turned.imag))
    grey = cv2.GaussianBlur(image, (7, 7), 2)[at[:, 1:] + y, at[:, :1] + x]
    return grey[:, ::2] < grey[:, 1::2]


def main() -> dict[str, float]:
    image = World.make(kind="room", seed=4, frames=1, sensors=("mono",)).frame(0).images[0]
    corners, results = fast_corners(image, 20)[0], {}
    same = (fast_scores(image)[corners[:, 1], corners[:, 0]] == corners[:, 2]).all()
    at = corners[np.hypot(*(corners[:, :2] - (320, 200)).T) < 170, :2].copy()
    ours, a = np.unpackbits(rotated_brief(image, at)[1], 1, bitorder="little"), angles(image, at)
    alike = (bits(image, at, a) == ours).mean()
    print(f"{len(corners)} corners, scores as odomap's: {same}; bits: {100 * alike:.2f} %")
    A = cv2.getRotationMatrix2D((320, 200), 40, 1)  # the image turned, and the same corners
    image_2, at_2 = cv2.warpAffine(image, A, (640, 400)), np.rint(at @ A[:, :2].T + A[:, 2])
    a_2 = angles(image_2, at_2.astype(int))
    for name, factor in (("with", 1.0), ("without", 0.0)):
        b, b_2 = bits(image, at, factor * a), bits(image_2, at_2.astype(int), factor * a_2)
        results[name] = np.median((b != b_2).sum(axis=1))
        other = np.median((b != np.roll(b_2, 1, axis=0)).sum(axis=1))
        print(f"turned, {name} an angle: {results[name]:.0f} bits differ; of strangers {other:.0f}")
    return results


if __name__ == "__main__":
    main()
