import os
import subprocess
import sys

import pytest

from odomap.geometry import lens_kernels, lie_kernels, p3p_kernels, pnp_kernels

LIGHT = ("lie", "pose", "camera", "rectify", "undistort", "robust", "leastsquares", "ransac")
LIGHT += ("align", "trajectory", "triangulate", "fivepoint", "twoview", "pnp")


def test_geometry_loads_neither_numba_nor_opencv_before_it_needs_them():
    names = ", ".join(f"odomap.geometry.{name}" for name in LIGHT)
    code = f"import sys, {names}; print([m for m in ('numba', 'cv2', 'scipy') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("module", [lens_kernels, lie_kernels, p3p_kernels, pnp_kernels])
def test_warm_up_calls_every_kernel(module):
    module.warm_up()
    for name in module.__all__:
        kernel = getattr(module, name)
        if hasattr(kernel, "signatures"):
            assert len(kernel.signatures) >= 1, f"{name} is not called"


def test_kernels_run_as_plain_python():
    code = (
        "import numpy as np; from odomap.geometry.camera import Camera; "
        "from odomap.geometry.pnp import solve_pnp; "
        "c = Camera('pinhole', [460, 460, 320, 240], [-0.28, 0.07, 0, 0], (640, 480)); "
        "p = np.random.default_rng(0).uniform([-1, -1, 2], [1, 1, 5], (12, 3)); "
        "print(solve_pnp(p, c.project(p), c).num_inliers)"
    )
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "ODOMAP_PLAIN": "1"},
    )
    assert done.stdout.strip() == "12"
