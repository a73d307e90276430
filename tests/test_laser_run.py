"""2D SLAM as a person uses it: a run, its grid and report, a map used again."""

import json

import numpy as np
import pytest

from odomap.cli import main
from odomap.evaluation.metrics import ate
from odomap.evaluation.walls import compare_walls
from odomap.files.grids import load_grid
from odomap.files.mapfile import load_map
from odomap.files.trajectories import read_tum
from odomap.maps.edges import LOOP
from odomap.sources.open import open as open_source
from odomap.system.submaps import SUBMAP

WORLD = "sim:hall?sensors=laser&seed=4&rounds=1.2"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Return the folder of a run."""
    folder = tmp_path_factory.mktemp("laser") / "run"
    assert main(["run", WORLD, "--out", str(folder), "--quiet"]) == 0
    return folder


def test_a_laser_world_is_mapped_within_three_thousandths_of_the_way(run):
    numbers = json.loads((run / "metrics.json").read_text())
    assert numbers["lost"] == 0
    assert numbers["tracked"] == numbers["frames"]
    assert numbers["ate_rmse_m"] < 0.003 * numbers["path_m"]
    assert numbers["is_metric"]
    kinds = load_map(run / "map.odomap").edges().kind
    assert SUBMAP in kinds
    assert numbers["loops_closed"] == sum(kind == LOOP for kind in kinds)


def test_there_is_one_row_for_each_scan_with_its_stamp(run):
    source = open_source(WORLD)
    path = read_tum(run / "trajectory.tum")
    np.testing.assert_array_equal(path.stamps_ns, source.stamps_ns)
    assert ate(path, source.truth).rmse < 0.05


def test_the_grid_shows_the_walls_where_they_are(run):
    source, grid = open_source(WORLD), load_grid(run / "grid.yaml")
    world, cells = source.world, np.argwhere(grid.log_odds > 0)
    # The map's world is the first pose.
    T = source.truth.Ts_world_body[0]
    centres = grid.centres(cells) @ T[:2, :2].T + T[:2, 3]
    seen = np.concatenate([world.hits(k) for k in range(0, len(source), 10)])[:, :2]
    found = compare_walls(centres, world.plan.distances(centres), seen, grid.resolution)
    assert found.true > 0.9
    assert (run / "grid.pgm").exists()
    assert (run / "grid.png").exists()
    report = (run / "report.html").read_text()
    assert "which map_server loads" in report


@pytest.mark.usefixtures("no_report")
def test_the_map_is_localised_in_and_goes_on(run, tmp_path):
    again = "sim:hall?sensors=laser&seed=4&rounds=0.3"
    assert main(["localize", str(run), again, "--out", str(tmp_path / "there"), "--quiet"]) == 0
    numbers = json.loads((tmp_path / "there" / "metrics.json").read_text())
    assert numbers["lost"] == 0
    assert numbers["ate_rmse_m"] < 0.03
    assert not (tmp_path / "there" / "map.odomap").exists()
    assert main(["continue", str(run), again, "--out", str(tmp_path / "more"), "--quiet"]) == 0
    more = load_map(tmp_path / "more" / "map.odomap")
    assert more.num_keyframes > load_map(run / "map.odomap").num_keyframes
    assert json.loads((tmp_path / "more" / "metrics.json").read_text())["ate_rmse_m"] < 0.03


def test_a_map_of_another_laser_is_refused(run, capsys):
    code = main(["localize", str(run), WORLD + "&beams=181", "--out", "nowhere", "--quiet"])
    assert code == 2
    assert "541 beams" in (said := capsys.readouterr().err)
    assert "181 beams" in said
    assert said.count("\n") == 1
