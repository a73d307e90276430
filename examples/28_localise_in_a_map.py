"""A map is saved; later a camera finds itself in it, and again after it was carried away blind.

Run it with `python examples/28_localise_in_a_map.py`; chapter 3c of docs/lesson explains it.
"""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

import odomap


def blindfold(frames: list[odomap.Frame]) -> list[odomap.Frame]:
    """Return frames of a visit: four are black, and after them the camera is 3 m further on."""
    black = [np.zeros_like(image) for image in frames[0].images]
    dark = [replace(frame, images=black, depth=0 * frame.depth) for frame in frames[8:12]]
    return [*frames[:8], *dark, *frames[22:]]


def main() -> dict[str, float]:
    room = "sim:room?seed=4&sensors=mono,depth"
    source, config = odomap.open(f"{room}&frames=66&speed=3"), odomap.preset("rgbd")
    config = replace(config, closing=replace(config.closing, enabled=False))
    system = odomap.Slam(source.rig, config)
    for frame in source:
        system.track(frame)
    file = Path(tempfile.mkdtemp()) / "room.odomap"
    odomap.save_map(file, system.finish().map, source.rig)
    print(f"a map of {system.map.num_keyframes} keyframes, {file.stat().st_size / 1e6:.1f} MB")

    visit = odomap.open(f"{room}&frames=32&speed=5")  # another walk through the same room
    visitor = odomap.Slam(visit.rig, config, map=odomap.load_map(file), is_mapping=False)
    off, states = [], []
    for frame in blindfold(list(visit)):
        estimate = visitor.track(frame)
        states.append(estimate.status)
        T_true = source.truth.pose(0).inverse() @ visit.truth.interpolate([frame.stamp_ns]).pose(0)
        off.append(np.linalg.norm(estimate.T_world_body.t - T_true.t))
    is_lost = np.array([state is odomap.Status.LOST for state in states])
    off_mm = 1000 * np.array(off)[~is_lost]
    print(f"the first frame is {states[0].value}, off by {off_mm[0]:.0f} mm")
    print(f"lost in {is_lost.sum()} frames: 4 were black; then {states[12].value} at once")
    print(f"off by {np.median(off_mm):.0f} mm in the median, by {off_mm.max():.0f} mm at most")
    return {"lost": int(is_lost.sum()), "off_mm": float(off_mm.max())}


if __name__ == "__main__":
    main()
