"""`odomap info` on every kind of source, as a person uses it."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from odomap.cli import main
from sweepworlds import write_velodyne

Make = Callable[..., Path]
Call = Callable[..., tuple[int, str, str]]


@pytest.fixture
def info(capfd: pytest.CaptureFixture[str]) -> Call:
    """Return what runs `odomap info` and returns its exit code and what it printed."""

    def call(*words: object) -> tuple[int, str, str]:
        code = main(["info", *map(str, words)])
        out, err = capfd.readouterr()
        return code, out, err

    return call


def test_tum(tum: Make, info: Call) -> None:
    code, out, _ = info(tum(), "--check")
    assert code == 0
    assert out.splitlines()[0] == "desk (tum)"
    assert "frames         8 in 0.23 s, 30 Hz" in out
    assert "depth          5000 per metre, registered to rgb, of 8 frames; +3 ms from colour" in out
    assert "ground truth   9 poses, 0.80 m, covers 7 frames" in out
    assert "readable       8" in out


def test_sweeps(tmp_path: Path, info: Call) -> None:
    root = write_velodyne(tmp_path / "drive", frames=4)
    code, out, _ = info(root, "--check")
    assert code == 0
    assert out.startswith("drive (velodyne)\n  frames         4 in 0.30 s, 10 Hz\n")
    assert "readable       4" in out
    assert "lidar velodyne 64 beams above each other, 1 to 120 m, 10 Hz, clockwise sweep" in out
    assert "-24° to 2" in out
    assert "360° around" in out
    assert "point times    -50 to 50 ms, from the azimuth" in out
    assert "beams          64, from the order of the rows" in out
    assert "intensity      0 to 1" in out
    code, out, _ = info(f"{root}?times=off", "--json")
    facts = json.loads(out)
    assert facts["sweeps"]["times"] == ""
    assert facts["sweeps"]["beams"] == 64
    assert facts["gaps"] == []
    assert "point times    none" in info(f"{root}?times=off")[1]
    (root / "times.txt").write_text("0.0\n0.1\n0.2\n1.2\n")
    assert "gap            1.000 s after frame 2" in info(root)[1]


def test_lines_of_a_solid_state_lidar_are_not_above_each_other(info: Call) -> None:
    world = "sim:room?sensors=lidar3d&frames=2&beams=8&columns=60"
    assert "beams          8, in the sweeps\n" in info(world)[1]
    assert "8, in the sweeps; not above each" in info(f"{world}&pattern=solid_state")[1]


def test_truncated_sweep(tmp_path: Path, info: Call) -> None:
    root = write_velodyne(tmp_path / "drive", frames=3)
    file = root / "velodyne" / "000001.bin"
    file.write_bytes(file.read_bytes()[:-1])
    code, out, _ = info(root, "--check")
    assert code == 0
    assert "readable       2" in out
    assert f"skipped        {file}: " in out


def test_video(clip: Make, info: Call) -> None:
    file = clip(frames=12)
    code, out, _ = info(file)
    assert code == 0
    assert "frames         12 in 0.37 s, 30 Hz\n" in out
    assert "codec          mp4v" in out
    assert "rotation" not in out
    code, out, _ = info(file, "--json")
    assert json.loads(out)["details"] == {"container": "MP4", "codec": "mp4v", "rotation_deg": 0}


def test_folder_whose_rate_varies(
    tmp_path: Path, save_image: Callable[..., None], calibrate: Make, info: Call
) -> None:
    root = tmp_path / "pictures"
    for millisecond in (0, 30, 60, 160):
        save_image(root / f"{millisecond / 1000:.3f}.png", np.zeros((48, 64), np.uint8))
    calibrate(root / "rig.yaml", (64, 48))
    code, out, _ = info(root)
    assert code == 0
    assert out.startswith("pictures (folder)\n")
    assert "4 in 0.16 s, 33.333 Hz (varies: 30 to 100 ms apart)" in out
    assert "gap            0.100 s after frame 2" in out


def test_camera(clip: Make, info: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    file = clip()
    monkeypatch.chdir(file.parent)
    code, out, _ = info(f"camera:{file.name}")
    assert code == 0
    assert "frames         unknown: it is live" in out
    assert "device         clip.mp4, played" in out
    code, _, err = info(f"camera:{file.name}", "--check")
    assert code == 2
    assert err == f"odomap: camera:{file.name}: a live camera has no end: leave --check out\n"


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("text.mp4", "text.mp4: is not a video that can be read"),
        ("broken.avi", "broken.avi: codec 'QQQQ' cannot be decoded here: convert it: ffmpeg -i"),
        ("uncalibrated", "uncalibrated: there is no calibration"),
        ("camera:9", "camera 9 cannot be opened: is it plugged in"),
    ],
)
def test_errors_are_one_line(
    clip: Make, tmp_path: Path, save_image: Callable[..., None], name: str, words: str
) -> None:
    broken = clip("broken.avi", code="MJPG")
    broken.write_bytes(broken.read_bytes().replace(b"MJPG", b"QQQQ"))
    (tmp_path / "text.mp4").write_text("text\n" * 100)
    save_image(tmp_path / "uncalibrated/1.png", np.zeros((48, 64), np.uint8))
    # A process of its own: FFmpeg asks once how much it may say.
    done = subprocess.run(
        [sys.executable, "-m", "odomap", "info", name],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(f"odomap: {words}")
    assert done.stderr.count("\n") == 1
