"""Two ways to chain good motions into a wrong path: the inverse forgotten, the scale thrown away.

Run it with `python examples/06_pitfalls_path.py`; docs/lesson/02_visual_odometry.md explains it.
"""

import numpy as np

from odomap import SE3, Trajectory, World, ate


def motions(truth: Trajectory) -> list[SE3]:
    """Return T_cur_prev of each step, as recoverPose defines it: x_cur = R x_prev + t."""
    return [truth.pose(k).inverse() @ truth.pose(k - 1) for k in range(1, len(truth))]


def as_given(steps: list[SE3]) -> list[SE3]:
    """Wrong: the letters do not cancel, T_world_prev @ T_cur_prev."""
    Ts_world_camera = [SE3.identity()]
    for T_cur_prev in steps:
        Ts_world_camera.append(Ts_world_camera[-1] @ T_cur_prev)
    return Ts_world_camera


def inverted(steps: list[SE3]) -> list[SE3]:
    """Right: T_world_cur = T_world_prev @ T_prev_cur."""
    Ts_world_camera = [SE3.identity()]
    for T_cur_prev in steps:
        Ts_world_camera.append(Ts_world_camera[-1] @ T_cur_prev.inverse())
    return Ts_world_camera


def of_length_one(steps: list[SE3]) -> list[SE3]:
    """Forget how far each step went, as an essential matrix does."""
    return [SE3.from_parts(T.R, T.t / np.linalg.norm(T.t)) for T in steps]


def main() -> dict[str, float]:
    walk = World.make(kind="room", seed=0, frames=600, sensors=("mono",)).truth
    truth = walk.rows(np.unique((599 * np.linspace(0, 1, 120) ** 2).astype(int)))  # ever faster
    steps = motions(truth)
    lengths = [float(np.linalg.norm(T.t)) for T in steps]
    print(f"{truth.path_length:.1f} m in steps of {min(lengths):.2f} to {max(lengths):.2f} m")
    results = {}
    for name, path in (
        ("T_world_prev @ T_cur_prev", as_given(steps)),
        ("T_world_prev @ T_cur_prev.inverse()", inverted(steps)),
        ("the same, each step 1 long", inverted(of_length_one(steps))),
    ):
        error = ate(Trajectory.of_poses(truth.stamps_ns, path), truth, align="sim3")
        print(f"{name:35}: ATE {error.percent:4.1f} % of the path, {error.rot_rmse_deg:5.1f} deg")
        results[name] = error.percent
    return results


if __name__ == "__main__":
    main()
