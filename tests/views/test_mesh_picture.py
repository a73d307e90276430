"""The picture of a mesh shows it where it is, nearest first, from its free side."""

import numpy as np

from odomap.maps.surface import Surface
from odomap.views.mesh_picture import PAPER, draw_kernel, mesh_picture, mesh_png


def a_square(z, colour, turned=False):
    points = np.array([[-1, -1, z], [1, -1, z], [1, 1, z], [-1, 1, z]], np.float64)
    faces = np.array([[0, 3, 2], [0, 2, 1]], np.int32)
    normals = np.tile([0.0, 0.0, 1.0 if turned else -1.0], (4, 1))
    return points, normals, np.tile(np.uint8(colour), (4, 1)), faces[:, ::-1] if turned else faces


def draw(*squares, size=40):
    points, normals, colours = (np.concatenate([s[k] for s in squares]) for k in range(3))
    faces = np.concatenate([s[3] + 4 * n for n, s in enumerate(squares)]).astype(np.int32)
    nearest, rgb = np.zeros((size, size), np.float32), np.full((size, size, 3), PAPER, np.uint8)
    draw_kernel(points, normals, colours, np.ascontiguousarray(faces), 1.0 * size, nearest, rgb)
    return nearest, rgb


def test_a_square_is_as_large_as_it_looks():
    nearest, rgb = draw(a_square(4.0, (200, 0, 0)))
    inside = nearest > 0
    assert abs(np.sqrt(inside.sum()) - 20.0) <= 1.0
    np.testing.assert_allclose(nearest[inside], 0.25)
    assert np.all(rgb[inside][:, 0] > 100)
    assert np.all(rgb[inside][:, 1:] == 0)
    assert np.all(rgb[~inside] == PAPER)


def test_the_nearer_one_is_seen_in_any_order():
    far, near = a_square(8.0, (0, 200, 0)), a_square(4.0, (200, 0, 0))
    for order in ((far, near), (near, far)):
        _, rgb = draw(*order)
        assert rgb[20, 20, 0] > 100
        assert rgb[20, 20, 1] == 0


def test_what_is_turned_away_is_seen_through():
    nearest, _ = draw(a_square(4.0, (200, 0, 0), turned=True))
    assert not nearest.any()
    _, rgb = draw(a_square(2.0, (200, 0, 0), turned=True), a_square(4.0, (0, 200, 0)))
    assert rgb[20, 20, 1] > 100


def test_what_reaches_behind_the_viewer_is_left_out():
    points, normals, colours, faces = a_square(1.0, (1, 2, 3))
    points[0, 2] = -1.0
    nearest, _ = draw((points, normals, colours, faces))
    assert not nearest.any()


def test_the_picture_has_four_views_and_the_same_bytes():
    points, normals, colours, faces = a_square(2.0, (250, 20, 20))
    mesh = Surface(
        points.astype(np.float32), normals.astype(np.float32), colours, np.ascontiguousarray(faces)
    )
    picture = mesh_picture(mesh, np.eye(4)[None], (200, 150))
    assert picture.shape == (300, 400, 3)
    colour, clay = picture[75, 100].astype(int), picture[225, 100].astype(int)
    assert colour[0] > 2 * colour[1]
    assert clay[0] == clay[1] == clay[2] < PAPER
    first, second = mesh_png(mesh, np.eye(4)[None]), mesh_png(mesh, np.eye(4)[None])
    assert first == second
    assert first[:4] == b"\x89PNG"


def test_an_empty_mesh_is_a_blank_sheet():
    picture = mesh_picture(Surface(np.zeros((0, 3), np.float32)), np.eye(4)[None], (40, 30))
    assert np.all(picture == PAPER)
