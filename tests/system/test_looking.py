"""What a pose must have for it to be believed."""

from types import SimpleNamespace

import numpy as np
import pytest

from odomap.geometry.camera import Camera
from odomap.system.looking import doubt

CAMERA = Camera(intrinsics=(300.0, 300.0, 320.0, 240.0), resolution=(640, 480))
VIEW = SimpleNamespace(pyramid=(np.tile(np.arange(64, dtype=np.uint8) * 3, (48, 1)),))


def located(count, width, height):
    at = np.random.default_rng(0).uniform(0, 1, (40, 2)) * (width, height)
    inliers = np.arange(40) < count
    rows = np.arange(40)
    return SimpleNamespace(
        num_inliers=count, pixels=at, inliers=inliers, rows=rows, expected=len(rows)
    )


@pytest.mark.parametrize(
    ("count", "height", "share", "said"),
    [
        (30, 480, 0.08, ""),
        (30, 10, 0.08, "covers 2"),  # a strip, where there was more to see
        (30, 10, 0.01, ""),  # a strip, where there was no more
        (9, 480, 0.08, "9 inliers of 15 needed"),
    ],
)
def test_enough_must_agree_all_over_what_there_is(count, height, share, said):
    found = doubt(located(count, 640, height), 15, share, VIEW, CAMERA)
    assert said in found if said else found == ""
