"""The interactive 3D view of a report: what its script needs, packed small.

Positions are turned so that the third axis points up, thinned to what a screen resolves, and sent
as base64 of little-endian float32 inside a JSON text; landmarks far outside the path's surroundings
are left out, since a few badly triangulated ones would press everything else into a dot.
"""

import base64
import json

import numpy as np
from matplotlib.colors import to_hex
from numpy.typing import ArrayLike, NDArray

from odomap.views.scene import AXES, Scene, gaps_as_nan, thin
from odomap.views.style import ERROR_COLOURS

__all__ = ["path3d_data"]

PATH_POINTS = 2000
TRUTH_POINTS = 2000
LANDMARKS = 12_000
KEYFRAMES = 500
SURROUNDINGS = 10.0
"""Landmarks farther from the path's middle than this many of its radii are not shown."""


def path3d_data(
    place: Scene,
    keyframe_stamps_ns: NDArray[np.int64],
    points: NDArray[np.float64] | None,
    unit: str = "m",
    loops: NDArray[np.float64] | None = None,
) -> str:
    """Pack a scene for the page's script.

    Args:
        place: the path, and its truth.
        keyframe_stamps_ns: stamps of keyframes.
        points: (M, 3) landmarks in the estimate's world, metres, or None.
        unit: what lengths are in; "units" where a path has no scale.
        loops: (L, 2, 3) ends of loops in the estimate's world, or None.

    Returns:
        JSON that is safe inside a script element.
    """
    order, sign = _upright(place)
    keep = thin(len(place.positions), PATH_POINTS)
    path = place.positions[keep][:, order] * sign
    truth = np.zeros((0, 3))
    if place.truth is not None:
        truth = place.truth[thin(len(place.truth), TRUTH_POINTS)][:, order] * sign
    colours: list[str] = []
    if place.distances is not None:
        largest = max(float(place.distances.max()), 1e-9)
        colours = [to_hex(c) for c in ERROR_COLOURS(place.distances[keep] / largest)]
    marked = np.isin(place.stamps_ns[keep], keyframe_stamps_ns).nonzero()[0]
    stamps = place.stamps_ns[keep]
    data = {
        "axes": _names(place, order, sign),
        "unit": unit,
        "path": _packed(path),
        "truth": _packed(truth),
        "points": _packed(_landmarks(place, points)[:, order] * sign),
        "loops": _packed(_ends(place, loops)[:, order] * sign),
        "forward": _packed(_forward(path)),
        "times": _packed((stamps - place.stamps_ns[0]) * 1e-9),
        "pieces": _pieces(stamps),
        "keyframes": marked[thin(len(marked), KEYFRAMES)].tolist(),
        "colours": colours,
    }
    return json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")


def _upright(place: Scene) -> tuple[list[int], NDArray[np.float64]]:
    """Return the order and signs of axes that make a right-handed frame with the third one up."""
    a, b = place.ground
    if place.up_sign > 0:
        return [a, b, place.up_axis], np.ones(3)
    # Camera axes (x right, y down, z forward) → x, z, −y: still right-handed.
    return [a, b, place.up_axis], np.array([1.0, 1.0, -1.0])


def _names(place: Scene, order: list[int], sign: NDArray[np.float64]) -> list[str]:
    return [("−" if s < 0 else "") + AXES[k] for k, s in zip(order, sign)]


def _forward(path: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return unit vectors along the path, the zero vector where it stands still."""
    if len(path) < 2:
        return np.zeros_like(path)
    ahead = np.gradient(path, axis=0)
    norm = np.linalg.norm(ahead, axis=1, keepdims=True)
    unit: NDArray[np.float64] = ahead / np.where(norm > 0, norm, 1.0)
    return unit


def _pieces(stamps_ns: NDArray[np.int64]) -> list[list[int]]:
    """Return [first, last] of each stretch without a gap in time."""
    n = len(stamps_ns)
    cuts = np.nonzero(np.isnan(gaps_as_nan(stamps_ns, np.zeros(n))))[0].tolist()
    return [[a, b - 1] for a, b in zip([0, *cuts], [*cuts, n])]


def _landmarks(place: Scene, points: NDArray[np.float64] | None) -> NDArray[np.float64]:
    if points is None or len(points) == 0:
        return np.zeros((0, 3))
    T = place.T_drawn_world
    drawn: NDArray[np.float64] = np.asarray(points, np.float64) @ T[:3, :3].T + T[:3, 3]
    drawn = drawn[np.isfinite(drawn).all(axis=1)]
    low, high = place.positions.min(axis=0), place.positions.max(axis=0)
    radius = max(float(np.linalg.norm(high - low)) / 2, 1.0)
    near = np.linalg.norm(drawn - (low + high) / 2, axis=1) < SURROUNDINGS * radius
    drawn = drawn[near]
    return drawn[thin(len(drawn), LANDMARKS)]


def _ends(place: Scene, loops: NDArray[np.float64] | None) -> NDArray[np.float64]:
    if loops is None:
        return np.zeros((0, 3))
    T = place.T_drawn_world
    return np.asarray(loops.reshape(-1, 3) @ T[:3, :3].T + T[:3, 3])


def _packed(values: ArrayLike) -> str:
    return base64.b64encode(np.asarray(values, dtype="<f4").tobytes()).decode("ascii")
