"""A 3D LiDAR from the command line: run, its files, localise, continue, export."""

import json

import numpy as np
import pytest

from odomap.cli import main
from odomap.files.clouds import read_ply_points
from odomap.files.mapfile import load_map
from odomap.files.pcd import read_pcd
from odomap.files.trajectories import read_tum
from odomap.sources.simulated import SimulatedSource

WORLD = "sim:street?sensors=lidar3d&beams=16&frames={}&seed=1"


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "street"
    assert main(["run", WORLD.format(60), "--out", str(out), "--quiet"]) == 0
    return out


def test_a_run_leaves_path_map_cloud_and_grid(done):
    metrics = json.loads((done / "metrics.json").read_text())
    assert metrics["lost"] == 0
    assert metrics["ate_rmse_m"] < 0.05
    source = SimulatedSource(WORLD.format(60))
    path = read_tum(done / "trajectory.tum")
    assert path.stamps_ns.tolist() == source.truth.stamps_ns.tolist()
    points = read_ply_points(done / "cloud.ply")
    assert {"x", "y", "z", "intensity"} <= set(points.columns)
    assert len(points.columns["x"]) > 20_000
    assert float(np.max(points.columns["intensity"])) > 0.0
    for name in ("cloud.png", "grid.yaml", "grid.pgm", "grid.png"):
        assert (done / name).stat().st_size > 100
    assert "cloud.ply" in (done / "report.html").read_text()


def test_the_first_keyframe_has_no_cloud_as_its_motion_was_not_known(done):
    kept = load_map(done / "map.odomap")
    clouds = [kept.keyframe(k).cloud for k in kept.keyframe_ids.tolist()]
    assert clouds[0] is None
    assert all(cloud is not None and cloud.dtype == np.float32 for cloud in clouds[1:])


def test_another_lidar_is_localised_in_its_map(done, tmp_path):
    out = tmp_path / "there"
    other = WORLD.replace("beams=16", "beams=32").format(25)
    assert main(["localize", str(done), other, "--out", str(out), "--quiet"]) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["lost"] == 0  # the first as soon as the second shows how it moved
    source = SimulatedSource(other)
    path = read_tum(out / "trajectory.tum")
    assert len(path) == 25
    rows = np.searchsorted(source.truth.stamps_ns, path.stamps_ns)
    origin = source.truth.Ts_world_body[0]  # the map's world is where it began
    true = np.linalg.inv(origin) @ source.truth.Ts_world_body[rows]
    off = np.linalg.norm(path.Ts_world_body[:, :3, 3] - true[:, :3, 3], axis=1)
    assert np.median(off) < 0.1
    assert off.max() < 0.4


def test_a_run_goes_on_where_the_map_ends(done, tmp_path):
    out = tmp_path / "more"
    assert main(["continue", str(done), WORLD.format(90), "--out", str(out), "--quiet"]) == 0
    before, after = load_map(done / "map.odomap"), load_map(out / "map.odomap")
    assert after.num_keyframes > before.num_keyframes
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["lost"] == 0
    assert metrics["map_keyframes"] == after.num_keyframes > metrics["keyframes"]


def test_the_cloud_is_exported_by_the_ending_of_its_name(done, tmp_path, capsys):
    pcd, ply = tmp_path / "a.pcd", tmp_path / "b.ply"
    assert main(["export", str(done), "--cloud", str(pcd)]) == 0
    coarse = ["export", str(done / "map.odomap"), "--cloud", str(ply), "--voxel", "1.0"]
    assert main([*coarse, "--no-picture"]) == 0
    fine, thin = read_pcd(pcd).columns["x"], read_ply_points(ply).columns["x"]
    assert len(thin) < 0.5 * len(fine)
    assert (tmp_path / "a.png").exists()
    assert not (tmp_path / "b.png").exists()
    capsys.readouterr()
    assert main(["export", str(done), "--cloud", str(tmp_path / "a.xyz")]) == 2
    assert "a.xyz: give a name that ends in .ply or .pcd" in capsys.readouterr().err
    assert main(["export", str(done), "--mesh", str(tmp_path / "m.ply")]) == 2
    assert "give --cloud FILE" in capsys.readouterr().err


def test_what_is_for_cameras_is_refused_in_one_line(done, tmp_path, capsys):
    for command, says in (
        (["export", str(done), "--colmap", str(tmp_path / "c")], "a laser's map has no images"),
        (["merge", str(done), str(other_map(done, tmp_path)), "--out", str(tmp_path / "m.odomap")],
         "maps of cameras alone can be merged"),
        (["run", WORLD.format(3), "--odometry-only", "--out", str(tmp_path / "o")],
         "--cloud-closing.enabled false looks for no loops"),
    ):  # fmt: skip
        assert main(command) == 2
        err = capsys.readouterr().err.strip().splitlines()
        assert says in err[-1]


def other_map(done, tmp_path):
    file = tmp_path / "other.odomap"
    file.write_bytes((done / "map.odomap").read_bytes())
    return file


def test_info_of_a_run_is_that_of_its_map(done, capsys):
    assert main(["info", str(done)]) == 0
    of_run = capsys.readouterr().out
    assert main(["info", str(done / "map.odomap")]) == 0
    assert of_run == capsys.readouterr().out
    assert "made with      lidar" in of_run
    assert of_run.count("sensors") == 1
    assert "landmarks" not in of_run
    assert not [line for line in of_run.splitlines() if not line.split(maxsplit=1)[1:]]


def test_directions_that_nothing_fixes_are_warned_of(tmp_path, capsys):
    world = "sim:tunnel?sensors=lidar3d&beams=16&columns=360&frames=25&seed=2"
    assert main(["run", world, "--out", str(tmp_path / "t"), "--quiet"]) == 0
    err = capsys.readouterr().err
    assert "tracked with a doubt, first frame" in err
    assert "do not fix translation" in err


def test_clouds_of_both_kinds_are_registered(done, tmp_path, capsys):
    for name in ("a.pcd", "b.ply"):
        assert main(["export", str(done), "--cloud", str(tmp_path / name), "--no-picture"]) == 0
    assert main(["register", str(tmp_path / "a.pcd"), str(tmp_path / "b.ply")]) == 0
    assert "converged" in capsys.readouterr().out


def test_a_path_is_compared_with_the_truth_of_a_simulated_world(done, capsys):
    assert main(["eval", str(done / "trajectory.tum"), WORLD.format(60), "--json"]) == 0
    out = capsys.readouterr().out
    run = json.loads((done / "metrics.json").read_text())
    assert f"{run['ate_rmse_m']:.6g}"[:6] in out
