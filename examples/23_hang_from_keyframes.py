"""A loop closes: what hangs from keyframes follows, what was stored in the world stays behind.

Run it with `python examples/23_hang_from_keyframes.py`; docs/lesson/03_orb_slam.md explains it.
"""

import numpy as np

from odomap import SE3, Map, PoseGraph, solve
from odomap.maps.keyframes import Keyframe
from odomap.maps.snapshot import Update

STEP, FRAMES, BETWEEN = SE3.exp([0.1, 0, 0, 0, 0, 2 * np.pi / 240]), 241, 4  # one round, 24 m


def walk(sigma: float) -> list[SE3]:
    """Return where all frames are when each step is off by so much, in metres and radians."""
    rng, Ts = np.random.default_rng(1), [SE3.identity()]
    for _ in range(FRAMES - 1):
        Ts.append(Ts[-1] @ STEP @ SE3.exp(sigma * rng.standard_normal(6)))
    return Ts


def rms(found: np.ndarray, true: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum((found - true) ** 2, axis=1))))


def main() -> dict[str, np.ndarray]:
    true, found, map, hung, points = walk(0.0), walk(0.002), Map(), [], []
    for n, T in enumerate(found):
        if n % BETWEEN == 0:
            k, T_world_keyframe = map.new_keyframe_id(), T
            map.add_keyframe(Keyframe(k, n), T.matrix)
            p_keyframe = np.random.default_rng(n).uniform(-3, 3, (20, 3))
            map.add_landmarks(k, p_keyframe)
            points.append(true[n] @ p_keyframe)
        hung.append((k, (T_world_keyframe.inverse() @ T).matrix))  # frame n, seen from k
    Ts = map.Ts_world_body(map.keyframe_ids)
    first, edges = np.arange(len(Ts)), np.linalg.inv(Ts) @ np.roll(Ts, -1, axis=0)
    edges[-1] = (true[-1].inverse() @ true[0]).matrix  # the last sees the first place again
    solved = solve(PoseGraph("SE3", Ts, first, np.roll(first, -1), edges, [np.eye(6)] * len(Ts)))
    map.cull_keyframes(first[1:-1:2])  # every second one goes; frames and landmarks hang on
    kept, nothing = map.keyframe_ids, (np.empty(0, np.int64), np.empty((0, 3)))
    before, Ts = map.points_world(map.landmark_ids), solved.Ts_world_node
    map.apply(Update(0, Ts[0], kept, Ts[kept], *nothing, map.version))  # the one write
    print(f"{len(kept)} poses written; {FRAMES} frames and {len(before)} landmarks to follow")
    truth, stale = (np.array([T.t for T in path]) for path in (true, found))
    hanging, results = np.array([map.place(k, T)[:3, 3] for k, T in hung]), {}
    stale[::BETWEEN] = hanging[::BETWEEN]  # keyframes are corrected, frames keep their poses
    for name, path in (("stored in the world", stale), ("hung from keyframes", hanging)):
        off, jump = rms(path, truth), np.linalg.norm(np.diff(path, axis=0), axis=1).max()
        results[name] = path
        print(f"frames {name}: off by {off:.2f} m, steps of up to {jump:.2f} m")
    off = [rms(p, np.concatenate(points)) for p in (before, map.points_world(map.landmark_ids))]
    print(f"landmarks: off by {off[0]:.2f} m before, {off[1]:.2f} m after")
    return results


if __name__ == "__main__":
    main()
