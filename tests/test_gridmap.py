"""`odomap export --grid`: grids of map files and of runs with depth, and what goes wrong."""

import json

import numpy as np
import pytest
import yaml

import gridworlds
from gridworlds import DEPTH, LASER, SWEEPS, occupied, recorded, true_map
from odomap.cli import main
from odomap.errors import ConfigError, InputError
from odomap.files.grids import load_grid
from odomap.files.mapfile import save_map
from odomap.files.trajectories import write_tum
from odomap.gridmap import export_grid
from odomap.lidar.slices import SliceConfig
from odomap.maps.map import Map
from odomap.maps.occupancy import GridConfig, occupancy_grid


def a_map(folder, data, every, rig=True):
    file = folder / "map.odomap"
    save_map(file, true_map(data, every), recorded(data).rig if rig else None)
    return file


def a_run(folder, data=DEPTH, every=20, metric=True):
    folder.mkdir(exist_ok=True)
    truth = recorded(data).truth
    write_tum(folder / "keyframes.tum", truth.rows(list(range(0, len(truth), every))))
    (folder / "config.yaml").write_text(f"odomap_config: 1\ndata: '{data}'\n")
    (folder / "metrics.json").write_text(json.dumps({"is_metric": metric}))
    return folder


def test_a_map_of_scans_becomes_what_map_server_loads(tmp_path, capsys):
    file, target = a_map(tmp_path, LASER, 10), tmp_path / "out" / "hall.yaml"
    assert main(["export", str(file), "--grid", str(target), "--quiet"]) == 0
    out, err = capsys.readouterr()
    for word in ("20 with scans", "cells of 0.05 m", "hall.yaml", "hall.pgm", "hall.png"):
        assert word in out
    assert not err
    said = yaml.safe_load(target.read_text())
    assert (said["image"], said["resolution"], said["negate"]) == ("hall.pgm", 0.05, 0)
    loaded = load_grid(target)
    made = occupancy_grid(true_map(LASER, 10), recorded(LASER).rig)
    np.testing.assert_allclose(occupied(loaded), occupied(made), atol=1e-9)
    assert (tmp_path / "out" / "hall.png").read_bytes()[:4] == b"\x89PNG"


def test_resolution_and_heights_are_options(tmp_path):
    file, target = a_map(tmp_path, SWEEPS, 10), tmp_path / "room.yaml"
    options = ["--resolution", "0.1", "--height", "0.3", "1.2", "--no-picture", "--quiet"]
    assert main(["export", str(file), "--grid", str(target), *options]) == 0
    assert not target.with_suffix(".png").exists()
    grid = load_grid(target)
    assert grid.resolution == 0.1
    away = gridworlds.distances(occupied(grid), gridworlds.surfaces(SWEEPS, 0.3, 1.2))
    assert np.mean(away < 0.1) > 0.95


def test_a_run_with_depth_becomes_a_grid_of_what_stands_there(tmp_path):
    folder = a_run(tmp_path / "run")
    result = export_grid(folder, tmp_path / "room.yaml")
    assert result.made.made_of == "depth"
    assert any("depth is used up to" in note for note in result.notes)
    assert any("the floor is" in note for note in result.notes)
    centres = occupied(result.made.grid)
    away = gridworlds.distances(centres, gridworlds.surfaces(DEPTH, 0.1, 1.8))
    assert len(centres) > 800
    assert np.mean(away < 0.075) > 0.97  # in the cells of walls and in those beside them
    assert result.made.grid.probability(result.made.path).max() <= 0.5
    free = result.made.grid.centres(np.argwhere(result.made.grid.log_odds < -0.6))
    assert np.mean(gridworlds.distances(free, gridworlds.surfaces(DEPTH, 0.1, 1.8)) < 0.02) < 0.01


def test_the_same_run_gives_the_same_bytes(tmp_path):
    folder = a_run(tmp_path / "run", every=60)
    written = [export_grid(folder, tmp_path / n / "a.yaml").written for n in ("x", "y")]
    for first, second in zip(*written):
        assert first.read_bytes() == second.read_bytes()


def test_what_cannot_be_made_is_one_clear_line(tmp_path, capsys):
    empty, target = tmp_path / "empty.odomap", tmp_path / "a.yaml"
    save_map(empty, Map())
    unmounted = tmp_path / "unmounted"
    unmounted.mkdir()
    a_map(unmounted, LASER, 50, rig=False)
    mono = a_run(tmp_path / "mono", metric=False)
    single = a_run(tmp_path / "single", "sim:room?seed=1&frames=25&resolution=320x200&sensors=mono")
    for run, said in (
        (empty, "holds neither scans nor clouds"),
        (unmounted, "--rig FILE"),
        (mono, "no scale"),
        (single, "neither depth nor a stereo pair"),
        (tmp_path / "none", "No such file"),
    ):
        with pytest.raises(InputError, match=said):
            export_grid(run, target)
    with pytest.raises(InputError, match=r"ends in \.yaml"):
        export_grid(empty, tmp_path / "a.pgm")
    sweeps, blind = a_map(tmp_path, SWEEPS, 30), GridConfig(slice=SliceConfig(farthest=0.2))
    with pytest.raises(InputError, match="nothing was seen"):
        export_grid(sweeps, target, blind)
    assert main(["export", str(empty), "--grid", str(target), "--height", "2", "1"]) == 2
    assert "height: 2 to 1" in capsys.readouterr().err
    with pytest.raises(ConfigError):
        GridConfig(resolution=0.0)
    assert not target.exists()
