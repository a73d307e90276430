"""What stands before the known: told from a view of something new, and from a world at rest."""

from types import SimpleNamespace

import numpy as np
import pytest

from odomap.geometry.camera import Camera
from odomap.system.association import View
from odomap.system.locating import Located
from odomap.system.veil import Veil
from odomap.vision.features import Corners

CAMERA = Camera(intrinsics=np.array([200.0, 200.0, 159.5, 99.5]), resolution=(320, 200))
WALL, BOARD = 3.0, 1.2


class Depth:
    """Measures what it is told: the depth of each pixel."""

    def __init__(self, depth):
        self.depth, self.asked = depth, 0

    def measure(self, frame, view, keypoints, expected):
        self.asked += len(keypoints)
        return 1.0 / self.depth(keypoints)


def on_board(pixels):
    return np.all(np.abs(pixels - (160, 100)) < (90, 60), axis=1)


@pytest.fixture
def scene():
    """A wall full of landmarks, a view of it, and a map that knows them."""
    rng = np.random.default_rng(4)
    pixels = rng.uniform((5, 5), (315, 195), (600, 2))
    points = np.column_stack([(pixels - (159.5, 99.5)) / 200.0, np.ones(600)]) * WALL
    features = rng.uniform((5, 5), (315, 195), (800, 2)).astype(np.float32)
    descriptors = rng.integers(0, 256, (800, 32)).astype(np.uint8)
    corners = Corners(features, np.ones(800), np.zeros(800, np.uint8))
    view = View(7, 0, (np.zeros((200, 320), np.uint8),), corners, descriptors)
    known = SimpleNamespace(points_world=lambda ids: points[ids])
    eye = SimpleNamespace(camera=CAMERA, T_body_camera=np.eye(4))
    return Veil(known, eye), view, pixels


def located(found):
    rows = np.flatnonzero(found)
    at = np.zeros((len(rows), 2))
    everything = np.arange(len(found))
    return Located(np.eye(4), np.eye(6), rows, at, np.ones(len(rows), bool), everything)


def board_depth(pixels):
    return np.where(on_board(pixels), BOARD, WALL)


def test_a_board_before_the_wall_hides_it(scene):
    veil, view, pixels = scene
    place = located(~on_board(pixels))
    assert veil.hides(None, view, np.arange(600), place, Depth(board_depth))
    # What hid it is left out of the next views, as long as it is there.
    lifted = veil.lifted(view)
    assert veil.is_shown
    before, left = on_board(view.corners.keypoints), on_board(lifted.corners.keypoints)
    assert left.sum() < 0.6 * before.sum()  # at the rim of the board the wall is seen, too
    assert (~left).sum() == (~before).sum()
    assert len(lifted.corners.keypoints) == len(lifted.descriptors) == len(lifted.corners.level)


def test_it_is_forgotten_once_it_is_gone(scene):
    veil, view, pixels = scene
    assert veil.hides(None, view, np.arange(600), located(~on_board(pixels)), Depth(board_depth))
    other = np.random.default_rng(5).integers(0, 256, view.descriptors.shape).astype(np.uint8)
    gone = View(8, 1, view.pyramid, view.corners, other)
    assert veil.lifted(gone) is gone
    assert not veil.is_shown
    assert veil.lifted(view) is view


def test_a_wall_that_is_hardly_recognised_is_not_hidden(scene):
    """Landmarks that are not found, with nothing nearer in their place."""
    veil, view, pixels = scene
    place = located(~on_board(pixels))
    assert not veil.hides(None, view, np.arange(600), place, Depth(lambda x: np.full(len(x), WALL)))
    assert not veil.hides(
        None, view, np.arange(600), place, Depth(lambda x: np.full(len(x), np.nan))
    )
    assert veil.lifted(view) is view


def test_a_thing_before_a_wall_that_is_seen_beside_it_is_a_part_of_the_world(scene):
    """Half of the landmarks are found everywhere: nothing is hidden, and no depth is measured."""
    veil, view, _ = scene
    depth = Depth(lambda x: np.full(len(x), BOARD))
    assert not veil.hides(None, view, np.arange(600), located(np.arange(600) % 2 == 0), depth)
    assert depth.asked == 0


def test_a_view_of_something_new_hides_nothing(scene):
    """Where no landmark is expected a near thing may simply be new."""
    veil, view, pixels = scene
    known = np.flatnonzero(pixels[:, 0] < 60)
    place = located(np.ones(len(known), bool))
    depth = Depth(lambda x: np.full(len(x), BOARD))
    assert not veil.hides(None, view, known, place, depth)


def test_without_depth_nothing_is_said(scene):
    veil, view, pixels = scene
    assert not veil.hides(None, view, np.arange(600), located(~on_board(pixels)), None)
