"""Worlds for a 3D LiDAR: sweeps are of their own moments, points lie on what is said of them."""

from dataclasses import replace

import numpy as np
import pytest

from odomap.errors import ConfigError
from odomap.lidar.deskew import deskew
from odomap.simulation.solidcast import cast
from odomap.simulation.solids import KINDS, Ground, SolidsBuilder
from odomap.simulation.sweepspec import SweepSpec
from odomap.simulation.sweeptruth import edges_of
from odomap.simulation.sweepworld import SweepWorld
from odomap.sources.open import open as open_source

SMALL = SweepSpec("street", seed=3, frames=40, beams=16, columns=300)


@pytest.fixture(scope="module")
def street() -> SweepWorld:
    return SweepWorld(SMALL)


def in_world(world: SweepWorld, index: int, points: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return points (N, 3), each in the LiDAR's frame of its own time, in the world."""
    Ts = world.path.at(index / world.spec.rate_hz + times).Ts_world_body
    return np.einsum("nij,nj->ni", Ts[:, :3, :3], points) + Ts[:, :3, 3]


def off_surface(world: SweepWorld, surfaces: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return how far points (N, 3) in the world are from the surfaces they are said to be on."""
    away = np.full(len(points), np.nan)
    p, solids = points, world.solids
    row = solids.shapes[np.maximum(surfaces, 0)] if len(solids) else np.zeros((len(p), 14))
    form = solids.forms[np.maximum(surfaces, 0)] if len(solids) else np.zeros(len(p))
    flat, round_, ball = (form == k for k in range(3))
    plane = np.abs((row[:, :3] * p).sum(1) - row[:, 3])
    away[flat] = plane[flat]
    for first, size in ((4, 12), (8, 13)):
        along = (row[:, first : first + 3] * p).sum(1) - row[:, first + 3]
        beside = np.maximum(-along, along - row[:, size])
        away[flat] = np.maximum(away, beside)[flat]
    away[round_] = np.abs(np.hypot(*(p[:, :2] - row[:, :2]).T) - row[:, 2])[round_]
    # Within leaves is on them.
    away[ball] = np.maximum(np.linalg.norm(p - row[:, :3], axis=1) - row[:, 3], 0)[ball]
    ground = surfaces == -2
    heights = [world.solids.ground.height(x, y) for x, y in p[ground, :2]]
    away[ground] = np.abs(p[ground, 2] - heights)
    return away


@pytest.mark.parametrize("kind", ["street", "room", "building", "tunnel", "field"])
@pytest.mark.parametrize("pattern", ["rotating", "solid_state"])
def test_points_lie_on_their_surfaces(kind: str, pattern: str) -> None:
    spec = SweepSpec(kind, 1, 3, pattern=pattern, beams=8, columns=200, noise=0.0)
    world = SweepWorld(spec)
    cloud, truth = world.frame(2).cloud, world.sweep_truth(2)
    assert cloud is not None
    assert cloud.times is not None
    assert len(cloud) > (300 if kind == "field" else 700)
    np.testing.assert_allclose(cloud.points, truth.points, rtol=0, atol=1e-12)
    placed = in_world(world, 2, cloud.points, cloud.times)
    assert off_surface(world, truth.surfaces, placed).max() < 1e-8
    # Normals have length one and look at the LiDAR; leaves have none.
    leaves = truth.kinds == KINDS.index("leaves")
    normals = truth.normals[~leaves]
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-12)
    assert ((normals * cloud.points[~leaves]).sum(1) < 0).all()
    assert np.isnan(truth.normals[leaves]).all()
    assert truth.is_ground.any()


def test_a_sweep_is_in_the_order_of_time(street: SweepWorld) -> None:
    cloud = street.frame(5).cloud
    assert cloud is not None
    assert cloud.times is not None
    assert cloud.beams is not None
    assert cloud.intensities is not None
    assert (np.diff(cloud.times) >= 0).all()
    assert cloud.times[0] < 0.01
    assert 0.09 < cloud.times[-1] < 0.1
    assert set(cloud.beams.tolist()) == set(range(16))
    elevation = np.degrees(np.arctan2(cloud.points[:, 2], np.hypot(*cloud.points[:, :2].T)))
    np.testing.assert_allclose(elevation, -15 + 2 * cloud.beams, atol=1e-6)
    azimuth = np.unwrap(np.arctan2(cloud.points[:, 1], cloud.points[:, 0])[cloud.beams == 4])
    assert (np.diff(azimuth) < 0).all()
    assert cloud.intensities.dtype == np.float32
    assert 0 <= cloud.intensities.min() < 20 < cloud.intensities.max() <= 255
    mount = street.rig.lidars[0]
    assert (mount.beams, mount.sweep, mount.angles[2]) == (16, "clockwise", 0)


def test_motion_within_a_sweep_is_that_of_the_path() -> None:
    world = SweepWorld(replace(SMALL, noise=0.0))
    cloud, truth = world.frame(20).cloud, world.sweep_truth(20)
    assert cloud is not None
    assert cloud.times is not None
    motion = world.path.at(np.array([2.0, 2.05]))
    R, speed = motion.Ts_world_body[1, :3, :3], motion.v_world_body[1]
    twist = np.concatenate([R.T @ speed, motion.omega_body[1]])
    T = world.truth.Ts_world_body[20]
    still = cloud.points @ T[:3, :3].T + T[:3, 3]
    mended = deskew(cloud.points, cloud.times, twist) @ T[:3, :3].T + T[:3, 3]
    exact = in_world(world, 20, cloud.points, cloud.times)
    assert np.linalg.norm(still - exact, axis=1).max() > 0.5
    off = np.linalg.norm(mended - exact, axis=1)
    assert np.median(off) < 0.005
    assert off.max() < 0.1
    assert len(truth.surfaces) == len(cloud)


def test_noise_is_that_of_a_laser(street: SweepWorld) -> None:
    cloud, truth = street.frame(0).cloud, street.sweep_truth(0)
    assert cloud is not None
    true = np.linalg.norm(truth.points, axis=1)
    off = np.linalg.norm(cloud.points, axis=1) - true
    scaled = off / (0.01 * (1 + true / 50))
    mixed = np.abs(scaled) > 6
    assert mixed.mean() < 0.02
    assert truth.is_edge[mixed].mean() + truth.is_hidden[mixed].mean() > 0.5
    assert np.std(scaled[~mixed]) == pytest.approx(1.0, abs=0.05)
    assert len(street.frame(0).cloud) < len(SweepWorld(replace(SMALL, noise=0.0)).frame(0).cloud)  # type: ignore[arg-type]


def test_a_seed_decides_it_all(street: SweepWorld) -> None:
    def content(world: SweepWorld, index: int) -> list[bytes]:
        return [array.tobytes() for array in world.frame(index).arrays()]

    again = SweepWorld(SMALL)
    for index in (7, 0, 39, 7):
        assert content(again, index) == content(street, index)
    assert content(SweepWorld(replace(SMALL, seed=4)), 0) != content(street, 0)
    with pytest.raises(IndexError):
        street.frame(40)


@pytest.mark.parametrize("seed", range(5))
def test_streets_are_circuits_that_rise_and_fall(seed: int) -> None:
    world = SweepWorld(SweepSpec("street", seed, beams=16, rate_hz=2.0))
    at = world.truth.positions
    assert 450 < world.truth.path_length / 1.15 < 750
    round_ = round(len(world) / 1.15)
    assert np.linalg.norm(at[round_:] - at[: len(at) - round_], axis=1).max() < 15
    assert np.linalg.norm(at[len(at) // 3] - at[0]) > 60
    assert np.ptp(at[:, 2]) > 0.3
    steps = np.diff(at, axis=0)
    assert np.abs(steps[:, 2] / np.hypot(steps[:, 0], steps[:, 1])).max() < 0.1
    truth = world.sweep_truth(len(world) // 2)
    share = np.bincount(truth.kinds, minlength=len(KINDS)) / len(truth.kinds)
    assert share[KINDS.index("ground")] > 0.15
    assert share[KINDS.index("building")] > 0.2
    for kind in ("pole", "leaves", "vehicle", "furniture"):
        assert share[KINDS.index(kind)] > 0.002


def test_sixty_cars_are_a_fifth_of_what_is_seen() -> None:
    world = SweepWorld(SweepSpec("street", 2, 200, beams=16, columns=200, moving_objects=60))
    shares = [
        (world.sweep_truth(k).kinds == KINDS.index("moving")).mean() for k in range(0, 200, 20)
    ]
    assert 0.12 < np.mean(shares) < 0.3
    early, late = world.solids.at(0.0), world.solids.at(1.0)
    still = world.solids.num_still
    np.testing.assert_array_equal(early[:still], late[:still])
    assert not np.isclose(early[still:, 3], late[still:, 3]).all()


def test_moving_cars_are_where_they_are_at_the_time_of_the_point() -> None:
    world = SweepWorld(
        SweepSpec("street", 2, 30, beams=16, columns=200, moving_objects=60, noise=0)
    )
    cloud, truth = world.frame(25).cloud, world.sweep_truth(25)
    assert cloud is not None
    assert cloud.times is not None
    at = in_world(world, 25, cloud.points, cloud.times)
    moving = np.flatnonzero(truth.kinds == KINDS.index("moving"))
    assert len(moving) > 100
    for row in moving[:: len(moving) // 40]:
        p = world.solids.at(2.5 + cloud.times[row])[truth.surfaces[row]]
        assert abs(p[:3] @ at[row] - p[3]) < 0.05  # its turn within a sweep is left out


def test_a_tunnel_is_the_same_everywhere() -> None:
    world = SweepWorld(SweepSpec("tunnel", 1, 200, beams=16, columns=180, noise=0.0))
    where = world.truth.positions
    assert np.linalg.norm(where[-1] - where[0]) > 100
    # Nobody comes near the ends.
    assert np.abs(where[:, 0]).max() + world.spec.range_m < 500


def test_a_field_has_nothing_but_ground() -> None:
    world = SweepWorld(SweepSpec("field", 1, 50, beams=16, columns=180))
    truth = world.sweep_truth(30)
    assert truth.is_ground.all()
    np.testing.assert_array_equal(truth.surfaces, -2)
    assert not truth.is_edge.any()


def test_a_solid_state_lidar_looks_ahead_and_never_twice_alike() -> None:
    world = SweepWorld(SweepSpec("room", 1, 5, pattern="solid_state", beams=6, columns=500))
    first, second = (world.frame(k).cloud.points for k in (0, 1))  # type: ignore[union-attr]
    azimuth = np.degrees(np.arctan2(first[:, 1], first[:, 0]))
    elevation = np.degrees(np.arctan2(first[:, 2], np.hypot(first[:, 0], first[:, 1])))
    assert 68 < np.ptp(azimuth) < 71
    assert 70 < np.ptp(elevation) < 78
    rays = [p / np.linalg.norm(p, axis=1, keepdims=True) for p in (first, second)]
    nearest = [np.abs(rays[1] - ray).max(axis=1).min() for ray in rays[0][::50]]
    assert np.median(nearest) > 1e-3
    assert world.rig.lidars[0].beams == 0
    assert world.rig.lidars[0].sweep == "none"


def test_names_make_worlds() -> None:
    source = open_source("sim:street?sensors=lidar3d&beams=16&columns=200&seed=3&frames=4")
    assert source.name == "sim:street?sensors=lidar3d&seed=3&frames=4"
    frames = list(source)
    assert [frame.images for frame in frames] == [()] * 4
    assert source.rig.body_sensor == "top"
    assert source.rig.lidars[0].beams == 16


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"kind": "stret"}, r"did you mean 'street'\?"),
        ({"pattern": "rotate"}, "pattern: 'rotate' is none of rotating, solid_state"),
        ({"sensors": ("lidar3d", "imu")}, "'lidar3d' alone"),
        ({"beams": 0}, "beams: 0 must be from 1 to 256"),
        ({"columns": 30_000}, "columns: 30000 must be from 0 to 20000"),
        ({"frames": -1}, "frames: -1 must be 0 or more"),
        ({"noise": float("nan")}, "noise: nan must be finite and not negative"),
        ({"rate_hz": 0.0}, "rate_hz: 0.0 must be finite and above 0"),
    ],
)
def test_what_cannot_be_is_refused(wrong: dict[str, object], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        SweepSpec(**wrong)  # type: ignore[arg-type]


def flat_part(world: SweepWorld, surfaces: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return (N,) how far points are from the nearest side of their rectangle; NaN of others."""
    row = world.solids.shapes[np.maximum(surfaces, 0)]
    nearest = np.full(len(points), np.nan)
    flat = (surfaces >= 0) & (world.solids.forms[np.maximum(surfaces, 0)] == 0)
    sides = []
    for first, size in ((4, 12), (8, 13)):
        along = (row[:, first : first + 3] * points).sum(1) - row[:, first + 3]
        sides.append(np.minimum(along, row[:, size] - along))
    nearest[flat] = np.minimum(*sides)[flat]
    return nearest


@pytest.mark.parametrize("seed", [1, 5])
def test_edges_are_where_surfaces_end(seed: int) -> None:
    world = SweepWorld(SweepSpec("street", seed, 100, beams=32, columns=1800, noise=0.0))
    cloud, truth = world.frame(60).cloud, world.sweep_truth(60)
    assert cloud is not None
    assert cloud.times is not None
    assert cloud.beams is not None
    points = in_world(world, 60, cloud.points, cloud.times)
    away = flat_part(world, truth.surfaces, points)
    # How far it is to the next point of the same beam on the same surface.
    step = np.full(len(points), np.inf)
    for beam in range(32):
        rows = np.flatnonzero(cloud.beams == beam)
        gap = np.linalg.norm(np.diff(points[rows], axis=0), axis=1)
        gap[np.diff(truth.surfaces[rows]) != 0] = np.inf
        step[rows] = np.minimum(np.append(gap, np.inf), np.insert(gap, 0, np.inf))
    built = np.isfinite(step) & np.isfinite(away) & (truth.kinds != KINDS.index("ground"))
    edges = truth.is_edge & built
    assert edges.sum() > 300
    # Two points at most lie between an edge and the side of its rectangle, but where another
    # thing stands on or cuts into it.
    assert np.mean(away[edges] < 2.1 * step[edges] + 1e-9) > 0.75
    # In the middle of a surface there is no edge.
    inner = built & (away > 6 * step) & ~truth.is_hidden
    assert inner.sum() > 1000
    assert truth.is_edge[inner].mean() < 0.08
    # Poles and trunks end on both sides: from afar all of one is within two beams of an end, but
    # for those in leaves.
    round_ = (truth.surfaces >= 0) & (world.solids.forms[np.maximum(truth.surfaces, 0)] == 1)
    round_ &= np.linalg.norm(cloud.points, axis=1) > 40
    assert (truth.is_edge | truth.is_hidden)[round_].mean() > 0.8
    assert not (truth.is_edge & (truth.kinds == KINDS.index("leaves"))).any()


def test_a_box_before_a_wall_has_edges_and_the_wall_goes_on_behind_it() -> None:
    builder = SolidsBuilder(np.random.default_rng(0), Ground.none())
    builder.box(np.array([5.0, 0.0, 0.0]), (1.0, 2.0, 4.0), "furniture")
    x, y, z = np.eye(3)
    builder.rectangle(np.array([8.0, -6.0, -3.0]), y, z, (12.0, 6.0), "building")
    builder.rectangle(np.array([0.0, -6.0, -3.0]), x, z, (8.0, 6.0), "building")
    angle = np.linspace(-1.2, 1.2, 2400)
    beams = np.column_stack([np.cos(angle), np.sin(angle), np.full(2400, 1e-6)])[:, None]
    distance, hit, normals = cast(
        builder.build(), np.tile(np.eye(4), (2400, 1, 1)), np.zeros(2400), beams,
        np.zeros((2400, 1), np.float32), 0.0, 50.0,
    )  # fmt: skip
    edge, hidden = (x[:, 0] for x in edges_of(distance, hit, normals, beams, hit > 99, 2, 0.8))
    # The corners of the box and that of the walls are felt by two beams on either side, and where
    # the wall ends and nothing is behind it there is an edge, too.
    box, corner = np.arctan2(1.0, 4.5), np.arctan2(-6.0, 8.0)
    step = angle[1] - angle[0]
    on_box = np.abs(np.abs(angle) - box + 1e-9) - 1e-9 < 2 * step
    on_box &= np.abs(angle) < box
    at_corner = np.abs(angle - corner) < 2 * step
    at_corner |= (angle < -corner) & (angle > -corner - 2 * step)
    np.testing.assert_array_equal(edge, on_box | at_corner)
    behind = (np.abs(angle) > box) & (np.abs(angle) < box + 2 * step)
    np.testing.assert_array_equal(hidden, behind)
    np.testing.assert_allclose(distance[edge & ~at_corner, 0], 4.5 / np.cos(angle[on_box]), 1e-9)


def seen_upwards(lowest: float, away: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return whether beams 1.2 degrees apart are on a wall above a floor, edges, and hidden."""
    builder = SolidsBuilder(np.random.default_rng(0), Ground.none())
    x, y, z = np.eye(3)
    builder.rectangle(np.array([0.0, -9.0, -1.8]), x, y, (60.0, 18.0), "ground")
    builder.rectangle(np.array([away, -9.0, lowest]), y, z, (18.0, 9.0), "building")
    angle = np.radians(np.arange(-30.0, 5.0, 1.2))
    beams = np.column_stack([np.cos(angle), np.full(len(angle), 1e-6), np.sin(angle)])[:, None]
    solids, steps = builder.build(), len(angle)
    distance, hit, normals = cast(
        solids, np.tile(np.eye(4), (steps, 1, 1)), np.zeros(steps), beams,
        np.zeros((steps, 1), np.float32), 0.0, 50.0,
    )  # fmt: skip
    on_wall = np.abs(normals[:, 0, 0]) > 0.5
    edge, hidden = edges_of(distance, hit, normals, beams, hit > 99, 1, 0.8)
    return on_wall, edge[:, 0], hidden[:, 0]


@pytest.mark.parametrize("away", [5.0, 12.0, 25.0])
def test_a_wall_on_the_floor_is_a_corner_however_far_beams_meet_from_each_other(
    away: float,
) -> None:
    on_wall, edge, hidden = seen_upwards(-2.5, away)
    border = np.flatnonzero(np.diff(on_wall))[0]
    np.testing.assert_array_equal(np.flatnonzero(edge), [border, border + 1])
    assert not hidden.any()


@pytest.mark.parametrize("away", [5.0, 8.0])
def test_a_wall_above_the_floor_hides_what_goes_on_below_it(away: float) -> None:
    on_wall, edge, hidden = seen_upwards(-1.2, away)
    border = np.flatnonzero(np.diff(on_wall))[0]
    np.testing.assert_array_equal(np.flatnonzero(edge), [border + 1])
    np.testing.assert_array_equal(np.flatnonzero(hidden), [border])


def test_kerbs_are_ground(street: SweepWorld) -> None:
    truth = street.sweep_truth(5)
    kerb = truth.is_ground & (truth.kinds == KINDS.index("furniture"))
    assert kerb.sum() > 20
    assert np.abs(truth.normals[kerb, 2]).max() < 0.3  # upright
    floor = truth.points[truth.is_ground & ~kerb]
    for point in truth.points[kerb][::10]:
        near = floor[np.linalg.norm(floor[:, :2] - point[:2], axis=1) < 1.5]
        assert len(near) == 0 or np.abs(near[:, 2] - point[2]).min() < 0.2
