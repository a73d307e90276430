"""What a run decides on loops: noted when told, written, counted, and listed by `odomap loops`."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import odomap
from odomap.cli import main
from odomap.files.loops import LoopLog, LoopRecord, read_loops, write_loops
from odomap.loopbook import LoopBook
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.run import Interrupted, run
from odomap.settings import override
from odomap.system.config import preset
from odomap.system.stages import Loop, Stages
from odomap.system.visualslam import VisualSlam
from odomap.system.worker import InlineWorker
from recordings import Rendered
from stagedoubles import Solved

WORLD = "sim:room?seed=3&frames=8&rate_hz=4&resolution=400x250"
ENABLED = override(preset("stereo"), [("closing.enabled", "true")])
START = 1_700_000_000_000_000_000
REASON = "9 inliers of 30 needed between keyframes 1 and 0"


class Deciding:
    """A closer that refuses at the first keyframe that it is given, and believes at the next."""

    def __init__(self):
        self.given = []

    def last(self):
        return None

    def add(self, keyframe):
        self.given.append(keyframe.id)
        return self

    def solve(self):
        ends = self.given[-1], self.given[0]
        decided = {
            1: Loop(*ends, np.eye(4), 9, False, REASON),
            2: Loop(*ends, np.eye(4), 152, True, moved=0.83, turned=0.02),
        }
        loop = decided.get(len(self.given))
        return Solved((), () if loop is None else (loop,))


@pytest.fixture(scope="module")
def world():
    return Rendered(WORLD)


@pytest.fixture
def cli(capsys):
    def call(*words):
        code = main([str(word) for word in words])
        out, err = capsys.readouterr()
        assert "Traceback" not in out + err
        return code, out, err

    return call


@pytest.fixture
def deciding(monkeypatch):
    monkeypatch.setattr(VisualSlam, "_closer", lambda *_: Deciding())


def book_of(ids, start=0):
    m = Map()
    for k in ids:
        m.add_keyframe(Keyframe(k, start + k), np.eye(4))
    return m, LoopBook(m)


# ---- noting ----


def test_a_keyframe_that_is_culled_before_its_loop_is_told_keeps_its_time():
    m, book = book_of([0, 1], START)
    for k in (2, 3):
        keyframe = Keyframe(k, START + 10 * k)
        m.add_keyframe(keyframe, np.eye(4))
        book.note(keyframe)
    m.cull_keyframes([0, 2])
    book.add(Loop(3, 2, np.eye(4), 50, True, moved=0.5))
    book.add(Loop(3, 0, np.eye(4), 4, False, "no"))
    m.cull_keyframes([3])
    seen, before = book.records([])
    assert (seen.stamp_ns, seen.matched_stamp_ns) == (START + 30, START + 20)
    assert (before.matched_frame, before.matched_stamp_ns) == (-1, START)
    assert (book.num_closed, book.num_rejected) == (1, 1)


def test_a_keyframe_that_nobody_told_of_is_found_in_the_map():
    m, book = book_of([0])
    m.add_keyframe(Keyframe(1, 77), np.eye(4))
    book.add(Loop(1, 0, np.eye(4), 50, True))
    book.add(Loop(9, 8, np.eye(4), 50, True))
    assert [record.stamp_ns for record in book.records([])] == [77, 0]


def told(frame_id, stamp_ns):
    return SimpleNamespace(frame_id=frame_id, stamp_ns=stamp_ns)


def test_keyframes_that_were_culled_before_anybody_told_of_them_have_their_times():
    m, book = book_of([0, 1], START)
    m.add_keyframe(Keyframe(2, START + 20), np.eye(4))
    m.cull_keyframes([2])
    book.add(Loop(3, 2, np.eye(4), 4, False, "no", stamps_ns=(START + 30, START + 20)))
    (record,) = book.records([told(5, START + 20), told(7, START + 30)])
    assert (record.frame, record.matched_frame) == (7, 5)
    assert (record.stamp_ns, record.matched_stamp_ns) == (START + 30, START + 20)


def test_nobody_looks_nobody_notes():
    worker = InlineWorker(Stages(Map(), tracker=None))
    assert LoopBook.of(worker) is None
    assert not worker.on_loop


# ---- writing ----


@pytest.mark.usefixtures("no_report")
def test_where_nothing_was_a_candidate_the_list_is_empty(world, tmp_path):
    found = run(world, tmp_path, config=ENABLED)
    assert "loops.json" in found.written
    loops = read_loops(tmp_path / "loops.json")
    assert (loops.records, loops.start_ns) == ((), found.estimates[0].stamp_ns)
    m = found.metrics
    assert (m["loops"], m["loops_closed"], m["loops_rejected"]) == (0, 0, 0)


@pytest.mark.usefixtures("no_report")
def test_where_nobody_looks_there_is_no_list_and_none_of_a_run_before(world, tmp_path, cli):
    closed = override(preset("stereo"), [("closing.enabled", "false")])
    for how in ({"config": closed}, {"odometry_only": True}):
        (tmp_path / "loops.json").write_text("{}")
        found = run(world, tmp_path, max_frames=3, **how)
        assert not (tmp_path / "loops.json").exists()
        assert found.metrics["loops_closed"] is None
        assert found.metrics["loops_rejected"] is None
    code, out, err = cli("loops", tmp_path)
    assert (code, out) == (2, "")
    assert "no loops were looked for in this run" in err
    assert "--closing.enabled false" in err


@pytest.mark.usefixtures("no_report")
@pytest.mark.parametrize("rhythm", ["inline", "lockstep"])
def test_what_is_decided_is_written_with_its_frames(deciding, world, tmp_path, rhythm):
    found = run(world, tmp_path, config=ENABLED, rhythm=rhythm)
    loops = read_loops(tmp_path / "loops.json")
    stamps = {e.stamp_ns: e.frame_id for e in found.estimates}
    for record in loops.records:
        assert record.frame == stamps[record.stamp_ns]
        assert record.matched_frame == stamps[record.matched_stamp_ns]
    no, yes = loops.records
    assert (no.reason, yes.moved) == (REASON, 0.83)
    assert yes.stamp_ns > no.stamp_ns == yes.matched_stamp_ns
    m = found.metrics
    assert (m["loops"], m["loops_closed"], m["loops_rejected"]) == (0, 1, 1)


@pytest.mark.usefixtures("no_report")
def test_an_interrupted_run_has_its_list(deciding, world, tmp_path):
    import signal

    class Stopping:
        name, rig, truth, skipped = world.name, world.rig, world.truth, ()

        def __len__(self):
            return len(world)

        def __iter__(self):
            for n, frame in enumerate(world):
                if n == 5:
                    signal.raise_signal(signal.SIGINT)
                yield frame

    with pytest.raises(Interrupted):
        run(Stopping(), tmp_path, config=ENABLED)
    assert len(read_loops(tmp_path / "loops.json").records) >= 1


def test_the_conclusion_says_it_where_there_is_something_to_say(deciding, tmp_path, cli):
    words = ("run", WORLD, "--quiet", "--closing.enabled", "true", "--max-frames", "6")
    code, out, _ = cli(*words, "--out", tmp_path / "a")
    assert code == 0
    (line,) = [line for line in out.splitlines() if line.startswith("loops")]
    assert "1 candidate rejected" in line
    assert "loops.json" in out
    metrics = json.loads((tmp_path / "a" / "metrics.json").read_text())
    assert metrics["loops_rejected"] == 1


# ---- listing ----


def record(**changes):
    usual = LoopRecord(
        keyframe_id=120,
        matched_id=3,
        frame=402,
        matched_frame=3,
        stamp_ns=START + 40_200_000_000,
        matched_stamp_ns=START + 300_000_000,
        num_inliers=152,
        is_accepted=True,
        reason="",
        merges=False,
        moved=0.8312,
        turned=np.radians(1.23),
        rescaled=1.0,
        T_matched_keyframe=np.eye(4),
    )
    return replace(usual, **changes)


def refused(**changes):
    no = {"is_accepted": False, "reason": REASON, "num_inliers": 9, "moved": 0.0, "turned": 0.0}
    return record(**(no | changes))


def listed(tmp_path, cli, *records, is_metric=True):
    write_loops(tmp_path / "loops.json", LoopLog("street", is_metric, START, records))
    code, out, err = cli("loops", tmp_path)
    assert (code, err) == (0, "")
    return out.splitlines()


def test_the_table_says_when_where_how_far_and_why_not(tmp_path, cli):
    head, names, yes, no = listed(tmp_path, cli, refused(), record())
    assert head == "street: 1 closed, 1 candidate rejected"
    assert " ".join(names.split()) == "back at seen before at inliers path moved"
    assert " ".join(no.split()) == f"rejected 40.20 s, frame 402 0.30 s, frame 3 9 - {REASON}"
    assert " ".join(yes.split()) == "closed 40.20 s, frame 402 0.30 s, frame 3 152 0.831 m, 1.2°"
    assert no.index("0.30 s") == yes.index("0.30 s") == names.index("seen before at")


def test_a_single_camera_s_table_has_no_metres_but_a_scale(tmp_path, cli):
    *_, line = listed(tmp_path, cli, record(rescaled=0.97), is_metric=False)
    assert line.endswith("0.831 units, 1.2°, scale -3.0 %")


def test_a_keyframe_of_the_map_before_has_no_frame(tmp_path, cli):
    *_, line = listed(tmp_path, cli, record(matched_frame=-1))
    assert "keyframe 3 of the map before" in line


def test_a_loop_that_a_later_one_contradicts_is_told(tmp_path, cli):
    old, new = record(), record(keyframe_id=300, frame=900, stamp_ns=START + 90_000_000_000)
    lines = listed(tmp_path, cli, old, replace(new, doubts=((120, 3), (8, 1))))
    assert lines[2].endswith("not believed any more: contradicts that at 90.00 s (frame 900)")
    assert lines[3].endswith(
        "contradicts the one at 40.20 s (frame 402); contradicts that of keyframes 8 and 1 of the "
        "map before"
    )
    many = replace(new, doubts=tuple((k, 1) for k in range(5)))
    *_, line = listed(tmp_path, cli, many)
    assert "keyframes 0 and 1, 1 and 1, 2 and 1 and 2 more of the map before" in line


def test_nothing_found_is_a_sentence(tmp_path, cli):
    assert listed(tmp_path, cli) == [
        "street: no place looked like one seen before, but for those known at once"
    ]


def test_json_is_what_the_file_says(tmp_path, cli):
    listed(tmp_path, cli, refused(), record())
    code, out, _ = cli("loops", tmp_path, "--json")
    assert code == 0
    assert json.loads(out) == json.loads((tmp_path / "loops.json").read_text())
    assert cli("loops", tmp_path / "loops.json", "--json")[1] == out


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda folder: None, "is no run: neither loops.json nor metrics.json is there"),
        (lambda folder: (folder / "loops.json").write_text('{"odomap_lo'), "cut short"),
        (lambda folder: (folder / "loops.json").write_text('{"odomap_loops": 9}'), "of version 9"),
        (lambda folder: (folder / "loops.json").mkdir(), "loops.json: Is a directory"),
    ],
)
def test_what_is_no_run_is_one_line(tmp_path, cli, make, says):
    make(tmp_path)
    code, out, err = cli("loops", tmp_path)
    assert (code, out) == (2, "")
    assert says in err
    assert err.count("\n") == 1


def test_no_such_folder_and_a_file_are_told_apart(tmp_path, cli):
    assert "no such folder: give the output folder" in cli("loops", tmp_path / "none")[2]
    (tmp_path / "map.odomap").write_bytes(b"x")
    assert "is a file: give the output folder" in cli("loops", tmp_path / "map.odomap")[2]
    assert "RUN is missing" in cli("loops")[2]


@pytest.mark.usefixtures("no_report")
def test_the_face_runs_it_too(deciding, world, tmp_path):
    assert odomap.run(world, tmp_path, config=ENABLED).metrics["loops_rejected"] == 1


def test_of_many_refused_the_nearest_are_listed(tmp_path, cli):
    many = [refused(keyframe_id=k, num_inliers=(7 * k) % 30) for k in range(30)]
    lines = listed(tmp_path, cli, *many[:15], record(), *many[15:])
    assert lines[2].split()[0] == "closed"
    shown = [int(line.split()[9]) for line in lines[3:-1]]
    assert sorted(shown) == list(range(20, 30))
    assert shown != sorted(shown)  # in the order of time
    assert lines[-1].strip() == "... and 20 with fewer inliers: --all lists them"
    everything = cli("loops", tmp_path, "--all")[1].splitlines()
    assert len(everything) == 2 + 31
    assert everything[2 + 15].split()[0] == "closed"
