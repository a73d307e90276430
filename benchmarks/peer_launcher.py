"""Run the peer's script in the peer's own Python, measured as odomap is.

    PEER_PYTHON peer_launcher.py METERS.json CV_THREADS SCRIPT ARGUMENTS...

The script prints medians over all frames; a comparison after warm-up needs every frame. So the
class that it calls is given a meter, and the script runs unchanged. CV_THREADS 0 leaves the
script's own choice of one thread.
"""

import runpy
import sys
from typing import Any

import cv2
import pyorbslam3
from meter import Meter


def main() -> None:
    path, cv_threads, *sys.argv = sys.argv[1:]
    meter = Meter()
    states: list[str] = []

    class Metered(pyorbslam3.Slam):
        pass

    def metered(name: str) -> Any:
        method = getattr(pyorbslam3.Slam, name)

        def track(self: Any, *args: Any, **kwargs: Any) -> Any:
            result = meter.call(method, self, *args, **kwargs)
            states.append(str(result.state).rsplit(".", 1)[-1])
            return result

        return track

    for name in ("track_stereo", "track_monocular", "track_rgbd"):
        if hasattr(pyorbslam3.Slam, name):
            setattr(Metered, name, metered(name))
    pyorbslam3.Slam = Metered
    set_threads = cv2.setNumThreads
    if int(cv_threads):
        cv2.setNumThreads = lambda _: set_threads(int(cv_threads))
    try:
        runpy.run_path(sys.argv[0], run_name="__main__")
    except SystemExit as end:
        if end.code:
            raise
    began = states.index("OK") if "OK" in states else len(states)
    lost = len(states) - began - states.count("OK")
    meter.write(path, states.count("OK"), cv2.getNumThreads(), lost=lost)


if __name__ == "__main__":
    main()
