"""Exercise 3, solved: the odometry of a 2D laser, from scratch (docs/lesson/exercise_3.md).

    python examples/exercise_3_solution.py                          # once round a simulated hall
    python examples/exercise_3_solution.py RECORDING odometry.png   # of a 2D laser

Scans become points, ICP lays them onto the last scan or onto a map of those before, and motions are
put one after the other. From odomap come the scans, and the truth to judge by.
"""

import sys
from collections.abc import Callable
from itertools import pairwise

import numpy as np
from matplotlib.figure import Figure
from scipy.spatial import cKDTree

import odomap

DATA = "sim:hall?sensors=laser&seed=4&rate_hz=4&beams=271"
SPACING = 0.05  # m between points that are used: near walls have no more say than far ones
REACHES = 1.0, 0.3  # m: how far apart a pair may be, at first and in the end
STEPS, ENOUGH = 40, 1e-4  # steps at most with each reach; m and rad of a step that is the last
NEIGHBOURS = 6  # that tell the direction of a wall
KEEP = 0.5  # m after which a scan becomes part of the map

Array = np.ndarray
Step = Callable[[Array, Array, Array], Array]


# ---- scans ----


def points_of(ranges: Array, angles: Array, T_body_lidar: Array) -> Array:
    """Return the (N, 2) points of a scan in the body; beams without a range give none."""
    known = np.isfinite(ranges)  # NaN: lost; inf: nothing there
    x, y = ranges[known] * np.cos(angles[known]), ranges[known] * np.sin(angles[known])
    return np.column_stack([x, y]) @ T_body_lidar[:2, :2].T + T_body_lidar[:2, 3]


def thinned(points: Array, spacing: float = SPACING) -> Array:
    """Return one point of each cell: the mean of those in it."""
    _, cell = np.unique(np.floor(points / spacing), axis=0, return_inverse=True)
    cell = cell.ravel()
    sums = np.stack([np.bincount(cell, points[:, k]) for k in range(2)], axis=1)
    return sums / np.bincount(cell)[:, None]


def normals_of(points: Array, tree: cKDTree) -> Array:
    """Return (N, 2) unit vectors across the line through the neighbours of each point."""
    near = points[tree.query(points, NEIGHBOURS)[1]]
    near = near - near.mean(axis=1, keepdims=True)
    return np.linalg.eigh(near.transpose(0, 2, 1) @ near)[1][:, :, 0]


# ---- ICP ----


def motion(angle: float, t: Array) -> Array:
    """Return the (3, 3) matrix of a motion in the plane."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, t[0]], [s, c, t[1]], [0.0, 0.0, 1.0]])


def moved(T: Array, points: Array) -> Array:
    return points @ T[:2, :2].T + T[:2, 2]


def to_points(p: Array, q: Array, n: Array) -> Array:
    """Return the motion that minimises the sum of |T p - q|^2, by SVD; normals are not needed."""
    p0, q0 = p - p.mean(axis=0), q - q.mean(axis=0)
    U, _, Vt = np.linalg.svd(q0.T @ p0)
    R = U * [1.0, np.linalg.det(U @ Vt)] @ Vt  # a rotation, no mirror
    return motion(np.arctan2(R[1, 0], R[0, 0]), q.mean(axis=0) - R @ p.mean(axis=0))


def to_lines(p: Array, q: Array, n: Array) -> Array:
    """Return the motion that minimises the sum of (n . (T p - q))^2, for small turns."""
    J = np.column_stack([n, n[:, 1] * p[:, 0] - n[:, 0] * p[:, 1]])
    x, y, angle = np.linalg.lstsq(J, np.sum(n * (q - p), axis=1), rcond=None)[0]
    return motion(angle, np.array([x, y]))


class Target:
    """Points that scans are laid onto."""

    def __init__(self, points: Array) -> None:
        self.points, self.tree = points, cKDTree(points)
        self.normals = normals_of(points, self.tree)

    def icp(self, source: Array, T: Array, step: Step) -> Array:
        """Return T_target_source, found from a first guess of it."""
        for reach in REACHES:
            for _ in range(STEPS):
                p = moved(T, source)
                apart, j = self.tree.query(p, distance_upper_bound=reach)
                pair = np.flatnonzero(apart < reach)
                if len(pair) < 10:
                    raise odomap.TrackingFailed(f"{len(pair)} points meet others: where is it?")
                j = j[pair]
                delta = step(p[pair], self.points[j], self.normals[j])
                T = delta @ T
                # How far the step moved the scan, not the origin of the map.
                shift = np.linalg.norm((moved(delta, p) - p).mean(axis=0))
                if shift < ENOUGH and abs(delta[1, 0]) < ENOUGH:
                    break
        return T


# ---- the path ----


def onto_last(scans: list[Array], step: Step) -> Array:
    """Return (K, 3, 3) poses: each scan laid onto the one before, motions one after the other."""
    Ts, T_prev_cur = [np.eye(3)], np.eye(3)
    for last, scan in pairwise(scans):
        T_prev_cur = Target(last).icp(scan, T_prev_cur, step)  # begins with: as before
        Ts.append(Ts[-1] @ T_prev_cur)
    return np.array(Ts)


def onto_map(scans: list[Array], step: Step) -> Array:
    """Return (K, 3, 3) poses: each scan laid onto the points of all those kept before."""
    Ts, T_prev_cur, T_kept, known = [np.eye(3)], np.eye(3), np.eye(3), Target(scans[0])
    for scan in scans[1:]:
        Ts.append(known.icp(scan, Ts[-1] @ T_prev_cur, step))
        T_prev_cur = np.linalg.inv(Ts[-2]) @ Ts[-1]
        if np.linalg.norm((Ts[-1] - T_kept)[:2, 2]) > KEEP:
            # What is there already stays as it is: the new scan only adds what is new.
            there, T_kept = moved(Ts[-1], scan), Ts[-1]
            new = known.tree.query(there)[0] > SPACING
            known = Target(np.concatenate([known.points, there[new]]))
    return np.array(Ts)


def in_space(Ts: Array) -> Array:
    """Return (K, 4, 4) poses in the plane z = 0 of space."""
    lifted = np.tile(np.eye(4), (len(Ts), 1, 1))
    lifted[:, :2, :2], lifted[:, :2, 3] = Ts[:, :2, :2], Ts[:, :2, 2]
    return lifted


def answer(recording: str = DATA) -> tuple[dict[str, float], dict[str, Array], Array]:
    """Find the path of a recording in four ways.

    Returns:
        The ATE of each in metres, the first pose laid onto the true one; positions; the true ones.
    """
    source = odomap.open(recording)
    mount, scans, stamps = source.rig.lidars[0], [], []
    angles = np.linspace(*mount.angles)
    for frame in source:
        scans.append(thinned(points_of(frame.scan, angles, mount.T_body_lidar.matrix)))
        stamps.append(frame.stamp_ns)
    results, paths = {}, {}
    for where, follow in (("last scan", onto_last), ("map", onto_map)):
        for what, step in (("points", to_points), ("lines", to_lines)):
            path = odomap.Trajectory(np.array(stamps), in_space(follow(scans, step)))
            error, name = odomap.ate(path, source.truth, align="first"), f"{where}, {what}"
            results[name] = error.rmse
            paths[name] = path.transformed(error.T_reference_estimate).positions
            cm = 100 * np.array([error.rmse, error.errors[-1]])
            of = f"{cm[1]:4.1f} cm after {error.path_m:.0f} m"
            print(f"{name:17}: ATE {cm[0]:4.1f} cm, off by {of}")
    return results, paths, source.truth.interpolate(stamps).positions


def draw(paths: dict[str, Array], truth: Array) -> Figure:
    """Draw all paths over the true one, as seen from above, and how far off they are."""
    figure = Figure(figsize=(9.6, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.plot(*truth[:, :2].T, color="0.75", lw=6)
    for name, path in paths.items():
        left.plot(*path[:, :2].T, lw=1.2)
        right.semilogy(100 * np.linalg.norm(path - truth, axis=1)[1:], lw=1.2, label=name)
    left.set(aspect="equal", xlabel="x, m", ylabel="y, m")
    right.set(xlabel="scan", ylabel="off by, cm")
    right.legend(frameon=False, fontsize=8)
    return figure


def main(recording: str = DATA, picture: str = "odometry.png") -> dict[str, float]:
    """Find the path of a recording, and draw it; return the ATEs."""
    results, paths, truth = answer(recording)
    draw(paths, truth).savefig(picture, dpi=110)
    return results


if __name__ == "__main__":
    main(*sys.argv[1:])
