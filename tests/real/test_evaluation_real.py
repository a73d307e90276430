"""The evaluator says the same numbers as an independent script, on real estimates and truths."""

import bz2
import gzip
import json
import math
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from odomap.errors import InputError
from odomap.evaluation.metrics import ate, kitti_segments, read_relations, relations, rpe
from odomap.files.trajectories import read_tum
from odomap.geometry.lie import quaternion_from_rotation
from odomap.geometry.trajectory import Trajectory

ALIGNMENTS = ["se3", "sim3", "yaw", "first", "none"]


@dataclass(frozen=True)
class Pair:
    estimate: Trajectory
    reference: Trajectory
    files: tuple[Path, Path]
    """Truth and estimate as plain TUM text."""


@pytest.fixture(scope="module")
def script(data_folder: Path) -> Path:
    path = data_folder.parent / "tools" / "score.py"
    if not path.is_file():
        message = f"{path}: the independent script is absent"
        if os.environ.get("CI"):
            pytest.fail(message)
        pytest.skip(message)
    return path


@pytest.fixture(scope="module", params=["kitti_00", "fr2_desk"])
def pair(
    request: pytest.FixtureRequest, data_folder: Path, tmp_path_factory: pytest.TempPathFactory
) -> Pair:
    folder, truth = tmp_path_factory.mktemp(request.param), data_folder / "truth"
    if request.param == "kitti_00":
        names = ["eval_KITTI_00_gt.txt.gz", "eval_KITTI_00_ORB.txt.gz"]
        times = np.loadtxt(truth / "kitti_00_times.txt.gz")
        texts = [_tum_of_kitti(np.loadtxt(truth / name), times) for name in names]
    else:
        names = ["eval_fr2_desk_groundtruth.txt.gz", "eval_fr2_desk_ORB.txt.gz"]
        texts = [gzip.decompress((truth / name).read_bytes()).decode() for name in names]
    paths = folder / "truth.txt", folder / "estimate.txt"
    for path, text in zip(paths, texts):
        path.write_text(text)
    return Pair(read_tum(paths[1]), read_tum(paths[0]), paths)


def _tum_of_kitti(rows: np.ndarray, times: np.ndarray) -> str:
    T = rows.reshape(-1, 3, 4)
    U, _, Vt = np.linalg.svd(T[:, :, :3])
    wxyz = quaternion_from_rotation(U @ Vt)
    lines = np.c_[T[:, :, 3], wxyz[:, [1, 2, 3, 0]]]
    assert len(times) == len(lines)
    rows = zip(times, lines.tolist())
    return "".join(f"{t:.7f} {' '.join(map(repr, numbers))}\n" for t, numbers in rows)


def _score(script: Path, *arguments: object) -> dict[str, float]:
    command = [sys.executable, str(script), *map(str, arguments), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    return json.loads(done.stdout)


def _agree(ours: dict[str, float], theirs: dict[str, float]) -> None:
    assert ours.keys() == theirs.keys()
    for name, value in theirs.items():
        assert ours[name] == pytest.approx(value, rel=1e-12, abs=1e-9), name


@pytest.mark.parametrize("align", ALIGNMENTS)
def test_ate_agrees(pair: Pair, script: Path, align: str) -> None:
    ours = ate(pair.estimate, pair.reference, align=align)
    _agree(ours.as_dict(), _score(script, "ate", *pair.files, "--align", align))


@pytest.mark.parametrize(
    ("delta", "unit", "align"),
    [(1.0, "s", "se3"), (0.1, "s", "se3"), (2.0, "m", "sim3"), (1, "f", "se3"), (30, "f", "sim3")],
)
def test_rpe_agrees(pair: Pair, script: Path, delta: float, unit: str, align: str) -> None:
    ours = rpe(pair.estimate, pair.reference, delta=delta, unit=unit, align=align)
    options = ["--delta", delta, "--unit", unit, "--align", align]
    _agree(ours.as_dict(), _score(script, "rpe", *pair.files, *options))


def test_kitti_figures_agree(pair: Pair, script: Path) -> None:
    if "kitti" not in pair.files[0].parent.name:
        with pytest.raises(InputError, match="too short for KITTI"):
            kitti_segments(pair.estimate, pair.reference)
        return
    ours = kitti_segments(pair.estimate, pair.reference)
    _agree(ours.as_dict(), _score(script, "kitti", *pair.files))


def test_matching_rules_agree_at_other_time_differences(pair: Pair, script: Path) -> None:
    for max_dt in (0.0005, 0.005, 0.3):
        ours = ate(pair.estimate, pair.reference, max_dt_s=max_dt)
        _agree(ours.as_dict(), _score(script, "ate", *pair.files, "--max-dt", max_dt))


def test_relations_agree_on_raw_odometry(data_folder: Path, script: Path, tmp_path: Path) -> None:
    odometry = {}
    with bz2.open(data_folder / "laser2d" / "intel.clf.bz2", "rt") as file:
        for line in file:
            if line.startswith("FLASER"):
                words = line.split()
                beams = int(words[1])
                # FLASER n r…r x y θ odom_x odom_y odom_θ ipc_stamp host logger_stamp
                x, y, yaw = map(float, words[5 + beams : 8 + beams])
                odometry.setdefault(words[8 + beams], (x, y, yaw))
    lines = [
        f"{stamp} {x} {y} 0 0 0 {math.sin(yaw / 2)!r} {math.cos(yaw / 2)!r}\n"
        for stamp, (x, y, yaw) in odometry.items()
    ]
    path, reference = tmp_path / "odometry.txt", data_folder / "laser2d" / "intel.relations"
    path.write_text("".join(sorted(lines, key=lambda line: float(line.split()[0]))))
    ours = relations(read_tum(path), read_relations(reference))
    assert ours.relations > 2900
    _agree(ours.as_dict(), _score(script, "relations", reference, path))


def test_excerpts_score_alike(data_folder: Path, script: Path, tmp_path: Path) -> None:
    """A truth disturbed by a drift, every second row, at stamps of today's epoch."""
    for name in ("euroc_mh01", "kitti_stereo"):
        truth = data_folder / name / "groundtruth.txt"
        reference = read_tum(truth)
        rows = [line for line in truth.read_text().splitlines() if line and line[0] not in "#%"]
        rng = np.random.default_rng(3)
        drift = np.cumsum(rng.normal(0, 1e-3, (len(rows), 7)), axis=0)
        lines = []
        for row, d in list(zip(rows, drift))[::2]:
            stamp, *numbers = row.replace(",", " ").split()[:8]
            numbers = np.array(numbers, float) + d
            numbers[3:] /= np.linalg.norm(numbers[3:])
            lines.append(" ".join([stamp, *map(repr, numbers.tolist())]))
        path = tmp_path / f"{name}.txt"
        path.write_text("\n".join(lines) + "\n")
        estimate: Trajectory = read_tum(path)
        _agree(ate(estimate, reference).as_dict(), _score(script, "ate", truth, path))
        theirs = _score(script, "rpe", truth, path, "--delta", 0.5)
        _agree(rpe(estimate, reference, 0.5).as_dict(), theirs)
