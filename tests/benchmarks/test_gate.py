"""Ours beside the peer's: which ratios pass, and what is said when something is missing."""

import argparse
import json
import sys

import numpy as np
import pytest

NUMBERS = {"ate_m": 0.004, "ms_median": 10.0, "ms_p95": 30.0, "cpu_s": 2.0, "peak_memory_mb": 200.0}
COUNTS = {"ms_mean": 20.0, "frames": 110, "tracked": 110, "threads": 3, "cv_threads": 2}
RUN = NUMBERS | COUNTS | {"lost": 0, "digest": 1.0}


def baseline_of(gate, **changes):
    return {"tolerance": gate.TOLERANCE, "ratios": {"a": {"ms_median": 0.4, **changes}}}


@pytest.mark.parametrize(
    ("ratio", "is_open"), [(0.4, True), (0.1, True), (0.479, True), (0.481, False), (2.0, False)]
)
def test_gate_opens_up_to_the_tolerance_above_the_baseline(load, ratio, is_open):
    gate = load("gate")
    worse = gate.regressions({"a": {"ms_median": ratio}}, baseline_of(gate))
    assert (not worse) == is_open
    assert is_open or ("a: ms_median" in worse[0] and f"{ratio:.3f}" in worse[0])


@pytest.mark.parametrize(
    "now",
    [{"a": {"ms_median": float("nan")}}, {"b": {"ms_median": 0.1}}, {"a": {"cpu_s": 0.1}}],
    ids=["not a number", "unknown recording", "unknown quantity"],
)
def test_gate_stays_closed_on_what_cannot_be_compared(load, now):
    gate = load("gate")
    assert len(gate.regressions(now, baseline_of(gate))) == 1


def test_gate_stays_closed_without_a_baseline(load, tmp_path):
    gate = load("gate")
    assert gate.regressions({"a": {"cpu_s": 0.1}}, gate.read(tmp_path / "absent.json"))


def test_ratio_is_ours_over_the_peers(load):
    gate = load("gate")
    twice = {name: 2.0 * value for name, value in NUMBERS.items()}
    assert gate.ratios(NUMBERS | COUNTS, twice | COUNTS) == dict.fromkeys(NUMBERS, 0.5)
    assert gate.ratios({"cpu_s": 1.0}, {"cpu_s": 0.0}) == {"cpu_s": float("inf")}


def test_new_baseline_keeps_tolerances_and_other_recordings(load, tmp_path):
    gate, path = load("gate"), tmp_path / "baseline.json"
    path.write_text(json.dumps({"tolerance": {"cpu_s": 0.7}, "ratios": {"a": {"cpu_s": 1.0}}}))
    gate.write(path, {"b": {"cpu_s": 0.33333333}}, {"machine": "this one"})
    assert gate.read(path) == {
        "machine": "this one",
        "tolerance": {"cpu_s": 0.7},
        "ratios": {"a": {"cpu_s": 1.0}, "b": {"cpu_s": 0.3333}},
    }


def test_new_baseline_keeps_what_another_benchmark_wrote(load, tmp_path):
    gate, path = load("gate"), tmp_path / "baseline.json"
    options = argparse.Namespace(update_baseline=True, gate=True)
    gate.write(path, {"a": {"cpu_s": 1.0}}, {"machine": "this one"})
    assert gate.verdict(options, "graphs", {"graphs/x": {"seconds": 0.5}}, [], path) == 0
    content = gate.read(path)
    assert content["machine"] == "this one"
    assert set(content["graphs"]) == {"date", "machine"}
    assert content["ratios"] == {"a": {"cpu_s": 1.0}, "graphs/x": {"seconds": 0.5}}


def test_quantity_that_an_older_baseline_has_no_tolerance_for_has_the_usual(load):
    gate = load("gate")
    older = {"tolerance": {"cpu_s": 0.2}, "ratios": {"x": {"seconds": 1.0}}}
    assert not gate.regressions({"x": {"seconds": 1.2}}, older)
    assert gate.regressions({"x": {"seconds": 1.4}}, older)


def test_missed_bar_is_an_exit_code_with_and_without_the_gate(load, tmp_path, capsys):
    gate, path = load("gate"), tmp_path / "absent.json"
    plain = argparse.Namespace(update_baseline=False, gate=False)
    assert gate.verdict(plain, "graphs", {"x": {"seconds": 0.5}}, [], path) == 0
    assert gate.verdict(plain, "graphs", {}, ["x: too slow"], path) == 1
    assert "bar missed: x: too slow" in capsys.readouterr().out
    assert (
        gate.verdict(argparse.Namespace(update_baseline=False, gate=True), "g", {}, [], path) == 0
    )


def test_committed_baseline_covers_all_recordings(load):
    gate, sequences = load("gate"), load("sequences")
    baseline = gate.read(sequences.BASELINE)
    assert set(baseline["tolerance"]) == set(gate.TOLERANCE)
    recorded = {n: v for n, v in baseline["ratios"].items() if v.keys() & {"ms_median"}}
    known = {*sequences.RECORDINGS, *(f"odometry/{name}" for name in sequences.RECORDINGS)}
    odometry = {name for name in known if "/" in name}
    assert odometry <= set(recorded) <= known
    assert set(recorded) in (odometry, known)
    assert all(set(values) == set(NUMBERS) for values in recorded.values())
    for values in baseline["ratios"].values():
        assert set(values) <= set(gate.TOLERANCE)
        assert all(np.isfinite(value) and value > 0 for value in values.values())


@pytest.fixture
def sequences(load, monkeypatch, tmp_path):
    """Return the module with runs that are made up, and a baseline of its own."""
    module = load("sequences")
    monkeypatch.setattr(module, "BASELINE", tmp_path / "baseline.json")
    for recording in module.RECORDINGS.values():
        (tmp_path / recording.folder).mkdir(exist_ok=True)
        (tmp_path / recording.folder / recording.truth).touch()
    (tmp_path / "vocabulary.txt").touch()
    ours, peer = dict(RUN), RUN | {name: 2.0 * v for name, v in NUMBERS.items()}
    monkeypatch.setattr(module, "compare", lambda *_: {"ours": [dict(ours)], "peer": [dict(peer)]})
    made_up = {
        "--data": tmp_path,
        "--peer-python": sys.executable,
        "--peer-script": __file__,
        "--vocabulary": tmp_path / "vocabulary.txt",
        "--recordings": "euroc_mh01",
    }
    given = [str(part) for pair in made_up.items() for part in pair]

    def run(*arguments, **changes):
        ours.update(changes)
        monkeypatch.setattr(sys, "argv", ["sequences.py", *given, *arguments])
        return module.main()

    return run


def test_gate_of_sequences(sequences, capsys):
    assert sequences("--gate") == 1
    assert "not in the baseline" in capsys.readouterr().out
    assert sequences("--update-baseline") == 0
    assert sequences("--gate") == 0
    assert sequences("--gate", cpu_s=2.3) == 0
    assert sequences("--gate", cpu_s=2.5) == 1
    assert "regression: euroc_mh01: cpu_s" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"ate_m": 0.0081}, "euroc_mh01: ATE 0.0081 m, at most 0.0080 m"),
        ({"lost": 1}, "euroc_mh01: 1 frames lost, where the peer loses none"),
        ({"tracked": 109}, "euroc_mh01: 109 frames have a pose, 110 needed"),
        ({"ms_mean": 40.0}, "euroc_mh01: 25 frames per second, 30 needed"),
        ({"ms_p95": 43.0}, "p95: 0.72 of the peer's"),
    ],
)
def test_missed_bars_close_the_gate_whatever_the_baseline(sequences, capsys, changes, said):
    sequences("--update-baseline", **changes)
    assert sequences("--gate") == 1
    assert f"bar missed: {said}" in capsys.readouterr().out.replace("ms per frame, ", "").replace(
        "euroc_mh01: p95", "p95"
    )


def test_baseline_is_of_default_settings(sequences, capsys):
    with pytest.raises(SystemExit) as end:
        sequences("--update-baseline", "--cv-threads", "1")
    assert end.value.code == 2
    assert "default settings" in capsys.readouterr().err


def test_odometry_has_bars_and_a_baseline_of_its_own(sequences, tmp_path, capsys):
    assert sequences("--odometry-only", "--update-baseline", ate_m=0.0054) == 0
    assert set(json.loads((tmp_path / "baseline.json").read_text())["ratios"]) == {
        "odometry/euroc_mh01"
    }
    assert sequences("--odometry-only", "--gate") == 0
    assert sequences("--gate") == 1  # that of SLAM is not there
    assert sequences("--odometry-only", "--gate", ate_m=0.0056) == 1
    assert "ATE 0.0056 m, at most 0.0055 m" in capsys.readouterr().out


def test_runs_that_differ_are_told_though_each_is_good(load):
    sequences = load("sequences")
    peer = RUN | {name: 2.0 * value for name, value in NUMBERS.items()}
    recording, ratio = sequences.RECORDINGS["euroc_mh01"], dict.fromkeys(NUMBERS, 0.5)
    runs = {"ours": [RUN, dict(RUN)], "peer": [peer]}
    assert sequences.slam_bars(recording, runs, ratio) == []
    runs["ours"][1]["digest"] = 2.0
    (said,) = sequences.slam_bars(recording, runs, ratio)
    assert "trajectories differ from run to run" in said


def test_only_recordings_of_the_issue_are_held_against_the_peer(load):
    sequences = load("sequences")
    beaten = {r.name for r in sequences.RECORDINGS.values() if r.beats_peer}
    assert beaten == {"euroc_mh01", "kitti_stereo", "kitti_mono", "rgbd_desk"}
    worse = dict.fromkeys(NUMBERS, 1.5)
    runs = {"ours": [RUN], "peer": [RUN | {"ate_m": 0.001}]}
    assert len(sequences.slam_bars(sequences.RECORDINGS["euroc_mh01"], runs, worse)) == 3
    assert sequences.slam_bars(sequences.RECORDINGS["euroc_mono"], runs, worse) == []


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("peer_python", None, "--peer-python is needed (or set ODOMAP_PEER_PYTHON)"),
        ("peer_script", "/absent/x.py", "--peer-script: there is no /absent/x.py"),
        ("data", "/absent", "--data: there is no /absent"),
        ("vocabulary", "/absent/v.txt", "--vocabulary: there is no /absent/v.txt"),
    ],
)
def test_what_is_missing_is_said_in_one_line(load, capsys, field, value, said):
    peer = load("peer")
    options = argparse.Namespace(
        data=__file__, peer_python=sys.executable, peer_script=__file__, vocabulary=__file__
    )
    setattr(options, field, value)
    with pytest.raises(SystemExit) as end:
        peer.require(argparse.ArgumentParser(prog="it"), options)
    assert end.value.code == 2
    message = capsys.readouterr().err
    assert message.startswith(f"it: {said}")
    assert message.count("\n") == 1
