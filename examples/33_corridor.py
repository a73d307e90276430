"""What two scans say of the motion between them, and what they do not: a hall, a corridor.

Run it with `python examples/33_corridor.py`; docs/lesson/04_lidar_slam.md explains it.
"""

import numpy as np

import odomap
from odomap.geometry.lie import se2_exp, se2_inverse, se2_log
from odomap.geometry.planar import between_planar, planar_matrix, to_plane
from odomap.lidar.scans import Beams

Array = np.ndarray
WHEELS = np.diag([0.03, 0.01, 0.01]) ** 2  # covariance of half a metre: ahead, sideways, heading


def two_scans(kind: str) -> tuple[Array, Array, Array, Array]:
    """Return two scans 10 frames apart, and the second pose in the first: true, and by wheels."""
    source = odomap.open(f"sim:{kind}?sensors=laser&seed=1&beams=271")
    middle = int(np.argmin(np.linalg.norm(source.truth.positions[:, :2], axis=1)))
    pair, beams = [middle, middle + 10], Beams(source.rig.lidars[0])
    first, second = (beams.points(source.frame(k).scan).hits for k in pair)
    true, wheels = (to_plane(Ts[pair]) for Ts in (source.truth.Ts_world_body, source.odometry))
    return first, second, *(planar_matrix(between_planar(*x)) for x in (true, wheels))


def fused(T_wheels: Array, T_scan: Array, information: Array) -> Array:
    """Return the pose between what wheels and scan say, each as sure as it claims to be."""
    off = se2_log(se2_inverse(T_wheels) @ T_scan)
    both = np.linalg.inv(WHEELS) + information
    return T_wheels @ se2_exp(np.linalg.solve(both, information @ off))


def main() -> dict[str, float]:
    results = {}
    for kind in ("hall", "corridor"):
        first, second, T_true, T_wheels = two_scans(kind)
        found = odomap.register(second, first, "plane", max_distance=1.0)
        ended = "converged" if found.converged else "did not converge"
        print(f"{kind}: {ended}, pairs are {1000 * found.error:.0f} mm apart")
        print(f"  {found.reason or 'all directions are fixed'}")
        everywhere = np.diag(np.array([0.01, 0.01, 0.005]) ** -2)
        for name, T in {
            "scans alone": found.se2,
            "wheels alone": T_wheels,
            "both, scans sure to 1 cm everywhere": fused(T_wheels, found.se2, everywhere),
            "both, scans as sure as they say": fused(T_wheels, found.se2, found.information),
        }.items():
            along, across = 1000 * (se2_inverse(T_true) @ T)[:2, 2]
            results[f"{kind}, {name}"] = float(np.hypot(along, across))
            print(f"  {name:35}: off by {abs(along):5.1f} mm along, {abs(across):3.1f} mm across")
    return results


if __name__ == "__main__":
    main()
