"""Your own camera: calibrate it with a chessboard, then follow it through your own video.

    python examples/11_own_camera.py BOARD_PICTURES 9x6 0.025 VIDEO    # inner corners, metres

which is `odomap calibrate BOARD_PICTURES --board 9x6 --square 0.025` and then
`odomap run VIDEO --rig rig.yaml`. Without arguments it makes pictures and a video of its own.
"""

import sys
import tempfile
from pathlib import Path

import cv2

import odomap
from odomap.calibrate import calibrate
from odomap.simulation.board import board_views, write_board_views

WORLD = {"kind": "room", "seed": 4, "frames": 40, "sensors": ("mono",), "calibration_px": 0.0}


def record(folder: Path) -> tuple[odomap.World, list[str]]:
    """Stand in for a person: take pictures of a board, and a video of a room."""
    world = odomap.World.make(**WORLD)
    camera = world.rig.cameras[0].camera
    write_board_views(board_views(camera, seed=1, count=15), folder / "board")
    video, code = str(folder / "room.avi"), cv2.VideoWriter.fourcc(*"MJPG")
    writer = cv2.VideoWriter(video, code, world.spec.rate_hz, camera.resolution, isColor=False)
    for index in range(len(world)):
        writer.write(world.frame(index).images[0])
    writer.release()
    return world, [str(folder / "board"), "9x6", "0.025", video]


def main(*arguments: str) -> dict[str, float]:
    with tempfile.TemporaryDirectory() as folder:
        world, arguments = (None, arguments) if arguments else record(Path(folder))
        pictures, board, square, video = arguments
        found = calibrate(pictures, board=board, square=float(square))
        camera = found.rig.cameras[0].camera
        print(*found.warnings, f"focal length {camera.fx:.1f} px", sep="\n")
        result = odomap.run(video, rig=found.rig)
        print(result.failure or f"{len(result.trajectory)} frames placed")
        if world is None:
            return {}
        stamps = world.truth.stamps_ns - world.truth.stamps_ns[0]
        truth = odomap.Trajectory(stamps, world.truth.Ts_world_body)
        error = odomap.ate(result.trajectory, truth, "sim3")
        print(
            f"true focal length {world.rig.cameras[0].camera.fx:.1f} px, ATE {error.percent:.1f} %"
        )
        return {"focal": camera.fx, "percent": error.percent}


if __name__ == "__main__":
    main(*sys.argv[1:])
