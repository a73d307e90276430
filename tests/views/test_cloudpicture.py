"""Pictures of clouds from above: what is where, how dark, and how large."""

import numpy as np
import pytest

from odomap.maps.cloudmap import CloudMap
from odomap.views.cloudpicture import FINEST, LONGEST, SHORTEST, cloud_picture
from odomap.views.gridpicture import FOOT_PX, MARGIN_PX


def block(side: float, wall: float = 3.0) -> CloudMap:
    """Return level ground of (2 side, side) metres with a wall along its greatest y."""
    x, y = np.meshgrid(np.arange(0, 2 * side, 0.1), np.arange(0, side, 0.1))
    ground = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    s, z = np.meshgrid(np.arange(0, 2 * side, 0.1), np.arange(0, wall, 0.1))
    tall = np.column_stack([s.ravel(), np.full(s.size, side), z.ravel()])
    points = np.concatenate([ground, tall])
    path = np.array([[0.2 * side, 0.5 * side, 1.0], [0.5 * side, 0.5 * side, 1.0]])
    return CloudMap(points, np.zeros(len(points), np.float32), path)


@pytest.mark.parametrize("side", [4.0, 30.0, 75.0])
def test_what_stands_up_is_dark_and_the_greatest_y_is_at_the_top(side: float) -> None:
    drawn = cloud_picture(block(side))
    height, width, colours = drawn.shape
    assert colours == 3
    assert drawn.dtype == np.uint8
    # A room is as large to look at as a street.
    assert SHORTEST / 2 < width - 2 * MARGIN_PX <= LONGEST + 2
    seen = drawn[MARGIN_PX : height - FOOT_PX, MARGIN_PX : width - MARGIN_PX].astype(float).mean(2)
    rows = seen.mean(axis=1)
    assert rows.argmin() < 0.05 * len(rows)
    assert rows[len(rows) // 4] > rows.min() + 40


def test_the_path_is_drawn_where_it_was() -> None:
    side = 6.0
    with_path = block(side)
    without = CloudMap(with_path.points, with_path.intensities, np.zeros((0, 3)))
    changed = np.argwhere((cloud_picture(with_path) != cloud_picture(without)).any(axis=2))
    times = SHORTEST // round(2 * side / FINEST)
    pixels = (changed[:, ::-1] - MARGIN_PX) / (times / FINEST)
    middle = pixels.mean(axis=0)
    assert middle[0] == pytest.approx(0.35 * side, abs=0.2)
    assert middle[1] == pytest.approx(0.5 * side, abs=0.2)
