"""Folders of clouds of every kind, whole and broken."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import odomap
from odomap.errors import CalibrationError, InputError
from odomap.sensors.rig import LidarMount, Rig
from odomap.sources.cloudfolder import CloudSource
from odomap.sources.source import RandomAccess, UnusableFrame
from sweepworlds import pcd_bytes, turning

Columns = dict[str, NDArray[np.generic]]
START_S = 1_700_000_000


def columns(frame: int, **more: Callable[[Columns], NDArray[np.generic]]) -> Columns:
    found = turning(frame)
    for name, make in more.items():
        found[name] = make(found)
    return found


def write(
    root: Path, kind: str = "pcd", frames: int = 4, drop: tuple[str, ...] = (),
    form: str = "binary",
    names: Callable[[int], str] = lambda k: f"{START_S + k // 10}.{k % 10}00000",
    **more: Callable[[Columns], NDArray[np.generic]],
) -> Path:  # fmt: skip
    """Write a folder of clouds whose names are seconds."""
    root.mkdir(parents=True, exist_ok=True)
    for k in range(frames):
        found = {n: c for n, c in columns(k, **more).items() if n not in drop}
        file = root / f"{names(k)}.{kind}"
        if kind == "pcd":
            file.write_bytes(pcd_bytes(found, form))
        elif kind == "ply":
            words = {"f4": "float", "u2": "ushort", "u4": "uint", "f8": "double"}
            head = "".join(f"property {words[c.dtype.str[1:]]} {n}\n" for n, c in found.items())
            rows = np.empty(len(found["x"]), [(n, c.dtype) for n, c in found.items()])
            for name, column in found.items():
                rows[name] = column
            file.write_bytes(
                f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{head}"
                "end_header\n".encode()
                + rows.tobytes()
            )
        else:
            np.save(file, np.stack([c.astype(np.float64) for c in found.values()], axis=1))
    return root


@pytest.mark.parametrize("kind", ["pcd", "ply", "npy"])
def test_whole(tmp_path: Path, kind: str) -> None:
    source = odomap.open(write(tmp_path / "clouds", kind))
    assert isinstance(source, CloudSource)
    assert isinstance(source, RandomAccess)
    assert (source.name, len(source), source.skipped) == ("clouds", 4, [])
    mount = source.rig.lidars[0]
    assert (mount.beams, mount.sweep) == (16, "none")
    assert mount.rate_hz == pytest.approx(10)
    frames = list(source)
    assert [f.stamp_ns for f in frames] == [START_S * 10**9 + k * 10**8 for k in range(4)]
    for k, frame in enumerate(frames):
        there, sweep = columns(k), frame.cloud
        assert sweep is not None
        assert sweep.times is not None
        assert sweep.intensities is not None
        assert sweep.beams is not None
        np.testing.assert_array_equal(sweep.points[:, 0], there["x"])
        np.testing.assert_allclose(sweep.times, there["t"] * 1e-9, atol=1e-9)
        np.testing.assert_array_equal(sweep.beams, there["ring"])
        np.testing.assert_array_equal(sweep.intensities, there["intensity"])
    assert "in nanoseconds, since the stamp" in source.survey.times


@pytest.mark.parametrize("form", ["ascii", "binary_compressed"])
def test_other_forms(tmp_path: Path, form: str) -> None:
    source = odomap.open(write(tmp_path, form=form, frames=2))
    np.testing.assert_array_equal(source.frame(1).cloud.beams, columns(1)["ring"])


@pytest.mark.parametrize(
    ("name", "change", "how"),
    [
        ("time", lambda c: (c["t"] * 1e-9).astype(np.float32), "in seconds, since the stamp"),
        ("timestamp", lambda c: (c["t"] // 1000).astype(np.uint32), "in microseconds"),
        ("offset_time", lambda c: (c["t"] * 1e-6).astype(np.float32), "in milliseconds"),
        ("time_stamp", lambda c: c["t"] * 1e-9 - 0.1, "in seconds, since the stamp"),
    ],
)
def test_units_and_names_of_times(
    tmp_path: Path, name: str, change: Callable[[Columns], NDArray[np.generic]], how: str
) -> None:
    source = odomap.open(write(tmp_path, drop=("t",), **{name: change}))
    assert how in source.survey.times
    assert f"'{name}'" in source.survey.times
    times = source.frame(0).cloud.times
    assert abs(np.ptp(times) - 0.1) < 1e-3


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda c: (15 - c["ring"]).astype(np.uint16), "from 'ring'"),
        (lambda c: (c["ring"] + 1).astype(np.uint16), "from 'ring'"),
        (lambda c: ((c["ring"] * 7) % 16).astype(np.uint16), "from 'ring'"),
        (lambda c: c["ring"].astype(np.float32), "from 'ring'"),
    ],
)
def test_beams_are_brought_to_the_order_of_elevation(
    tmp_path: Path, change: Callable[[Columns], NDArray[np.generic]], says: str
) -> None:
    """Drivers count from the top, from 1, or as lasers are wired."""
    source = odomap.open(write(tmp_path, ring=change))
    np.testing.assert_array_equal(source.frame(2).cloud.beams, columns(2)["ring"])
    assert source.rig.lidars[0].beams == 16
    assert source.survey.beams_how == says


def test_beams_that_nobody_says(tmp_path: Path) -> None:
    source = odomap.open(write(tmp_path / "a", drop=("ring",)))
    np.testing.assert_array_equal(source.frame(2).cloud.beams, columns(2)["ring"])
    assert source.survey.beams_how == "from the elevation of the points"
    source = odomap.open(f"{write(tmp_path / 'b', drop=('ring',))}?ring=off")
    assert source.frame(2).cloud.beams is None
    # The lines of a solid-state sensor cross, so they are not above each other.
    crossing = odomap.open(
        write(tmp_path / "c", ring=lambda c: (np.arange(len(c["x"])) % 6).astype(np.uint16))
    )
    assert crossing.frame(0).cloud.beams is None
    assert crossing.rig.lidars[0].beams == 0


@pytest.mark.parametrize("by_row", [True, False])
def test_organised_clouds(tmp_path: Path, by_row: bool) -> None:
    """Each row of an organised cloud is a beam, or each column, wherever it begins."""
    azimuth = np.radians(-(np.arange(90) * 4.0) + 77.0)
    elevation = np.radians(np.linspace(15, -15, 16))
    rng = np.random.default_rng(0)
    spread = elevation[:, None] + rng.normal(0, 0.004, (16, 90))  # no bands
    rays = np.stack(
        [np.cos(spread) * np.cos(azimuth), np.cos(spread) * np.sin(azimuth), np.sin(spread)], axis=2
    )
    rays[3, 5] = rays[9] = np.nan
    beam = np.repeat(np.arange(15, -1, -1)[:, None], 90, axis=1)
    if not by_row:
        rays, beam = rays.transpose(1, 0, 2), beam.T
    there: Columns = {
        n: np.ascontiguousarray(10 * rays[..., k].reshape(-1), np.float32)
        for k, n in enumerate(("x", "y", "z"))
    }
    head = pcd_bytes(there, "binary")
    size = "WIDTH 90\nHEIGHT 16" if by_row else "WIDTH 16\nHEIGHT 90"
    (tmp_path / "a.pcd").write_bytes(head.replace(b"WIDTH 1440\nHEIGHT 1", size.encode()))
    source = odomap.open(tmp_path)
    assert source.survey.beams_how == f"from the {'rows' if by_row else 'columns'} of the cloud"
    found = source.frame(0).cloud.beams
    kept = np.isfinite(there["x"]) & (beam.reshape(-1) != 6)
    np.testing.assert_array_equal(found[kept], beam.reshape(-1)[kept])


def test_times_in_no_unit(tmp_path: Path) -> None:
    root = write(tmp_path, t=lambda c: c["t"].astype(np.float64) * 3.2e-13)
    with pytest.raises(
        InputError, match=r"'t' go over 3.19\d*e-05 in a sweep, .* say it by \?unit=us"
    ):
        odomap.open(root)
    assert odomap.open(f"{root}?time=off").frame(0).cloud.times is None
    with pytest.raises(InputError, match="unit: 'parsec' is none of s, ms, us, ns"):
        odomap.open(f"{root}?unit=parsec")
    with pytest.raises(InputError, match=r"time: points have no 'tt' \(did you mean 't'"):
        odomap.open(f"{root}?time=tt")


def test_times_that_are_equal(tmp_path: Path) -> None:
    source = odomap.open(write(tmp_path, t=lambda c: np.zeros(len(c["x"]), np.uint32)))
    assert source.frame(0).cloud.times is None
    assert any("the same for all points" in note for note in source.notes)


def test_a_rig_that_says_how_it_turns(tmp_path: Path) -> None:
    root = write(tmp_path, drop=("t",))
    rig = Rig(lidars=(LidarMount("top", sweep="clockwise", beams=16),))
    source = odomap.open(root, rig)
    np.testing.assert_allclose(source.frame(1).cloud.times, columns(1)["t"] * 1e-9, atol=4e-4)
    assert source.rig.lidars[0].sweep == "clockwise"
    assert odomap.open(root).frame(1).cloud.times is None
    with pytest.raises(CalibrationError, match="sweeps have 16 beams, the rig says 64"):
        odomap.open(root, Rig(lidars=(LidarMount("top", beams=64),)))


def test_stamps(tmp_path: Path) -> None:
    """From a file, from nanoseconds in names, or at the usual rate."""
    for name, root in ((lambda k: f"{START_S * 10**9 + k * 10**8}", tmp_path / "ns"),
                       (lambda k: f"cloud_{k + 8}", tmp_path / "numbers")):  # fmt: skip
        source = odomap.open(write(root, names=name))
        assert np.diff(source.stamps_ns).tolist() == [10**8] * 3
    assert source.frame(2).cloud.points[0, 0] == columns(2)["x"][0]
    assert any("100 ms apart" in note for note in source.notes)
    (root / "times.txt").write_text("5.0\n5.1\n5.1\n5.05\n")
    source = odomap.open(root)
    assert source.stamps_ns.tolist() == [5 * 10**9, 5_050_000_000, 5_100_000_000]
    assert any("out of order" in note for note in source.notes)
    assert "repeated" in source.skipped[0].reason


def test_truth_and_folder_below(tmp_path: Path) -> None:
    write(tmp_path / "drive" / "pcd")
    rows = [f"{START_S + 0.1 * k:.6f} {k} 0 0 0 0 0 1\n" for k in range(4)]
    (tmp_path / "drive" / "groundtruth.txt").write_text("".join(rows))
    source = odomap.open(tmp_path / "drive")
    assert source.name == "drive"
    assert source.truth is not None
    assert source.truth.path_length == pytest.approx(3)


def test_broken_files_cost_their_frames(tmp_path: Path) -> None:
    root = write(tmp_path)
    files = sorted(root.iterdir())
    files[1].write_bytes(files[1].read_bytes()[:-100])
    files[2].write_bytes(pcd_bytes({n: c for n, c in columns(2).items() if n != "y"}, "binary"))
    source = odomap.open(root)
    assert [frame.id for frame in source] == [0, 3]
    reasons = [item.reason for item in source.skipped]
    assert "cut off" in reasons[0]
    assert "points have no 'y'" in reasons[1].replace('"', "'")
    with pytest.raises(UnusableFrame, match="cut off"):
        source.frame(1)
    for file in files:
        file.write_bytes(b"nothing\n")
    with pytest.raises(InputError, match="is no PCD file"):
        odomap.open(root)


def test_sweeps_without_points(tmp_path: Path) -> None:
    root = write(tmp_path)
    empty = {n: c[:0] for n, c in columns(0).items()}
    nans = {n: np.full_like(c, np.nan) if c.dtype.kind == "f" else c for n, c in columns(1).items()}
    files = sorted(root.iterdir())
    files[0].write_bytes(pcd_bytes(empty, "binary"))
    files[1].write_bytes(pcd_bytes(nans, "binary"))
    source = odomap.open(root)
    frames = list(source)
    assert len(frames) == 4
    assert len(frames[0].cloud) == 0
    assert np.isnan(frames[1].cloud.points).all()
    assert source.skipped == []
    for file in files:
        file.write_bytes(pcd_bytes(empty, "binary"))
    assert [len(frame.cloud) for frame in odomap.open(root)] == [0] * 4


def test_one_sweep_with_times_of_another_moment(tmp_path: Path) -> None:
    root = write(tmp_path)
    file = sorted(root.iterdir())[2]
    late = columns(2, t=lambda c: c["t"] + np.uint32(2 * 10**9))
    file.write_bytes(pcd_bytes(late, "binary"))
    source = odomap.open(root)
    assert [frame.cloud.times is None for frame in source] == [False, False, True, False]
    assert "it has no times" in source.skipped[0].reason


def test_a_cloud_alone_and_kinds_mixed(tmp_path: Path) -> None:
    root = write(tmp_path / "a")
    source = odomap.open(sorted(root.iterdir())[1])
    assert (len(source), source.rig.lidars[0].beams) == (1, 16)
    assert source.frame(0).cloud.times is not None
    write(root, "ply", frames=1)
    source = odomap.open(root)
    assert len(source) == 4
    assert "is no .pcd as most are" in source.skipped[0].reason


def test_real_columns_are_needed(tmp_path: Path) -> None:
    root = write(tmp_path, drop=("z",))
    with pytest.raises(InputError, match="points have no 'z', but x, y, intensity"):
        odomap.open(root)


def test_numbers_of_beams_that_say_none(tmp_path: Path) -> None:
    def ring(found: Columns) -> NDArray[np.generic]:
        known = found["ring"].copy()
        known[::50] = 65535
        return known

    source = odomap.open(write(tmp_path, ring=ring))
    assert source.rig.lidars[0].beams == 16
    sweep, there = source.frame(1).cloud, columns(1)["ring"]
    assert sweep is not None
    assert sweep.beams is not None
    assert (sweep.beams[::50] == -1).all()
    kept = np.arange(len(there)) % 50 > 0
    np.testing.assert_array_equal(sweep.beams[kept], there[kept])
