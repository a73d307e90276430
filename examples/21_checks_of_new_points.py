"""Two views, many matches, some of them wrong: what keeps wrong points out of a map.

Run it with `python examples/21_checks_of_new_points.py`; docs/lesson/03_orb_slam.md explains it.
"""

import numpy as np

from odomap import SE3, Camera
from odomap.geometry.triangulate import triangulate

CAMERA = Camera(intrinsics=(450.0, 450.0, 320.0, 240.0), resolution=(640, 480))
COUNT, SIGMA_PX, SCALE = 4000, 0.7, 1.2
TS = [SE3.identity(), SE3.exp([0.3, 0, 0.2, 0, 0.05, 0]), SE3.exp([0.9, 0.1, 0.5, 0, 0.1, 0])]


def matches() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return true points, and (3, N, 2) pixels and (3, N) levels in three views."""
    rng = np.random.default_rng(2)
    rays = CAMERA.unproject(rng.uniform((20, 20), (620, 460), (COUNT, 2)))
    rays, z = rays / rays[:, 2:], 1.0 / rng.uniform(1 / 60, 1 / 2, (COUNT, 1))
    points, level = z * rays, rng.uniform(0.0, 7.0, COUNT)
    local = np.stack([T.inverse() @ points for T in TS])
    away = np.linalg.norm(local, axis=2)
    levels = np.rint(level + np.log(away[0] / away) / np.log(SCALE))  # nearer is larger
    noise = SIGMA_PX * rng.standard_normal((3, COUNT, 2)) * SCALE ** levels[:, :, None]
    pixels = np.stack([CAMERA.project(p) for p in local]) + noise
    # In the second view 15 % are something else, and 15 % something else on the same ray.
    other, kind = rng.permutation(COUNT), rng.uniform(size=(COUNT, 1))
    on_ray = CAMERA.project(TS[1].inverse() @ (z[other] * rays))
    pixels[1] = np.where(kind < 0.15, pixels[1, other], np.where(kind > 0.85, on_ray, pixels[1]))
    levels[1] = np.where(abs(kind[:, 0] - 0.5) > 0.35, levels[1, other], levels[1])
    return points, pixels, levels


def main() -> dict[str, tuple[int, float]]:
    (points, pixels, levels), kept, results = matches(), np.ones(COUNT, bool), {}
    for views in (2, 3):
        seen = [CAMERA.undistort(p) for p in pixels[:views]]
        found = triangulate([T.matrix for T in TS[:views]], seen)
        local = np.stack([T.inverse() @ found.points_world for T in TS[:views]])
        off = np.stack([CAMERA.project(p) for p in local]) - pixels[:views]
        fits = np.sum(off**2, axis=2) < 5.99 * (SIGMA_PX * SCALE ** levels[:views]) ** 2
        away = np.log(np.linalg.norm(local, axis=2)) / np.log(SCALE)
        contradiction = np.abs(away[1] - away[0] + levels[1] - levels[0])  # in levels
        checks = {"all matches": kept, "ahead of both": found.ahead}
        checks["parallax > 1.15 deg"] = found.parallax > np.radians(1.15)
        checks["both reprojections"] = fits.all(axis=0)
        checks["sizes and distances"] = contradiction < 1 + np.log(1.5) / np.log(SCALE)
        wrong = np.abs(found.points_world[:, 2] / points[:, 2] - 1) > 0.2
        for name, passed in (checks if views == 2 else {"a third view": fits.all(axis=0)}).items():
            kept = kept & passed
            results[name] = int(kept.sum()), 100 * float(wrong[kept].mean())
            print(f"{name:19}: {kept.sum()} points, {results[name][1]:4.1f} % of them wrong")
    return results


if __name__ == "__main__":
    main()
