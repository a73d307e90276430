"""Nothing is compiled while a run goes on: a robot would stand still for seconds."""

import os
import subprocess
import sys

import pytest

SCRIPT = """
import sys
from dataclasses import replace

import numpy as np
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


def close_loops(with_scale):
    from odomap.files.vocabulary import Vocabulary
    from odomap.vision.matching import MatchConfig
    from system.circuits import CAMERA, PIXELS, SCALE, Circuit, Walls, around
    from system.test_closing import Mistaken, closer_of, go

    words = Vocabulary.load()
    wrong = Mistaken(CAMERA, np.eye(4), PIXELS, SCALE, with_scale, MatchConfig())
    for check in (None, wrong):
        circuit = Circuit(around(80), Walls.make(), seed=1, scale=0.03 * with_scale)
        changes = go(circuit, closer_of(circuit, words, with_scale, check))
        loops = [loop for change in changes for loop in change.loops]
        assert loops
        assert any(loop.is_accepted for loop in loops) == (check is None)
    from adjustworlds import adjust_world
    from system.test_globaladjustment import adjust

    adjust(adjust_world(deep=not with_scale))


for name in sys.argv[2:]:
    sensors = "mono,depth" if name == "rgbd" else "stereo"
    frames = 24 if name in ("mono", "stereo-flow") else 14
    world = f"sim:room?seed=3&frames={frames}&sensors={sensors}&resolution=400x250"
    source, config = odomap.open(world), preset(name)
    config = replace(config, closing=replace(config.closing, enabled=sys.argv[1] == "closing"))
    slam = odomap.Slam(source.rig, config)
    for module in needed_modules():
        warm_up(module)
    before = signatures()
    for frame in source:
        slam.track(frame)
    slam.finish()
    assert slam.map.num_keyframes > 1, name
    if config.closing.enabled:
        close_loops(name == "mono")
    after = signatures()
    new = [key for key in after if after[key] != before.get(key, 0)]
    print(name, "compiled", new)
"""


def compiled(*arguments):
    """Return lines of what was compiled while runs went on."""
    path = os.pathsep.join(sys.path)  # the tests' own rooms, too
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, *arguments],
        capture_output=True,
        text=True,
        timeout=500,
        env={**os.environ, "PYTHONPATH": path},
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


PRESETS = ["stereo", "rgbd", "mono", "stereo-flow"]


@pytest.mark.parametrize(
    ("closing", "presets"),
    [("open", PRESETS), ("closing", ["stereo", "rgbd"]), ("closing", ["mono"])],
)
def test_what_a_run_needs_is_compiled_before(closing, presets):
    assert compiled(closing, *presets) == [f"{name} compiled []" for name in presets]
