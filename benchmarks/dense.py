"""Is the dense map where the surfaces are? Meshes of simulated rooms against their true surface.

A room is walked through, its keyframes are exported as `odomap export` does, and the mesh is judged
by the scene itself (`dense_truth`): how far it is from the true surface on average, how much of it
lies beyond 5 cm, and how much of what the cameras saw is covered. For depth from a sensor and from
stereo (SGBM); with true poses, which judges the fusing alone, and with those that odometry found.

    python benchmarks/dense.py [--seeds 3] [--frames 160] [--poses truth,estimate]

Bar: meshes of depth from a sensor have a mean distance under 2 cm; stereo's number is reported.
Exit code 1 where it is missed. Times are of this machine, images included.
"""

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from dense_truth import Quality, judge

import odomap
from odomap.export import Exported, export
from odomap.files.trajectories import read_tum, write_tum
from odomap.geometry.align import umeyama
from odomap.geometry.trajectory import Trajectory
from odomap.maps.depthviews import depth_views
from odomap.maps.surface import Surface
from odomap.sources.simulated import SimulatedSource

BAR_M = 0.02
STEP = 8
SENSORS = {"depth": "mono,depth", "stereo": "stereo"}


def main() -> int:
    options = _options()
    rows = [
        _row(seed, sensors, poses, options.frames)
        for sensors in options.sensors.split(",")
        for poses in options.poses.split(",")
        for seed in range(options.seeds)
    ]
    if options.json:
        Path(options.json).write_text(json.dumps(rows, indent=1), encoding="utf-8")
    missed = [r for r in rows if r["sensors"] == "depth" and not r["mean"] < BAR_M]
    for row in missed:
        print(f"missed: room {row['seed']}, poses of {row['poses']}: {100 * row['mean']:.2f} cm")
    return 1 if missed else 0


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", type=int, default=3, help="rooms")
    parser.add_argument("--frames", type=int, default=160, help="of each walk, at 20 per second")
    parser.add_argument("--sensors", default="depth,stereo", help="of depth, stereo")
    parser.add_argument("--poses", default="truth,estimate", help="of truth, estimate")
    parser.add_argument("--json", help="write the numbers here")
    return parser.parse_args()


def _row(seed: int, sensors: str, poses: str, frames: int) -> dict[str, object]:
    data = f"sim:room?seed={seed}&frames={frames}&sensors={SENSORS[sensors]}"
    start = time.perf_counter()
    quality, made = judged(data, poses)
    surface = made.surface
    print(
        f"room {seed} {sensors:7}{poses:9} voxel {made.config.voxel:g} m to "
        f"{made.config.max_depth:.1f} m, {made.keyframes} keyframes, "
        f"{len(surface.faces)} triangles in {made.seconds:.1f} s "
        f"({time.perf_counter() - start:.0f} s in all): {quality}",
        flush=True,
    )
    return {"seed": seed, "sensors": sensors, "poses": poses, **vars(quality)}


def judged(data: str, poses: str) -> tuple[Quality, Exported]:
    """Export a room with true or estimated poses and judge its mesh."""
    source = SimulatedSource(data)
    views = depth_views(source.rig)
    with tempfile.TemporaryDirectory(prefix="dense-") as scratch:
        folder = Path(scratch)
        if poses == "truth":
            keyframes = source.truth.rows(np.arange(0, len(source), STEP))
            write_tum(folder / "keyframes.tum", keyframes)
            (folder / "config.yaml").write_text(f"data: '{data}'\n", encoding="utf-8")
        else:
            odomap.run(data, folder)
        made = export(folder, folder / "cloud.ply", folder / "mesh.ply", picture=False)
        name = "keyframes.tum" if (folder / "keyframes.tum").exists() else "trajectory.tum"
        used = read_tum(folder / name)
    mesh = in_truth(made.surface, used, source.truth)
    true = source.truth.interpolate(used.stamps_ns).Ts_world_body
    cameras = true @ views.T_body_camera.matrix
    scene = source.world.scene
    return judge(mesh, scene, views.camera, cameras, made.config.max_depth), made


def in_truth(mesh: Surface, estimate: Trajectory, truth: Trajectory) -> Surface:
    """Move a mesh from the estimate's world to the true one, aligning the paths rigidly."""
    rows, true_rows = estimate.associate(truth)
    found = umeyama(estimate.positions[rows], truth.positions[true_rows])
    return Surface(
        (mesh.points @ found.R.T + found.t).astype(np.float32),
        (mesh.normals @ found.R.T).astype(np.float32),
        mesh.colours,
        mesh.faces,
    )


if __name__ == "__main__":
    sys.exit(main())
