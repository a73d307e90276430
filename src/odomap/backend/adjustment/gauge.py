"""The gauge of a bundle adjustment: what pictures cannot tell, and what holds it.

Move, turn and scale views and points together, and no pixel changes: seven directions of the
unknowns in which the cost is level. A damped solver is best left free in them; afterwards each
connected part of the problem that could move is brought back,

    the first view to where it was, and with it six of the seven (a fixed view is there already)
    the farthest view to the distance it had, if the fixed views are all at one place and no depth
    was measured,

by p ← T_wa s T_aw' p, where T_aw' is the first view as found and T_wa as given. To ask how sure a
solution is, six coordinates of the first view and one of the farthest are held instead: of its
translation, in its own axes, the one that points away from the first most. A part with fixed points
is left to them.

Reference: B. Triggs et al., "Bundle adjustment - a modern synthesis", 1999, section 9.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from odomap.backend.adjustment.problem import Adjustment
from odomap.backend.graphs.components import connected_components
from odomap.geometry.lie import se3_inverse

__all__ = ["Gauge", "bring_back", "find_gauge"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

NEAR = 1e-9
"""Part of the extent of the views within which two of them are at one place."""


@dataclass(frozen=True)
class Gauge:
    """What each connected part of a problem is held by.

    Attributes:
        part: (K,) of each view; -1 of one that sees nothing.
        part_of_point: (M,); -1 of one that is not seen.
        anchor: (C,) the view that stays, -1 if the part may not move.
        far: (C,) the view whose distance stays, -1 if the part has a scale.
        is_held: (K, 6) coordinates (translation, rotation) of views to hold.
    """

    part: Index
    part_of_point: Index
    anchor: Index
    far: Index
    is_held: Mask

    @property
    def num_parts(self) -> int:
        """C."""
        return len(self.anchor)


def find_gauge(problem: Adjustment) -> Gauge:
    """Return what holds the gauge of each connected part of a problem."""
    k, m = problem.num_views, problem.num_points
    label = connected_components(k + m, problem.view, k + problem.point)
    touched, named = np.zeros((2, k + m), np.bool_)
    touched[problem.view] = touched[k + problem.point] = True
    named[label[touched]] = True
    names = np.flatnonzero(named)
    part = np.where(touched, np.cumsum(named)[label] - 1, -1)
    has_fixed_point = np.zeros(len(names), np.bool_)
    has_fixed_point[part[k:][problem.is_fixed_point & (part[k:] >= 0)]] = True
    has_depth = np.zeros(len(names), np.bool_)
    has_depth[part[problem.view[problem.has_depth]]] = True
    anchor, far = np.full((2, len(names)), -1)
    is_held = np.zeros((k, 6), np.bool_)
    Ts_world_camera = se3_inverse(problem.Ts_camera_world)
    for c in np.flatnonzero(~has_fixed_point):
        views = np.flatnonzero(part[:k] == c)
        fixed = views[problem.is_fixed_view[views]]
        anchor[c] = fixed[0] if len(fixed) else views[0]
        is_held[anchor[c]] = len(fixed) == 0
        way = Ts_world_camera[views, :3, 3] - Ts_world_camera[anchor[c], :3, 3]
        length = np.linalg.norm(way, axis=1)
        spread = length[problem.is_fixed_view[views]].max(initial=0.0)
        if length.max() > 0.0 and spread <= NEAR * length.max() and not has_depth[c]:
            far[c] = views[np.argmax(length)]
            R = Ts_world_camera[far[c], :3, :3]
            is_held[far[c], np.argmax(np.abs(way[np.argmax(length)] @ R))] = True
    return Gauge(part[:k], part[k:], anchor, far, is_held)


def bring_back(start: Adjustment, found: Adjustment, gauge: Gauge) -> Adjustment:
    """Return a solution moved so that anchors and scales are those of the start."""
    Ts, points = found.Ts_camera_world.copy(), found.points_world.copy()
    for c in np.flatnonzero(gauge.anchor >= 0):
        first, far = gauge.anchor[c], gauge.far[c]
        length = _distance(found, first, far) if far >= 0 else 0.0
        scale = _distance(start, first, far) / length if length > 0.0 else 1.0
        views, seen = gauge.part == c, gauge.part_of_point == c
        T_now, T_then = found.Ts_camera_world[first], start.Ts_camera_world[first]
        relative = found.Ts_camera_world[views] @ se3_inverse(T_now)
        relative[:, :3, 3] *= scale
        Ts[views] = relative @ T_then
        Ts[first] = T_then
        local = found.points_world[seen] @ T_now[:3, :3].T + T_now[:3, 3]
        back = se3_inverse(T_then)
        points[seen] = scale * local @ back[:3, :3].T + back[:3, 3]
    return replace(found, Ts_camera_world=Ts, points_world=points)


def _distance(problem: Adjustment, first: int, second: int) -> float:
    pair = se3_inverse(problem.Ts_camera_world[[first, second]])
    return float(np.linalg.norm(pair[0, :3, 3] - pair[1, :3, 3]))
