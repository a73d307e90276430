"""What a system makes of faults of its cameras: is a pose right, or said not to be known?

    python benchmarks/faults.py [--systems "Slam stereo" StereoVO ...] [--faults NAME ...]
                                [--seed 3] [--reasons] [--json FILE]

A simulated room is seen by a stereo pair, a single camera and a camera with depth, and disturbed:
darkness, glare, frozen, doubled and dropped frames, exposure steps, a hand over the lens, an object
filling a third of the view, blur, a dead right camera, a turn on the spot. Per system and fault:
frames without a pose, the largest error while a pose was claimed, leaps, and how many rules were
broken (`tests/faultworlds.py` has the rules). The exit code is 1 where one was.
"""

import argparse
import json
import sys
from collections import Counter
from dataclasses import asdict
from pathlib import Path

from odomap.maps.estimate import Status
from odomap.system.odometry import MonocularVO, RgbdVO, StereoVO
from odomap.system.slam import Slam

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from faultworlds import SPEC, Recordings, faults_of, judge

SYSTEMS = {
    "Slam stereo": ("stereo", Slam),
    "Slam mono": ("mono", Slam),
    "Slam rgbd": ("rgbd", Slam),
    "StereoVO": ("stereo", StereoVO),
    "MonocularVO": ("mono", lambda rig: MonocularVO(rig.cameras[0].camera)),
    "RgbdVO": ("rgbd", RgbdVO),
}
DEFAULT = [name for name in SYSTEMS if name.startswith("Slam")]


def main() -> int:
    options = _options()
    recordings = Recordings(options.seed)
    rows = []
    print(
        f"{'system':14}{'fault':24}{'lost':>5}{'off, m':>8}{'off, °':>8}{'leaps':>7}{'broken':>8}"
    )
    for name in options.systems:
        sensors, make = SYSTEMS[name]
        for fault in faults_of(sensors):
            if options.faults and fault not in options.faults:
                continue
            source = recordings.disturbed(sensors, fault)
            system = make(source.rig)
            estimates = [system.track(frame) for frame in source]
            found = judge(source, estimates, system.finish().is_metric)
            rows.append({"system": name, "fault": fault, **asdict(found)})
            print(
                f"{name:14}{fault:24}{found.num_lost:5}{found.largest_m:8.3f}"
                f"{found.largest_deg:8.2f}{found.num_leaps:7}{len(found.wrong):8}"
                f"{'' if found.is_tracking else '  lost at the end'}",
                flush=True,
            )
            if options.reasons:
                _print_reasons(estimates, found.wrong)
    if options.json:
        Path(options.json).write_text(json.dumps(rows, indent=1), encoding="utf-8")
    return 1 if any(row["wrong"] or not row["is_tracking"] for row in rows) else 0


def _print_reasons(estimates, wrong) -> None:
    """Say what was said of the frames without a pose, and which rules were broken."""
    unplaced = (e for e in estimates if e.status in (Status.LOST, Status.INITIALIZING))
    for reason, count in Counter(e.reason for e in unplaced).items():
        print(f"    {count} × {reason}")
    for line in wrong:
        print(f"    broken: {line}")


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--systems", nargs="+", choices=SYSTEMS, default=DEFAULT)
    parser.add_argument(
        "--faults", nargs="+", choices=faults_of("stereo"), metavar="NAME", help="default all"
    )
    parser.add_argument("--seed", type=int, default=SPEC.seed, help="of the room")
    parser.add_argument(
        "--reasons", action="store_true", help="print what was said, and what broke"
    )
    parser.add_argument("--json", help="write all numbers here")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
