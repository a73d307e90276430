"""Fusing depth: a plane and a ball come out where they are, bad depth changes nothing."""

import numpy as np
import pytest

from odomap.errors import InputError
from odomap.geometry.camera import Camera
from odomap.geometry.pose import SE3
from odomap.maps import tsdf_depth
from odomap.maps.surface import Surface, without_loose
from odomap.maps.tsdf import Tsdf, TsdfConfig, TsdfFull

CAMERA = Camera(intrinsics=(120.0, 120.0, 79.5, 59.5), resolution=(160, 120))
BALL, RADIUS = np.array([0.1, -0.05, 1.5]), 0.4


def rays(camera=CAMERA):
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    r = camera.unproject(np.stack([u.ravel(), v.ravel()], 1).astype(float))
    return (r / r[:, 2:]).reshape(camera.height, camera.width, 3)


def plane_depth(T_world_camera, normal, offset):
    """Depth of the plane n·P = offset."""
    directions = rays() @ T_world_camera.R.T
    depth = (offset - T_world_camera.t @ normal) / (directions @ normal)
    return np.where(depth > 0, depth, 0).astype(np.float32)


def ball_depth(T_world_camera):
    directions = rays() @ T_world_camera.R.T
    to_ball = BALL - T_world_camera.t
    a, b = np.sum(directions**2, -1), directions @ to_ball
    disc = b**2 - a * (to_ball @ to_ball - RADIUS**2)
    return np.where(disc > 0, (b - np.sqrt(np.maximum(disc, 0))) / a, 0).astype(np.float32)


def looks_round(count):
    """Cameras on a circle about the ball, all looking at it."""
    for angle in np.linspace(0, 2 * np.pi, count, endpoint=False):
        turn = SE3.exp([0, 0, 0, 0, angle, 0])
        yield SE3.from_parts(turn.R, BALL - turn.R @ np.array([0, 0, 1.5]))


def test_a_ball_is_a_closed_surface_of_its_radius():
    tsdf = Tsdf(TsdfConfig(voxel=0.02))
    up_and_down = [
        SE3.from_parts(SE3.exp([0, 0, 0, a, 0, 0]).R, np.zeros(3)) for a in (-np.pi / 2, np.pi / 2)
    ]
    poles = [SE3.from_parts(T.R, BALL - T.R @ np.array([0, 0, 1.5])) for T in up_and_down]
    for T in [*looks_round(8), *poles]:
        tsdf.integrate(ball_depth(T), None, CAMERA, T)
    ball = tsdf.surface()
    from_centre = ball.points - BALL
    distance = np.linalg.norm(from_centre, axis=1)
    assert np.abs(distance - RADIUS).mean() < 0.002
    assert np.abs(distance - RADIUS).max() < 0.02
    # Normals and triangles turn outwards, to the free side.
    assert np.min(np.sum(ball.normals * from_centre, axis=1) / distance) > 0.8
    a, b, c = (ball.points[ball.faces[:, k]] for k in range(3))
    outward = np.sum(np.cross(b - a, c - a) * (a - BALL), axis=1)
    assert np.mean(outward > 0) > 0.999
    assert ball.areas().sum() == pytest.approx(4 * np.pi * RADIUS**2, rel=0.02)
    # Closed: every edge belongs to two triangles, and Euler's number is that of a ball.
    ends = np.sort(np.concatenate([ball.faces[:, [k, (k + 1) % 3]] for k in range(3)]), axis=1)
    edges, uses = np.unique(ends, axis=0, return_counts=True)
    assert np.mean(uses == 2) > 0.999
    assert len(ball.points) - len(edges) + len(ball.faces) == 2


@pytest.mark.parametrize("tilt", [0.0, 0.6, 1.1])
def test_a_slanted_plane_is_not_bent(tilt):
    """Distances along the ray would be too long on slanted surfaces, and averages biased."""
    normal = np.array([0.0, np.sin(tilt), -np.cos(tilt)])
    tsdf = Tsdf(TsdfConfig(voxel=0.02))
    for angle in (-0.3, 0.0, 0.3):
        T = SE3.exp([0.2 * angle, 0, 0, 0, angle, 0])
        tsdf.integrate(plane_depth(T, normal, -2.0 * np.cos(tilt)), None, CAMERA, T)
    plane = tsdf.surface()
    off = plane.points @ normal + 2.0 * np.cos(tilt)
    assert len(plane.faces) > 1000
    assert np.quantile(np.abs(off), 0.95) < 1e-3
    assert np.abs(off).max() < 0.015  # at the rim, where pixels are farther apart than voxels
    assert np.quantile(plane.normals @ normal, 0.02) > 0.99
    assert np.min(plane.normals @ normal) > 0.5


def test_noise_averages_out():
    rng = np.random.default_rng(0)
    true = plane_depth(SE3.identity(), np.array([0.0, 0.0, 1.0]), 2.0)
    spread = []
    for count in (1, 16):
        tsdf = Tsdf(TsdfConfig(voxel=0.02))
        for _ in range(count):
            noisy = true + rng.normal(0, 0.008, true.shape).astype(np.float32)
            tsdf.integrate(noisy, None, CAMERA, SE3.identity())
        spread.append(np.std(tsdf.surface().points[:, 2]))
    assert spread[1] < 0.35 * spread[0]


def test_slants_are_those_of_the_plane():
    normal = np.array([0.3, -0.5, -0.8])
    normal /= np.linalg.norm(normal)
    depth = plane_depth(SE3.identity(), normal, -1.5)
    slants = np.empty((30, 40), np.float32)
    tsdf_depth.slant_kernel(depth, np.array(CAMERA.intrinsics), 0.04, slants)
    wanted = np.abs(rays() @ normal)[::4, ::4]
    found = slants > 0
    assert found.mean() > 0.9
    np.testing.assert_allclose(slants[found], wanted[found], rtol=0.03)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, -1.0, 0.0, 100.0, 1e-3])
def test_bad_depth_is_left_out(bad):
    good = np.full((120, 160), 2.0, np.float32)
    holes = good.copy()
    holes[40:60, 50:90] = bad
    surfaces = []
    for depth in (good, holes):
        tsdf = Tsdf()
        tsdf.integrate(depth, None, CAMERA, SE3.identity())
        surfaces.append(tsdf.surface())
    assert 0.8 * len(surfaces[0].points) < len(surfaces[1].points) < len(surfaces[0].points)
    np.testing.assert_allclose(surfaces[1].points[:, 2], 2.0, atol=1e-4)


def test_nothing_but_bad_depth_is_an_empty_surface():
    tsdf = Tsdf()
    tsdf.integrate(np.full((120, 160), np.nan, np.float32), None, CAMERA, SE3.identity())
    surface = tsdf.surface()
    assert len(surface.points) == len(surface.faces) == tsdf.num_blocks == 0
    assert surface.extent().tolist() == [0, 0, 0]


def test_flying_pixels_make_no_surface():
    """Between a box and the wall behind it sensors measure depths of neither."""
    depth = np.full((120, 160), 3.0, np.float32)
    depth[30:90, 40:120] = 1.5
    depth[30:90, 39] = depth[30:90, 120] = 2.2
    tsdf = Tsdf()
    tsdf.integrate(depth, None, CAMERA, SE3.identity())
    z = tsdf.surface(min_area_voxels=0).points[:, 2]
    assert np.all((np.abs(z - 1.5) < 0.02) | (np.abs(z - 3.0) < 0.02))
    assert np.mean(np.abs(z - 1.5) < 0.02) > 0.05


def test_what_is_seen_through_fades():
    """A thing that was there once and is gone later does not stay."""
    wall = np.full((120, 160), 2.5, np.float32)
    visitor = wall.copy()
    visitor[40:80, 60:100] = 2.0
    tsdf = Tsdf()
    tsdf.integrate(visitor, None, CAMERA, SE3.identity())
    assert np.any(tsdf.surface(min_area_voxels=0).points[:, 2] < 2.2)
    for _ in range(6):
        tsdf.integrate(wall, None, CAMERA, SE3.identity())
    assert not np.any(tsdf.surface(min_area_voxels=0).points[:, 2] < 2.2)


def test_colours_are_where_they_were_seen():
    depth = np.full((120, 160), 2.0, np.float32)
    colour = np.zeros((120, 160, 3), np.uint8)
    colour[:, :80], colour[:, 80:] = (200, 40, 10), (10, 60, 250)
    tsdf = Tsdf()
    for _ in range(3):
        tsdf.integrate(depth, colour, CAMERA, SE3.identity())
    surface = tsdf.surface()
    left = surface.points[:, 0] < -0.05
    right = surface.points[:, 0] > 0.05
    assert np.abs(surface.colours[left].astype(int) - (200, 40, 10)).max() <= 1
    assert np.abs(surface.colours[right].astype(int) - (10, 60, 250)).max() <= 1


def test_a_place_must_be_seen_by_enough_images():
    tsdf = Tsdf()
    one = np.full((120, 160), 2.0, np.float32)
    half = one.copy()
    half[:, :80] = 0
    for depth in (one, half):
        tsdf.integrate(depth, None, CAMERA, SE3.identity())
    assert tsdf.surface(1).points[:, 0].min() < -1.0
    assert tsdf.surface(2).points[:, 0].min() > -0.1
    assert len(tsdf.surface(3).points) == 0


def test_the_same_images_give_the_same_bytes():
    def made():
        tsdf = Tsdf()
        for T in looks_round(4):
            tsdf.integrate(ball_depth(T), None, CAMERA, T)
        s = tsdf.surface()
        return s.points.tobytes() + s.faces.tobytes() + s.normals.tobytes() + s.colours.tobytes()

    assert made() == made()


def test_growing_changes_nothing():
    """A grid that had to grow many times holds what one that was large from the start holds."""
    small, large = Tsdf(TsdfConfig(voxel=0.01)), Tsdf(TsdfConfig(voxel=0.01))
    large._grow(60_000)
    for T in looks_round(3):
        for tsdf in (small, large):
            tsdf.integrate(ball_depth(T), None, CAMERA, T)
    assert small.num_blocks == large.num_blocks > 1024 / 2
    np.testing.assert_array_equal(small.surface().points, large.surface().points)


def test_memory_has_a_limit():
    tsdf = Tsdf(TsdfConfig(voxel=0.005, memory_mb=20.0))
    with pytest.raises(TsdfFull, match=r"more than 20 MB: use larger ones \(--voxel 0.01\)"):
        tsdf.integrate(np.full((120, 160), 2.0, np.float32), None, CAMERA, SE3.identity())
    assert tsdf.memory_mb <= 20.0


def test_images_of_another_size_or_lens_are_refused():
    depth = np.full((120, 160), 2.0, np.float32)
    eye = SE3.identity()
    with pytest.raises(InputError, match="depth: is 80x60 pixels, its camera 160x120"):
        Tsdf().integrate(depth[::2, ::2], None, CAMERA, eye)
    with pytest.raises(InputError, match="colour: has shape"):
        Tsdf().integrate(depth, np.zeros((120, 80, 3), np.uint8), CAMERA, eye)
    lens = Camera("pinhole", CAMERA.intrinsics, (0.1, 0, 0, 0), CAMERA.resolution)
    with pytest.raises(InputError, match="without distortion"):
        Tsdf().integrate(depth, None, lens, eye)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"voxel": 0.0}, "voxel: 0.0 must be above 0"),
        ({"voxel": float("nan")}, "voxel: nan must be above 0"),
        ({"max_depth": 0.05}, "max_depth: 0.05 m must be above 0.1 m"),
    ],
)
def test_values_that_cannot_be(fields, message):
    with pytest.raises(InputError, match=message):
        TsdfConfig(**fields)


def test_loose_pieces_go():
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    points = np.concatenate([square, 0.1 * square + 5, square + 9])
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.int32)
    kept = without_loose(Surface(points, faces=faces), 0.5)
    np.testing.assert_array_equal(kept.points, square)
    np.testing.assert_array_equal(kept.faces, faces[:2])
