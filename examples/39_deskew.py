"""A sweep and the motion within it: how far points are off the walls they were measured on.

Run it with `python examples/39_deskew.py`; docs/lesson/04_lidar_slam.md explains it.
"""

import numpy as np

import odomap
from odomap.geometry.lie import se3_inverse, se3_log
from odomap.lidar.deskew import deskew

Array = np.ndarray
TOWN = "sim:street?sensors=lidar3d&seed=1&beams=32&columns=900&speed=12"
PLACES = {"straight on": 10, "round a corner": 210}  # sweeps


def twist(source: odomap.Source, k: int) -> Array:
    """Return (6,) how the LiDAR truly moves over sweep k, per second."""
    T, T_next = source.truth.Ts_world_body[k : k + 2]
    return se3_log(se3_inverse(T) @ T_next) * source.rig.lidars[0].rate_hz


def walls(source: odomap.Source, k: int) -> tuple[Array, Array, Array, Array]:
    """Return of points on walls: as measured, times; true places and normals as of the stamp."""
    sweep, true = source.frame(k).cloud, source.world.sweep_truth(k)
    on, T_stamp = true.kinds == 1, source.truth.Ts_world_body[k]  # 1: buildings
    seconds = k / source.rig.lidars[0].rate_hz + sweep.times[on]
    Ts = se3_inverse(T_stamp) @ source.world.path.at(seconds).Ts_world_body
    places = np.einsum("nij,nj->ni", Ts[:, :3, :3], true.points[on]) + Ts[:, :3, 3]
    normals = np.einsum("nij,nj->ni", Ts[:, :3, :3], true.normals[on])
    return sweep.points[on], sweep.times[on], places, normals


def ways(points: Array, times: Array, xi: Array, xi_before: Array) -> dict[str, Array]:
    """Return points after each way of treating them."""
    return {
        "as they came": points,
        "p' = exp(xi t) p": deskew(points, times, xi),
        "the same, xi of the sweep before": deskew(points, times, xi_before),
        "p' = exp(-xi t) p": deskew(points, times, -xi),
        "stamp taken for the middle": deskew(points, times - 0.05, xi),
    }


def main() -> dict[str, dict[str, float]]:
    source, results = odomap.open(TOWN), {}
    for name, k in PLACES.items():
        (points, times, places, normals), xi = walls(source, k), twist(source, k)
        print(f"{name}: {xi[0]:.1f} m/s, {np.degrees(xi[5]):.0f} deg/s; {len(points)} on walls")
        results[name] = {}
        for way, p in ways(points, times, xi, twist(source, k - 1)).items():
            off = 1000 * np.abs(np.sum(normals * (p - places), axis=1))
            results[name][way], tenth = np.percentile(off, [50, 90])
            print(f"  {way:32}: half are {results[name][way]:3.0f} mm off, a tenth {tenth:4.0f}")
    return results


if __name__ == "__main__":
    main()
