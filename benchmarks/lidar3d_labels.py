"""Whether edges, planes and ground of simulated sweeps are those of the world (`lidar3d.py`)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.lidar.featurepicking import EDGE, PLANE
from odomap.lidar.lego import LegoFrontEnd
from odomap.lidar.loam import LoamFrontEnd
from odomap.lidar.scanlines import scan_lines
from odomap.lidar.sweeps import SweepPoints, points_of
from odomap.simulation.solids import KINDS
from odomap.simulation.sweepspec import SweepSpec
from odomap.simulation.sweeptruth import SweepTruth
from odomap.simulation.sweepworld import SweepWorld

MAKERS = {"loam": LoamFrontEnd, "lego": LegoFrontEnd}
REACH = 3
"""Points along a line that still feel the end of a surface."""
BEHIND_M = 0.15
"""A neighbour that is nearer by more hides what is behind it: no edge of that."""
OFF_M, DOUBLED_AT_M = 0.05, 50.0
"""How far from its plane a point may be, which grows with its range as the noise does."""
NEAR_M = 20.0
LEAVES = KINDS.index("leaves")

Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Labels:
    """Shares of labels that are right.

    Attributes:
        edges: of the points called edges, those at the end or the bend of a surface.
        planes: of those called planes, those on the surface they seem to be on, off its ends.
        ground: of those called ground, those one could drive on; NaN where none are called so.
        ground_found: of what one could drive on within 20 m, what was called ground.
        num_edges: points called so.
        num_planes: likewise.
    """

    edges: float
    planes: float
    ground: float
    ground_found: float
    num_edges: int
    num_planes: int


def labelled(front_end: str, spec: SweepSpec, indices: list[int]) -> Labels:
    """Judge the labels of some sweeps of a world together."""
    world = SweepWorld(spec)
    rows = []
    for index in indices:
        sweep = points_of(world.frame(index).cloud, world.rig.lidars[0])
        rows.append(_judged(front_end, sweep, world.sweep_truth(index, reach=REACH)))
    right_edges, right_planes, right_ground, found_ground = (
        np.concatenate(column) for column in zip(*rows)
    )
    return Labels(
        float(right_edges.mean()),
        float(right_planes.mean()),
        float(right_ground.mean()) if len(right_ground) else float("nan"),
        float(found_ground.mean()) if len(right_ground) else float("nan"),
        len(right_edges),
        len(right_planes),
    )


def _judged(front_end: str, sweep: SweepPoints, truth: SweepTruth) -> tuple[Bools, ...]:
    """Say of each edge, plane and ground point whether it is one, and of the near ground whether
    it was found."""
    found = MAKERS[front_end]().prepare(sweep)
    ranges = np.linalg.norm(sweep.points, axis=1)
    is_edge = truth.is_edge[sweep.rows]
    # Of the edges of leaves nobody can say whether they are right.
    edges = (found.marks == EDGE) & (truth.kinds[sweep.rows] != LEAVES)
    away = np.einsum("ni,ni->n", sweep.points - truth.points[sweep.rows], truth.normals[sweep.rows])
    is_flat = (np.abs(away) < OFF_M * (1.0 + ranges / DOUBLED_AT_M)) & ~is_edge
    is_ground = truth.is_ground[sweep.rows]
    return (
        (is_edge | is_end(sweep, truth))[edges],
        is_flat[found.marks == PLANE],
        is_ground[found.ground],
        found.ground[is_ground & (ranges < NEAR_M)],
    )


def is_end(sweep: SweepPoints, truth: SweepTruth) -> Bools:
    """Say of each point whether along its line its surface ends within reach, hidden by nothing.

    The truth's own edges leave out steps that are small for their range.
    """
    lines = scan_lines(sweep, np.eye(4))
    surfaces = truth.surfaces[sweep.rows][lines.order]
    ranges = np.linalg.norm(lines.points, axis=1)
    along = np.arange(len(ranges))
    beside = (along[:, None] + [k for k in range(-REACH, REACH + 1) if k]) % len(ranges)
    ends = surfaces[beside] != surfaces[:, None]
    open_ = ranges[beside] > ranges[:, None] - BEHIND_M
    out = np.empty(len(ranges), np.bool_)
    out[lines.order] = (ends & open_).any(axis=1)
    return out
