"""LeGO-LOAM's two steps: what the ground says of a pose, and what edges say of it.

Run it with `python examples/44_two_steps.py`; docs/lesson/04_lidar_slam.md explains it.
"""

import numpy as np

import odomap
from odomap.geometry.lie import se3_exp, se3_inverse, se3_log
from odomap.lidar.deskew import deskew
from odomap.lidar.featureconfig import LegoConfig
from odomap.lidar.featurematching import EDGES, GROUND, FeatureStage, match_features
from odomap.lidar.features import LocalFeatures
from odomap.lidar.lego import LEVEL, UPRIGHT, LegoFrontEnd
from odomap.lidar.sweeps import points_of

Array = np.ndarray
TOWN = "sim:street?sensors=lidar3d&seed=2&beams=16&columns=900"
OFF = np.array([0.3, -0.2, 0.1, 0.01, -0.01, 0.02])  # of the first guess: x y z roll pitch yaw
WAYS = {
    "the ground alone": (FeatureStage(GROUND),),
    "edges alone": (FeatureStage(EDGES, reach=2.0),),
    "in turn, then all": (
        FeatureStage(GROUND, LEVEL, reach=2.0),  # z, roll, pitch
        FeatureStage(EDGES, UPRIGHT, reach=2.0),  # x, y, yaw
        FeatureStage(),
    ),
}


def main() -> dict[str, Array]:
    source, front_end, results, free = odomap.open(TOWN), LegoFrontEnd(), {"the guess": OFF}, {}
    Ts, local = source.truth.Ts_world_body, LocalFeatures(LegoConfig().map)
    for k in range(30, 42):
        xi = 10 * se3_log(se3_inverse(Ts[k]) @ Ts[k + 1])
        seen = front_end.prepare(points_of(source.frame(k).cloud, source.rig.lidars[0]))
        if k < 41:
            local.insert(seen, Ts[k], xi)
    points, rest = deskew(seen.points, seen.times, xi), (seen.kinds, local.planes, local.edges)
    for name, stages in WAYS.items():
        found = match_features(points, *rest, Ts[41] @ se3_exp(OFF), stages)
        results[name] = se3_log(se3_inverse(Ts[41]) @ found.T_map_body)
        free[name] = found.reason.count("translation") + found.reason.count("rotation")
    for name, off in results.items():
        way = "{:4.0f} {:4.0f} {:3.0f} mm".format(*(1000 * off[:3] + 0.0))
        turn = "{:5.2f} {:5.2f} {:5.2f} deg".format(*np.degrees(off[3:]))
        print(f"{name:17}: off by {way}, {turn}; {free.get(name, 6)} directions free")
    return results


if __name__ == "__main__":
    main()
