"""Clouds and meshes of runs, as a person makes them: files, words, and what goes wrong."""

import functools
import shutil

import numpy as np
import pytest

from odomap.cli import main
from odomap.errors import InputError, OdomapError
from odomap.export import export
from odomap.files.clouds import read_ply
from odomap.files.trajectories import write_tum
from odomap.geometry.trajectory import Trajectory
from odomap.sources.simulated import SimulatedSource

ROOM = "sim:room?seed=1&frames=25&resolution=320x200&sensors=mono,depth"
PAIR = "sim:room?seed=1&frames=25&resolution=320x200&sensors=stereo"


@functools.cache
def room(data):
    return SimulatedSource(data)


def a_run(folder, data=ROOM, rows=range(0, 25, 6), config=None, name="keyframes.tum"):
    """Make a run's folder with true poses."""
    folder.mkdir(exist_ok=True)
    truth = room(data).truth
    write_tum(folder / name, truth.rows(list(rows)))
    text = f"odomap_config: 1\ndata: '{data}'\n" if config is None else config
    (folder / "config.yaml").write_text(text, encoding="utf-8")
    return folder


def distance_to_room(points, normals, data=ROOM):
    """Distances to the nearest surface of the room that faces the same way."""
    r = room(data).world.scene.rectangles
    corner, u, v = (r.frames[:, k : k + 3] for k in (0, 3, 6))
    out = -np.cross(u, v)
    best = np.full(len(points), np.inf)
    for k in range(len(r)):
        offset = points - corner[k]
        s, t = offset @ u[k], offset @ v[k]
        aside = s - np.clip(s, 0, r.faces[k, 0]), t - np.clip(t, 0, r.faces[k, 1])
        distance = np.sqrt((offset @ out[k]) ** 2 + aside[0] ** 2 + aside[1] ** 2)
        faces_us = (normals @ out[k] > 0) | (r.faces[k, 6] > 0)
        best = np.where(faces_us, np.minimum(best, distance), best)
    return best


def spread_over(mesh, count=20_000):
    """Points spread evenly over the triangles, and normals there."""
    rng = np.random.default_rng(0)
    areas = mesh.areas()
    rows = np.searchsorted(np.cumsum(areas) / areas.sum(), rng.random(count))
    weights = rng.dirichlet([1, 1, 1], count)
    points = np.einsum("nk,nkd->nd", weights, mesh.points[mesh.faces[rows]].astype(float))
    return points, mesh.normals[mesh.faces[rows]].sum(1).astype(float)


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    folder = a_run(tmp_path_factory.mktemp("run"))
    return folder, export(folder)


def test_a_mesh_of_a_room_is_within_2_cm_of_the_truth(exported):
    folder, result = exported
    mesh = read_ply(folder / "mesh.ply")
    points, normals = spread_over(mesh)
    distance = distance_to_room(points, normals)
    assert distance.mean() < 0.02
    assert np.median(distance) < 0.003
    assert np.mean(distance > 0.05) < 0.01
    assert len(mesh.faces) > 50_000
    assert result.keyframes == 5
    assert result.config.voxel == 0.02


def test_a_path_without_scale_is_refused(tmp_path):
    folder = a_run(tmp_path / "run", PAIR)  # there is depth, but the run used one camera of two
    (folder / "metrics.json").write_text('{"is_metric": false}', encoding="utf-8")
    with pytest.raises(InputError, match=r"run: the run is of one camera.*no scale.*--preset mono"):
        export(folder)
    assert not (folder / "mesh.ply").exists()


def test_the_mesh_covers_what_was_seen(exported):
    from scipy.spatial import cKDTree

    result = exported[1]
    source = room(ROOM)
    camera = source.rig.cameras[0].camera
    u, v = np.meshgrid(np.arange(4, 316, 8.0), np.arange(4, 196, 8.0))
    rays = camera.unproject(np.stack([u.ravel(), v.ravel()], 1))
    depth = source.frame(12).depth[4:196:8, 4:316:8].ravel()
    seen = (depth > 0) & (depth < result.config.max_depth)
    T = source.truth.pose(12)  # not one of the keyframes
    points = T @ (rays / rays[:, 2:] * depth[:, None])[seen]
    gap, _ = cKDTree(spread_over(result.surface, 100_000)[0]).query(points)
    assert np.mean(gap < 0.05) > 0.95


def test_the_cloud_is_the_points_of_the_mesh(exported):
    folder, _ = exported
    cloud, mesh = read_ply(folder / "cloud.ply"), read_ply(folder / "mesh.ply")
    np.testing.assert_array_equal(cloud.points, mesh.points)
    np.testing.assert_array_equal(cloud.colours, mesh.colours)
    assert len(cloud.faces) == 0
    assert np.ptp(cloud.colours) > 50
    assert (folder / "mesh.png").read_bytes()[:4] == b"\x89PNG"


def test_the_same_run_gives_the_same_bytes(exported, tmp_path):
    folder, _ = exported
    again = a_run(tmp_path / "again")
    export(again)
    for name in ("cloud.ply", "mesh.ply", "mesh.png"):
        assert (again / name).read_bytes() == (folder / name).read_bytes()


def test_a_stereo_run_has_a_mesh_too(tmp_path):
    folder = a_run(tmp_path / "run", PAIR)
    result = export(folder, mesh=tmp_path / "m.ply", voxel=0.05, picture=False)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["m.ply", "run"]
    points, normals = spread_over(result.surface)
    distance = distance_to_room(points, normals)
    assert np.median(distance) < 0.03
    assert distance.mean() < 0.06  # images a quarter of the usual size, and few


def test_where_keyframes_are_not_known_the_path_is_thinned(tmp_path):
    folder = a_run(tmp_path / "run", rows=range(25), name="trajectory.tum")
    result = export(folder, cloud=tmp_path / "c.ply", voxel=0.05)
    assert 3 <= result.keyframes < 25
    assert any("no keyframes.tum" in note for note in result.notes)
    assert not (tmp_path / "mesh.png").exists()


def test_the_command_says_what_it_made(tmp_path, capsys):
    folder = a_run(tmp_path / "run", rows=[0, 12])
    mesh = tmp_path / "deep" / "m.ply"
    assert main(["export", str(folder), "--mesh", str(mesh), "--voxel", "0.05"]) == 0
    out, err = capsys.readouterr()
    for word in ("keyframes", "points", "triangles", "voxels of 0.05 m", str(mesh), "m.png"):
        assert word in out
    assert "depth is used up to" in err
    assert not (folder / "cloud.ply").exists()


def test_too_little_memory_means_larger_voxels_unless_they_were_asked_for(tmp_path, monkeypatch):
    from odomap.maps import tsdf

    folder = a_run(tmp_path / "run", rows=[0, 12])
    small = tsdf.TsdfConfig
    monkeypatch.setattr(tsdf, "TsdfConfig", lambda voxel: small(voxel=voxel, memory_mb=12.0))
    result = export(folder, cloud=tmp_path / "c.ply")
    assert result.config.voxel > 0.02
    assert any("need too much memory" in note for note in result.notes)
    with pytest.raises(InputError, match=r"--voxel 0.04"):
        export(folder, cloud=tmp_path / "c.ply", voxel=0.02)


def test_a_recording_that_moved_is_found_where_it_is_now(tmp_path):
    world = "odomap_world: 1\nkind: room\nseed: 1\nframes: 25\nresolution: [160, 100]\n"
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "world.yaml").write_text(world + "sensors: [mono, depth]\n", "utf-8")
    old, new = tmp_path / "old", tmp_path / "new"
    folder = a_run(tmp_path / "run", config=f"data: {old}\n", rows=[0, 12])
    shutil.move(old, new)
    with pytest.raises(InputError) as error:
        export(folder)
    assert f"{old}: the recording of {folder} is no longer there" in str(error.value)
    assert "--data PATH" in str(error.value)
    assert export(folder, data=new, voxel=0.05).keyframes == 2


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ("data: 'camera:0'\n", "which left no recording"),
        ("preset: x\n", "does not say of which recording"),
        ("data: [\n", "not YAML"),
        (f"data: '{ROOM}'\nrig: gone.yaml\n", "gone.yaml: the calibration of"),
        ("data: 'sim:room?frames=25&sensors=mono'\n", "there is no depth"),
        (f"data: '{ROOM}&rate_hz=7'\n".replace("seed=1", "seed=2"), None),
    ],
)
def test_runs_that_cannot_be_exported(tmp_path, config, message):
    folder = a_run(tmp_path / "run", config=config, rows=[5, 12])
    if message is None:  # another recording: other stamps
        message = "has no frame at any of the 2 keyframes' stamps"
    with pytest.raises(InputError, match=message):
        export(folder)
    assert sorted(p.name for p in folder.iterdir()) == ["config.yaml", "keyframes.tum"]


def test_what_is_wrong_with_the_words(tmp_path, capsys):
    folder = a_run(tmp_path / "run", rows=[0])
    for words, message in (
        ([str(tmp_path / "none")], "no such folder: give the output folder of `odomap run`"),
        ([str(tmp_path)], "has no keyframes.tum"),
        ([str(folder), "--mesh", "a.obj"], "only PLY is written"),
        ([str(folder), "--mesh", "a.ply", "--cloud", "a.ply"], "both a.ply: give two names"),
        ([str(folder), "--voxel", "0"], "voxel: 0.0 must be above 0"),
        ([str(folder), "--voxel", "big"], "--voxel"),
        ([str(folder), "--max-depth", "-1"], "max_depth: -1.0 must be above 0"),
        ([str(folder), "--voxle", "1"], "did you mean '--voxel'?"),
    ):
        assert main(["export", *words]) == 2, words
        assert message in capsys.readouterr().err, words
    assert not (folder / "cloud.ply").exists()


def test_no_surface_within_reach(tmp_path, capsys):
    folder = a_run(tmp_path / "run", rows=[0])
    with pytest.raises(OdomapError, match=r"no surface within 0.2 m .* \(--max-depth\)"):
        export(folder, max_depth=0.2)
    assert main(["export", str(folder), "--max-depth", "0.2", "--quiet"]) == 1
    assert not (folder / "cloud.ply").exists()


def test_stamps_with_six_decimals_are_the_same_stamps(tmp_path):
    folder = a_run(tmp_path / "run", rows=[0, 12])
    truth = room(ROOM).truth.rows([1, 13])
    rough = Trajectory(truth.stamps_ns // 1000 * 1000 + 400, truth.Ts_world_body)
    write_tum(folder / "keyframes.tum", rough)
    assert export(folder, voxel=0.1, picture=False).keyframes == 2
