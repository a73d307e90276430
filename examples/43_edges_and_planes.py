"""Which points of a sweep are edges: the sharpest by LOAM's formula, in NumPy, and what it takes.

Run it with `python examples/43_edges_and_planes.py`; docs/lesson/04_lidar_slam.md explains it.
"""

import numpy as np

import odomap
from odomap.lidar.featurepicking import EDGE
from odomap.lidar.lego import LegoFrontEnd
from odomap.lidar.loam import LoamFrontEnd
from odomap.lidar.sweeps import SweepPoints, points_of

TOWN, K = "sim:street?sensors=lidar3d&seed=2&beams=32", 5  # neighbours to either side


def curvature(p: np.ndarray) -> np.ndarray:
    """Return c = |sum of (q - p) over the 2 K neighbours q| / (2 K |p|) along a ring."""
    d = sum(np.roll(p, k, axis=0) - p for k in range(-K, K + 1))
    return np.linalg.norm(d, axis=1) / (2 * K * np.linalg.norm(p, axis=1))


def hidden(p: np.ndarray) -> np.ndarray:
    """Say along a ring which points are beside an end where something nearer hides what follows."""
    jump, behind = np.diff(np.linalg.norm(p, axis=1)), np.zeros(len(p), bool)
    for n in np.flatnonzero(np.abs(jump) > 0.3):
        behind[slice(n + 1, n + 2 + K) if jump[n] > 0 else slice(max(n - K, 0), n + 1)] = True
    return behind


def sharpest(sweep: SweepPoints, leave_out: bool) -> np.ndarray:
    """Return rows of the two sharpest points of each sixth of each ring."""
    chosen = []
    for beam in np.unique(sweep.beams):
        p = sweep.points[rows := np.flatnonzero(sweep.beams == beam)]
        c = np.where(hidden(p) & leave_out, 0.0, curvature(p))
        for part in 2 * np.array_split(np.arange(len(c)), 6):
            at = part[c[part].argmax()]
            chosen.append(rows[at])
            c[max(at - K, 0) : at + K + 1] = 0.0
    return np.array(chosen)


def main() -> dict[str, float]:
    source = odomap.open(TOWN)
    sweep = points_of(source.frame(20).cloud, source.rig.lidars[0])
    true = source.world.sweep_truth(20, reach=3)
    is_edge, is_leaf, is_ground = true.is_edge, true.kinds == 3, true.is_ground
    picked = {"sharpest": sharpest(sweep, False), "none hidden": sharpest(sweep, True)}
    for name, front_end in (("LOAM", LoamFrontEnd()), ("LeGO-LOAM", LegoFrontEnd())):
        picked[name] = np.flatnonzero(front_end.prepare(sweep).marks == EDGE)
    for name, rows in picked.items():
        on = f"{is_leaf[rows].mean():3.0%} of leaves, {is_ground[rows].mean():3.0%} on the ground"
        print(f"{name:11}: {len(rows)} edges, {is_edge[rows].mean():.0%} true; {on}")
    return {name: is_edge[rows].mean() for name, rows in picked.items()}


if __name__ == "__main__":
    main()
