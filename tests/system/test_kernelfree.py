"""A laser loads nothing of cameras: neither OpenCV nor kernels that look at images."""

import subprocess
import sys

SCRIPT = """
import sys
import odomap.system.config
assert "numba" not in sys.modules, "the configuration is to be read without kernels"
import odomap.system.laserslam
import odomap.system.scanthinning
assert "cv2" not in sys.modules
import odomap
from odomap.kernels import needed_modules
source = odomap.open("sim:building?sensors=laser&frames=3")
slam = odomap.Slam(source.rig)
for frame in source:
    slam.track(frame)
slam.finish()
seen = [n for n in needed_modules() if n.startswith("odomap.vision") or "bundle" in n or "pnp" in n]
assert not seen, seen
"""


def test_a_laser_loads_nothing_of_cameras():
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
