"""One sweep of 16 beams laid onto another in four ways, from guesses ever farther off.

Run it with `python examples/41_four_methods.py`; docs/lesson/04_lidar_slam.md explains it.
"""

import numpy as np

import odomap
from odomap.geometry.lie import se3_exp, se3_inverse, se3_log
from odomap.lidar.deskew import deskew

Array = np.ndarray
TOWN = "sim:street?sensors=lidar3d&seed=5&beams=16&columns=600"
PAIRS = [(k, k + 4) for k in range(20, 500, 60)]  # 3 m apart


def as_of_its_stamp(source: odomap.Source, k: int) -> Array:
    """Return the points of sweep k, deskewed by the true motion."""
    cloud, (T, T_next) = source.frame(k).cloud, source.truth.Ts_world_body[k : k + 2]
    return deskew(cloud.points, cloud.times, 10 * se3_log(se3_inverse(T) @ T_next))


def errors(source: odomap.Source, clouds: dict[int, Array], method: str, metres: float) -> Array:
    """Return how far off each pair ends, from guesses that are off by some metres, and turned."""
    rng, off = np.random.default_rng(0), []
    for a, b in PAIRS:
        T_true = se3_inverse(source.truth.Ts_world_body[a]) @ source.truth.Ts_world_body[b]
        way = rng.uniform(-np.pi, np.pi)
        wrong = metres * np.array([np.cos(way), np.sin(way), 0, 0, 0, rng.choice([-0.03, 0.03])])
        found = odomap.register(clouds[b], clouds[a], method, initial=T_true @ se3_exp(wrong))
        off.append(np.linalg.norm((se3_inverse(T_true) @ found.T_target_source)[:3, 3]))
    return np.array(off)


def main() -> dict[str, list[Array]]:
    source, results = odomap.open(TOWN), {}
    clouds = {k: as_of_its_stamp(source, k) for pair in PAIRS for k in pair}
    for method in ("icp", "plane", "gicp", "ndt"):
        results[method] = [errors(source, clouds, method, metres) for metres in (1, 3, 6)]
        said = (f"{1000 * np.median(e):2.0f} mm, {np.sum(e > 0.5)} lost" for e in results[method])
        print(f"{method:5} from 1, 3, 6 m off:", "; ".join(said))
    return results


if __name__ == "__main__":
    main()
