"""The gauge of a bundle adjustment: what pictures cannot tell, and what holds it.

Move, turn and scale views and points together, and no pixel changes: seven directions of the
unknowns in which the cost is level. A damped solver walks where the cost falls and needs no rule
about them ("free"); to compare two solutions, or to ask how sure one is, they must be held. Of each
connected part of the problem,

    a view, if none is fixed: the first; and with it six of the seven
    the scale, if the fixed views are all at one place: of the view farthest from there the
    coordinate of translation, in its own axes, that points away from there most

are held. Three fixed points of a part hold it as well. Covariances are those given what is held.

Reference: B. Triggs et al., "Bundle adjustment - a modern synthesis", 1999, section 9.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.backend.adjustment_problem import Adjustment
from odomap.backend.components import connected_components

__all__ = ["Gauge", "find_gauge"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

NEAR = 1e-9
"""Part of the extent of the views within which two of them are at one place."""


@dataclass(frozen=True)
class Gauge:
    """What to hold.

    Attributes:
        is_held: (K, 6) coordinates (translation, rotation) of views.
        part: (K,) connected part of each view; -1 of one that sees nothing.
        num_parts: connected parts.
    """

    is_held: Mask
    part: Index
    num_parts: int


def find_gauge(problem: Adjustment) -> Gauge:
    """Return what holds the gauge of each connected part of a problem."""
    k = problem.num_views
    label = connected_components(k + problem.num_points, problem.view, k + problem.point)
    sees = np.bincount(problem.view, minlength=k) > 0
    names, part = np.unique(label[:k][sees], return_inverse=True)
    parts = np.full(k, -1)
    parts[sees] = part
    R = problem.Ts_camera_world[:, :3, :3]
    centres = -(np.swapaxes(R, 1, 2) @ problem.Ts_camera_world[:, :3, 3:])[:, :, 0]
    seen = np.bincount(problem.point, minlength=problem.num_points) > 0
    fixed_points = label[k:][problem.is_fixed_point & seen]
    is_held = np.zeros((k, 6), np.bool_)
    for number, name in enumerate(names):
        if np.count_nonzero(fixed_points == name) < 3:
            _hold(problem, np.flatnonzero(parts == number), R, centres, is_held)
    return Gauge(is_held, parts, len(names))


def _hold(problem: Adjustment, views: Index, R: Array, centres: Array, is_held: Mask) -> None:
    """Hold one connected part, by its first view and the scale of the farthest."""
    fixed = views[problem.is_fixed_view[views]]
    if len(fixed) == 0:
        is_held[views[0]] = True
        fixed = views[:1]
    extent = float(np.max(np.linalg.norm(centres[views] - centres[fixed[0]], axis=1)))
    if np.max(np.linalg.norm(centres[fixed] - centres[fixed[0]], axis=1)) > NEAR * extent:
        return
    away = centres[views] - centres[fixed[0]]
    far = int(np.argmax(np.linalg.norm(away, axis=1)))
    axis = int(np.argmax(np.abs(R[views[far]] @ away[far])))
    is_held[views[far], axis] = True
