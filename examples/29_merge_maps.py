"""Two recordings of one room, mapped apart, each in a world of its own: one map of both.

Run it with `python examples/29_merge_maps.py`; chapter 3c of docs/lesson explains it.
"""

from dataclasses import replace

import numpy as np

import odomap

LATER_NS = 3_600_000_000_000  # the second recording is made an hour later


def mapped(rig: odomap.Rig, frames: list[odomap.Frame]) -> odomap.Map:
    """Return the map of a recording; its world begins where the recording does."""
    config = odomap.preset("rgbd")
    config = replace(config, closing=replace(config.closing, enabled=False))
    system = odomap.Slam(rig, config)
    for frame in frames:
        system.track(frame)
    return system.finish().map


def tell(name: str, map: odomap.Map, truth: odomap.Trajectory) -> float:
    """Print what a map holds; return the ATE of its keyframes, mm."""
    ids = map.keyframe_ids
    stamps = np.array([map.keyframe(k).stamp_ns for k in ids])
    order = np.argsort(stamps)
    path = odomap.Trajectory(stamps[order], map.Ts_world_body(ids)[order])
    off = 1000 * odomap.ate(path, truth).rmse
    print(f"{name}: {len(ids)} keyframes, {map.num_landmarks} landmarks, ATE {off:.0f} mm")
    return float(off)


def main() -> dict[str, float]:
    source = odomap.open("sim:room?seed=4&frames=108&sensors=mono,depth&speed=3")
    rig, truth, frames = source.rig, source.truth, list(source)  # once round takes 95
    later = [replace(frame, stamp_ns=frame.stamp_ns + LATER_NS) for frame in frames]
    stamps = np.append(truth.stamps_ns, truth.stamps_ns + LATER_NS)
    both = odomap.Trajectory(stamps, np.tile(truth.Ts_world_body, (2, 1, 1)))
    first, second = mapped(rig, frames[:60]), mapped(rig, later[50:])
    results = {name: tell(name, map, both) for name, map in (("first", first), ("second", second))}
    found = odomap.merge_maps(first, second, rig=rig)
    print(found.summary)
    results["merged"] = tell("merged", found.map, both)
    off = truth.pose(50).inverse() @ truth.pose(0) @ odomap.SE3(found.T_first_second)
    results["off"] = 1000 * float(np.linalg.norm(off.t))
    print(f"the second world lies in the first to {results['off']:.0f} mm")
    return results | {"places": found.num_places}


if __name__ == "__main__":
    main()
