"""There and back, four times: an odometry begins anew each time, a map is used again.

Run it with `python examples/18_odometry_forgets.py`; docs/lesson/03_orb_slam.md explains it.
"""

from dataclasses import replace

import numpy as np

import odomap

FRAMES, ROUNDS = 16, 4
ORDER = [*np.tile([*range(FRAMES - 1), *range(FRAMES - 1, 0, -1)], ROUNDS).tolist(), 0]


def walk(source: odomap.Source) -> list[odomap.Frame]:
    """Return frames of a walk there and back, again and again, with stamps that go on."""
    frames = list(source)
    first, step = frames[0].stamp_ns, frames[1].stamp_ns - frames[0].stamp_ns
    return [replace(frames[k], id=i, stamp_ns=first + i * step) for i, k in enumerate(ORDER)]


def main() -> dict[str, list[tuple[float, int, int]]]:
    source = odomap.open(f"sim:room?seed=4&frames={FRAMES}&sensors=mono,depth&speed=3")
    frames, results = walk(source), {}
    systems = {"RgbdVO": odomap.RgbdVO(source.rig), "Slam": odomap.Slam(source.rig)}
    for name, system in systems.items():
        results[name] = []
        for i, frame in enumerate(frames):
            T_world_body = system.track(frame).T_world_body
            if i and ORDER[i] == 0:  # where the walk began, which is the origin
                off = 1000 * np.linalg.norm(T_world_body.t)
                keyframes, landmarks = system.map.num_keyframes, system.map.num_landmarks
                results[name].append((off, keyframes, landmarks))
                number = len(results[name])
                print(
                    f"{name:6} round {number}: off by {off:.0f} mm,"
                    f" {keyframes} keyframes, {landmarks} landmarks"
                )
    return results


if __name__ == "__main__":
    main()
