"""Nothing is compiled while a run goes on: a robot would stand still for seconds."""

import subprocess
import sys

SCRIPT = """
import sys
import odomap
from odomap.kernels import needed_modules, warm_up
from odomap.system.config import preset

def signatures():
    return {
        (name, key): len(value.signatures)
        for name, module in list(sys.modules.items()) if name.startswith("odomap")
        for key, value in vars(module).items()
        if hasattr(value, "signatures") and value.__module__ == name
    }

for name, data in (
    ("stereo", "sim:room?seed=3&frames=14"),
    ("rgbd", "sim:room?seed=3&frames=14&sensors=mono,depth"),
    ("mono", "sim:room?seed=3&frames=24"),
    ("stereo-flow", "sim:room?seed=3&frames=24"),
):
    source = odomap.open(data)
    slam = odomap.Slam(source.rig, preset(name))
    for module in needed_modules():
        warm_up(module)
    before = signatures()
    for frame in source:
        slam.track(frame)
    slam.finish()
    assert slam.map.num_keyframes > 1, name
    after = signatures()
    new = [key for key in after if after[key] != before.get(key, 0)]
    print(name, "compiled", new)
"""


def test_what_a_run_needs_is_compiled_before():
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], capture_output=True, text=True, timeout=500
    )
    assert done.returncode == 0, done.stderr
    said = done.stdout.splitlines()
    assert len(said) == 4
    assert all(line.endswith("compiled []") for line in said), done.stdout
