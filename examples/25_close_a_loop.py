"""Once round a room and a bit: places are proposed by words, refused or measured, and closed.

Run it with `python examples/25_close_a_loop.py`; docs/lesson/03c_closing_loops.md explains it.
"""

from dataclasses import replace

import numpy as np

import odomap
from odomap.system.stages import Loop


def walk(
    rig: odomap.Rig, frames: list[odomap.Frame], is_closing: bool
) -> tuple[odomap.Result, list[Loop]]:
    """Return the result of a run, and the candidates that were decided on."""
    config = odomap.preset("rgbd")
    config = replace(config, closing=replace(config.closing, enabled=is_closing))
    system, loops = odomap.Slam(rig, config), []
    system.worker.on_loop.append(loops.append)
    for frame in frames:
        system.track(frame)
    return system.finish(), loops


def between(path: odomap.Trajectory, stamps_ns: list[int]) -> odomap.SE3:
    """Return the pose of the second moment in that of the first."""
    first, second = (path.interpolate([stamp]).pose(0) for stamp in stamps_ns)
    return first.inverse() @ second


def main() -> dict[str, float]:
    source = odomap.open("sim:room?seed=4&frames=84&sensors=mono,depth&speed=4")
    rig, frames, truth, results = source.rig, list(source), source.truth, {}
    (without, _), (closed, loops) = (walk(rig, frames, closing) for closing in (False, True))
    accepted = [loop for loop in loops if loop.is_accepted]
    print(f"{len(loops) - len(accepted)} candidates refused; the first: {loops[0].reason}")
    loop, map = accepted[0], closed.map
    ends = loop.matched_id, loop.keyframe_id
    print(f"keyframe {ends[1]} is back at {ends[0]}: {loop.num_inliers} points agree")
    stamps = [map.keyframe(k).stamp_ns for k in ends]
    T_true, T_said = (between(path, stamps) for path in (truth, without.trajectory))
    for name, T in (("path", T_said), ("loop", odomap.SE3(loop.T_matched_keyframe))):
        results[name] = 1000 * np.linalg.norm((T_true.inverse() @ T).t)
        print(f"the pose between the two, as the {name} has it: off by {results[name]:.0f} mm")
    for name, result in (("without", without), ("with", closed)):
        results[name] = 1000 * odomap.ate(result.trajectory, truth).rmse
        print(f"ATE {name} it: {results[name]:.0f} mm")
    return results


if __name__ == "__main__":
    main()
