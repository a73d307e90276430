"""Play a recording through odomap at the pace of its sensor, as the peer's script does.

    python ours.py DATA PREFIX [--preset NAME] [--odometry-only] [--frames N] [--cv-threads N]
                   [--fast] [--rhythm R] [--set NAME=VALUE]

Writes PREFIX.tum and PREFIX.json (see `meter`). A frame is read and decoded before it is due; its
tracking starts when it is due, or at once where the system is late. The whole call is timed, with
the waiting for mapping that the rhythm asks for. `sequences.py` runs this.
"""

import argparse
import sys
import time
from pathlib import Path

import cv2
from meter import Meter

from odomap.errors import OdomapError
from odomap.files.trajectories import write_tum
from odomap.kernels import needed_modules, warm_up
from odomap.maps.estimate import Status
from odomap.run import RHYTHM, chosen_config
from odomap.sources.open import open as open_source
from odomap.system.config import odometry_preset
from odomap.system.odometry import make_odometry
from odomap.system.rhythms import RHYTHMS
from odomap.system.slam import Slam


def main() -> None:
    try:
        play(_options())
    except OdomapError as error:
        sys.exit(str(error))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("data")
    parser.add_argument("prefix")
    parser.add_argument("--frames", type=int, default=0)
    parser.add_argument("--preset", help="default the one for what the recording carries")
    parser.add_argument("--odometry-only", action="store_true", help="no SLAM: plain odometry")
    parser.add_argument("--cv-threads", type=int, default=0, help="default 1, as in odomap run")
    parser.add_argument("--fast", action="store_true", help="do not wait for the sensor")
    parser.add_argument("--rhythm", choices=RHYTHMS, default=RHYTHM)
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE")
    return parser.parse_args()


def play(options: argparse.Namespace) -> None:
    """Track every frame when it is due, and write what came of it."""
    cv2.setNumThreads(options.cv_threads or 1)
    source = open_source(options.data)
    assignments = [
        (name, value) for name, _, value in (text.partition("=") for text in options.set)
    ]
    usual = odometry_preset(source.rig) if options.odometry_only else None
    config = chosen_config(options.preset or usual, None, assignments, source.rig)
    make = make_odometry if options.odometry_only else Slam
    system = make(source.rig, config, options.rhythm)
    for name in needed_modules():
        warm_up(name)
    meter = Meter()
    start, first = 0.0, 0
    statuses: list[Status] = []
    stall_ms: list[float] = []
    for count, frame in enumerate(source):
        if count == (options.frames or len(source)):
            break
        if count == 0:
            start, first = time.perf_counter(), frame.stamp_ns
        due = start + 1e-9 * (frame.stamp_ns - first)
        if not options.fast:
            time.sleep(max(0.0, due - time.perf_counter()))
        estimate = meter.call(system.track, frame)
        statuses.append(estimate.status)
        stall_ms.append(estimate.timing.get("wait", estimate.timing.get("map", 0.0)))
    trajectory = system.finish().trajectory
    write_tum(Path(f"{options.prefix}.tum"), trajectory)
    told = {"lost": lost(statuses), "stall_ms": stall_ms}
    meter.write(f"{options.prefix}.json", len(trajectory), cv2.getNumThreads(), **told)


def lost(statuses: list[Status]) -> int:
    """Return how many frames could not be placed where the path was, once it had begun.

    One that starts anew after a loss was not placed either.
    """
    began = statuses.index(Status.TRACKING) if Status.TRACKING in statuses else len(statuses)
    placed = Status.TRACKING, Status.RECOVERED
    return sum(status not in placed for status in statuses[began:])


if __name__ == "__main__":
    main()
