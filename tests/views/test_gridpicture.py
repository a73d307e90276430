"""Pictures of grids: the right way up, the right scale, walls that do not fade."""

import cv2
import numpy as np
import pytest

from odomap.lidar.grid import OccupancyGrid
from odomap.views.gridpicture import FOOT_PX, MARGIN_PX, grid_picture, grid_png
from odomap.views.style import PALETTE


def a_grid(shape, resolution=0.1, free=-2.0):
    return OccupancyGrid.of(np.full(shape, free, np.float32), np.array([-2.0, 3.0]), resolution)


def is_coloured(picture, name):
    colour = np.array(list(bytes.fromhex(PALETTE[name][1:])))
    return np.abs(picture.astype(int) - colour).max(axis=2) < 12


def test_up_is_the_greatest_y_and_cells_are_large_enough_to_see():
    grid = a_grid((40, 60))
    grid.log_odds[39, 0] = 4.0  # upper left
    grid.log_odds[0, :10] = 0.0
    picture = grid_picture(grid)
    inner = picture[MARGIN_PX:-FOOT_PX, MARGIN_PX:-MARGIN_PX, 0]
    assert inner.shape == (320, 480)
    assert inner[:8, :8].max() < 60
    assert inner[8:16, :8].min() > 240
    assert 200 < inner[-1, 0] < 225


def test_the_path_is_where_it_was():
    path = np.array([[-1.95, 3.05], [3.95, 3.05], [3.95, 6.95]])
    picture = grid_picture(a_grid((40, 60)), path)
    line = is_coloured(picture, "estimate")
    row = picture.shape[0] - FOOT_PX - 4 - 1
    assert line[row - 2 : row + 3, MARGIN_PX + 40 : -MARGIN_PX - 40].any(axis=0).all()
    column = picture.shape[1] - MARGIN_PX - 4 - 1
    assert line[MARGIN_PX + 40 : -FOOT_PX - 40, column - 2 : column + 3].any(axis=1).all()
    assert not line[MARGIN_PX : MARGIN_PX + 150, : MARGIN_PX + 300].any()
    assert is_coloured(picture, "good")[row - 8 : row + 8, : MARGIN_PX + 16].any()
    assert is_coloured(picture, "lost")[:40, column - 8 :].any()


@pytest.mark.parametrize(
    ("shape", "resolution", "metres"),
    [((40, 60), 0.1, 1.0), ((900, 900), 1.0, 100.0), ((30, 90), 0.002, 0.02)],
)
def test_the_scale_is_as_long_as_it_says(shape, resolution, metres):
    picture = grid_picture(a_grid(shape, resolution))
    foot = picture[-FOOT_PX // 2 + 4, :, 0]
    dark = np.flatnonzero(foot < 60)
    px = (picture.shape[1] - 2 * MARGIN_PX) / shape[1]
    wanted = metres / resolution * px
    run = dark[: np.flatnonzero(np.diff(dark, append=10**9) > 1)[0] + 1]
    assert len(run) == pytest.approx(wanted, abs=4)


def test_thin_walls_of_large_grids_do_not_fade():
    grid = a_grid((5000, 3000))
    grid.log_odds[:, 1234] = 4.0
    grid.log_odds[4000:, :1000] = 0.0
    picture = grid_picture(grid, np.array([[0.0, 5.0], [1e9, -1e9]]))
    assert max(picture.shape) <= 2400 + 2 * MARGIN_PX + FOOT_PX
    column = MARGIN_PX + 1234 // 3
    assert picture[MARGIN_PX:-FOOT_PX, column, 0].max() < 60
    assert 200 < picture[MARGIN_PX + 5, MARGIN_PX + 5, 0] < 225


def test_a_png_is_the_picture_and_the_same_each_time():
    grid = a_grid((40, 60))
    data = grid_png(grid, [[0, 4], [1, 5]])
    decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[:, :, ::-1]
    np.testing.assert_array_equal(decoded, grid_picture(grid, [[0, 4], [1, 5]]))
    assert grid_png(grid, [[0, 4], [1, 5]]) == data


@pytest.mark.parametrize("path", [None, np.zeros((0, 2)), [[1.0, 1.0]]])
def test_nothing_and_next_to_nothing_can_be_drawn(path):
    assert grid_picture(OccupancyGrid(0.1), path).ndim == 3
    assert grid_picture(a_grid((1, 1)), path).shape[1] >= 160
