"""ICP on two scans of a laser, step by step: points onto points, and points onto lines.

Run it with `python examples/30_icp_step_by_step.py`; docs/lesson/04_lidar_slam.md explains it.
"""

import numpy as np
from scipy.spatial import cKDTree

import odomap
from odomap.geometry.lie import se2_exp, se2_inverse, se2_log
from odomap.geometry.planar import between_planar, planar_matrix, to_plane
from odomap.lidar.scans import Beams, ScanPoints


def two_scans() -> tuple[ScanPoints, ScanPoints, np.ndarray]:
    """Return two scans in the body, and the pose that the first one's body had in the second."""
    source = odomap.open("sim:hall?sensors=laser&seed=1&beams=271")
    beams, x = Beams(source.rig.lidars[0]), to_plane(source.truth.Ts_world_body)
    T_true = planar_matrix(between_planar(x[466], x[450]))
    return *(beams.points(source.frame(k).scan) for k in (450, 466)), T_true


def onto_points(p: np.ndarray, q: np.ndarray, n: np.ndarray) -> np.ndarray:
    """Return the (3, 3) motion that brings points p onto their partners q best."""
    U, _, Vt = np.linalg.svd((q - q.mean(axis=0)).T @ (p - p.mean(axis=0)))
    R = U * [1.0, np.linalg.det(U @ Vt)] @ Vt  # a rotation, no mirror
    return np.block([[R, (q.mean(axis=0) - R @ p.mean(axis=0))[:, None]], [0, 0, 1]])


def onto_lines(p: np.ndarray, q: np.ndarray, n: np.ndarray) -> np.ndarray:
    """Return the (3, 3) motion that brings points p onto the lines through q across n best."""
    J = np.column_stack([n, n[:, 1] * p[:, 0] - n[:, 0] * p[:, 1]])
    return se2_exp(np.linalg.lstsq(J, np.sum(n * (q - p), axis=1), rcond=None)[0])


def icp(source: ScanPoints, target: ScanPoints, way):
    """Yield the motion before each step, source points as they lie then, and their partners."""
    T, tree = np.eye(3), cKDTree(target.hits)
    for _ in range(41):
        p = source.hits @ T[:2, :2].T + T[:2, 2]
        apart, j = tree.query(p, distance_upper_bound=0.8)  # m: farther apart is no pair
        p, j = p[apart < np.inf], j[apart < np.inf]
        yield T, p, target.hits[j]
        T = way(p, target.hits[j], target.normals[j]) @ T


def main() -> dict[str, np.ndarray]:
    (source, target, T_true), off, k = two_scans(), {}, [0, 1, 2, 3, 5, 10, 20, 40]
    print("after      ", *(f"{n:4}" for n in k), "steps")
    for way in (onto_points, onto_lines):
        xi = se2_log(se2_inverse(T_true) @ [T for T, _, _ in icp(source, target, way)])
        off[way.__name__] = mm = 1000 * np.linalg.norm(xi[:, :2], axis=1)
        print(f"{way.__name__:11}", *(f"{n:4.0f}" for n in mm[k]), "mm off")
    return off


if __name__ == "__main__":
    main()
