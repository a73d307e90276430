"""Recordings of a 3D LiDAR as they are found on disks, and what `odomap run` makes of them.

What is cut, lies, or is missing costs its sweeps and nothing else; what cannot be read right is one
line that says the mend, and what was mapped before stays.
"""

import json
import re
import signal

import numpy as np
import pytest

from odomap.cli import main
from odomap.errors import CalibrationError
from odomap.files.clouds import read_ply_points
from odomap.files.mapfile import load_map
from odomap.files.trajectories import read_tum
from odomap.run import Interrupted, run
from odomap.simulation.export import export_velodyne
from odomap.simulation.sweepspec import SweepSpec
from odomap.simulation.sweepworld import SweepWorld
from odomap.sources import disturb
from odomap.sources.wrappers import Changed
from pcapworlds import capture, drive, frame_of
from sweepruns import Kept
from sweepworlds import pcd_bytes


@pytest.fixture(scope="module")
def street():
    return Kept("street", 16, 60, 2)


def columns_of(frame):
    """Return a sweep as drivers write it, times in nanoseconds."""
    sweep = frame.cloud
    named = dict(zip("xyz", sweep.points.T.astype(np.float32), strict=True))
    named |= {"intensity": sweep.intensities, "ring": sweep.beams.astype(np.uint16)}
    return named | {"t": np.rint(1e9 * sweep.times).astype(np.uint32)}


@pytest.fixture
def folder(street, tmp_path):
    """Return a folder of 30 PCD files, ten a second."""
    root = tmp_path / "sweeps"
    root.mkdir()
    for k in range(30):
        name = f"{1_700_000_000 + k // 10}.{k % 10}00000.pcd"
        (root / name).write_bytes(pcd_bytes(columns_of(street.frame(k)), "binary"))
    return root


def ran(data, out):
    """Run it as a person does; return what is told, the path, and how many keyframes there are."""
    assert main(["run", str(data), "--out", str(out), "--quiet"]) == 0
    told = json.loads((out / "metrics.json").read_text())
    return told, read_tum(out / "trajectory.tum"), load_map(out / "map.odomap").num_keyframes


def test_files_that_are_cut_or_lie_cost_their_sweeps_and_nothing_else(folder, tmp_path):
    files = sorted(folder.iterdir())
    files[12].write_bytes(files[12].read_bytes()[:-1000])
    lies = re.sub(rb"(POINTS|WIDTH) \d+", rb"\1 999999999", files[14].read_bytes())
    files[14].write_bytes(lies)
    told, path, keyframes = ran(folder, tmp_path / "out")
    assert (told["frames"], told["lost"], told["skipped"]) == (28, 0, 2)
    skipped = {item["file"]: item["reason"] for item in told["skipped_measurements"]}
    assert set(skipped) == {str(files[12]), str(files[14])}
    assert len(path) == 28
    assert keyframes > 5


def test_sweeps_without_a_return_are_lost_and_the_next_is_not(street, folder, tmp_path):
    files = sorted(folder.iterdir())
    for k, value in ((12, np.nan), (13, 0.0), (20, None)):
        columns = columns_of(street.frame(k))
        if value is None:
            columns = {name: column[:0] for name, column in columns.items()}
        else:
            columns |= {axis: np.full_like(columns[axis], value) for axis in "xyz"}
        files[k].write_bytes(pcd_bytes(columns, "binary"))
    files[25].write_bytes(files[24].read_bytes())  # twice the same
    told, path, keyframes = ran(folder, tmp_path / "out")
    assert (told["frames"], told["lost"], len(path)) == (30, 4, 26)
    assert told["skipped"] == 0
    assert keyframes > 5


def test_what_a_rig_says_and_sweeps_deny_is_one_line(folder, tmp_path, capsys):
    rig = "odomap_rig: 1\nlidars:\n  - {name: top, beams: 64}\n"
    (folder / "rig.yaml").write_text(rig)
    assert main(["run", str(folder), "--out", str(tmp_path / "out"), "--quiet"]) == 2
    told = capsys.readouterr().err.strip().splitlines()
    assert len(told) == 1
    assert "16 beams, the rig says 64: mend 'beams'" in told[0]


def test_times_in_no_unit_are_one_line(street, folder, tmp_path, capsys):
    for k, file in enumerate(sorted(folder.iterdir())):
        columns = columns_of(street.frame(k))
        file.write_bytes(pcd_bytes(columns | {"t": columns["t"] * 3.2e-13}, "binary"))
    assert main(["run", str(folder), "--out", str(tmp_path / "out"), "--quiet"]) == 2
    told = capsys.readouterr().err.strip().splitlines()
    assert len(told) == 1
    assert "say it by ?unit=us" in told[0]


def test_a_drive_of_which_a_file_is_cut_goes_on_without_it(tmp_path):
    world = SweepWorld(SweepSpec("street", 4, 25, beams=64, columns=450))
    root = export_velodyne(world, tmp_path / "drive")
    whole, _, _ = ran(root, tmp_path / "whole")
    file = root / "velodyne" / "000012.bin"
    file.write_bytes(file.read_bytes()[:-7])
    told, path, keyframes = ran(root, tmp_path / "out")
    assert (told["frames"], told["lost"], told["skipped"]) == (24, 0, 1)
    assert told["skipped_measurements"][0]["file"] == str(file)
    assert "is it cut off" in told["skipped_measurements"][0]["reason"]
    assert len(path) == 24
    assert keyframes > 5
    assert whole["frames"] == 25
    assert told["ate_rmse_m"] < max(2.0 * whole["ate_rmse_m"], 0.05)


def test_lost_packets_cost_what_they_saw(tmp_path):
    """One in ten is lost anywhere, half a turn at once, and then four turns."""
    pytest.importorskip("velodyne_decoder")
    rng = np.random.default_rng(0)
    sent = [frame_of(data) for data in drive(24, 5.0)]
    is_kept = rng.random(len(sent)) > 0.1
    is_kept[500:540] = is_kept[900:1200] = False
    is_kept[-1] = True  # after which nobody knows what is missing
    kept = [sent[k] for k in np.flatnonzero(is_kept)]
    told, path, keyframes = ran(capture(tmp_path / "a.pcap", kept), tmp_path / "out")
    assert 18 <= told["frames"] <= 21
    assert told["lost"] == 0
    assert f"{len(sent) - len(kept)} packets were lost" in " ".join(told["warnings"])
    way = np.linalg.norm(path.positions - path.positions[0], axis=1)
    np.testing.assert_allclose(way, 5e-9 * (path.stamps_ns - path.stamps_ns[0]), atol=0.08)
    assert path.stamps_ns[-1] - path.stamps_ns[0] > 2e9
    assert keyframes > 4


def test_sweeps_in_another_unit_end_a_run_and_keep_what_there_is(street, tmp_path):
    wrong = disturb.misscale_times(street, 1e3)
    changed = Changed(street, "changed", lambda f: f if f.id < 20 else wrong.frame(f.id))
    with pytest.raises(CalibrationError, match="are they in milliseconds, or nanoseconds") as told:
        run(changed, tmp_path)
    assert "\n" not in str(told.value)
    assert len(read_tum(tmp_path / "trajectory.tum")) == 20
    assert load_map(tmp_path / "map.odomap").num_keyframes > 3


def test_ctrl_c_keeps_what_was_mapped(street, tmp_path):
    def stop(frame):
        if frame.id == 25:
            signal.raise_signal(signal.SIGINT)
        return frame

    with pytest.raises(Interrupted) as stopped:
        run(Changed(street, "stopped", stop), tmp_path)
    assert stopped.value.result.metrics["interrupted"] is True
    assert len(read_tum(tmp_path / "trajectory.tum")) == 26
    assert load_map(tmp_path / "map.odomap").num_keyframes > 5
    assert len(read_ply_points(tmp_path / "cloud.ply").columns["x"]) > 5000
