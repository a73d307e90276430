"""`odomap optimize` as a person uses it: what it prints and writes, its exit codes, bad input."""

import os
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from odomap.backend.graphs.posegraph import PoseGraph, Priors
from odomap.cli import main
from odomap.cli.progress import Steps
from odomap.errors import InputError
from odomap.files.g2o import read_g2o, write_g2o
from odomap.files.graphs import read_graph
from odomap.geometry.lie import se2_exp, se2_inverse, se3_exp, se3_inverse
from odomap.geometry.robust import Loss
from odomap.optimize import optimize

NOISE = 0.01


@pytest.fixture(autouse=True)
def _quiet_environment(monkeypatch, tmp_path):
    monkeypatch.delenv("ODOMAP_DEBUG", raising=False)
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def cli(capsys):
    """Run the command line; return exit code, stdout and stderr."""

    def call(*words: object) -> tuple[int, str, str]:
        # Without progress: how long kernels take to compile must not change what is printed.
        code = main([*(str(word) for word in words), "--quiet"])
        out, err = capsys.readouterr()
        assert "Traceback" not in out + err
        assert "internal error" not in err
        return code, out, err

    return call


def circle(group: str = "SE2", nodes: int = 40, is_known: bool = True, seed: int = 0) -> PoseGraph:
    """Return a ring driven twice, odometry and loops, at the poses of its odometry."""
    rng = np.random.default_rng(seed)
    exp, inverse, k = (se2_exp, se2_inverse, 3) if group == "SE2" else (se3_exp, se3_inverse, 6)
    turn = np.zeros(k)
    turn[0], turn[-1] = 1.0, 4.0 * np.pi / nodes
    Ts = [np.eye(4 if k == 6 else 3)]
    for _ in range(nodes - 1):
        Ts.append(Ts[-1] @ exp(turn))
    truth = np.array(Ts)
    half = nodes // 2
    first = np.concatenate([np.arange(nodes - 1), np.arange(half)])
    second = np.concatenate([np.arange(1, nodes), np.arange(half) + half])
    clean = inverse(truth[first]) @ truth[second]
    Zs = clean @ exp(NOISE * rng.normal(size=(len(first), k)))
    drifted = [truth[0]]
    for Z in Zs[: nodes - 1]:
        drifted.append(drifted[-1] @ Z)
    poses = np.array(drifted) if is_known else np.full_like(truth, np.nan)
    information = np.tile(np.eye(k) / NOISE**2, (len(first), 1, 1))
    return PoseGraph(group, poses, first, second, Zs, information)


def two_parts() -> PoseGraph:
    one = circle()
    n = one.num_nodes
    join = lambda a: np.concatenate([a, a])  # noqa: E731
    return PoseGraph(
        "SE2",
        join(one.Ts_world_node),
        np.concatenate([one.first, one.first + n]),
        np.concatenate([one.second, one.second + n]),
        join(one.Ts_first_second),
        join(one.information),
    )


def lines_of(out: str) -> dict[str, str]:
    return {line[:16].strip(): line[16:].strip() for line in out.splitlines()}


# ---- what it does ----


@pytest.mark.parametrize("group", ["SE2", "SE3"])
@pytest.mark.parametrize("is_known", [True, False])
def test_a_graph_is_solved_and_written(cli, tmp_path, group, is_known):
    write_g2o("ring.g2o", circle(group, is_known=is_known))
    code, out, err = cli("optimize", "ring.g2o", "--out", "sub/best.g2o.gz")
    assert (code, err) == (0, "")
    found = lines_of(out)
    assert found["graph"] == f"{group}, 40 poses, 59 edges"
    assert found["loops"] == "20 edges"
    assert found["components"] == "1"
    assert found["iterations"].endswith(": converged")
    best = read_g2o("sub/best.g2o.gz")
    before = read_g2o("ring.g2o")
    np.testing.assert_array_equal(best.Ts_first_second, before.Ts_first_second)
    np.testing.assert_array_equal(best.information, before.information)
    # the second lap lies on the first, within the noise
    gap = np.linalg.norm(best.positions[:20] - best.positions[20:], axis=1)
    assert gap.max() < 5 * NOISE
    picture = tmp_path / "sub" / "best.png"
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert str(Path("sub/best.png")) in out


def test_the_cost_that_is_printed_is_that_of_the_file(cli):
    write_g2o("ring.g2o", circle())
    result = optimize("ring.g2o", "best.g2o")
    again = optimize("best.g2o", max_iterations=0, initial="given")
    assert again.solution.cost_before == pytest.approx(result.solution.cost_after, rel=1e-9)
    _, out, _ = cli("optimize", "ring.g2o")
    assert f"→ {result.solution.cost_after:.8g}  (geodesic)" in out


def test_a_proof(cli):
    write_g2o("ring.g2o", circle("SE3"))
    code, out, _ = cli("optimize", "ring.g2o", "--certify")
    assert code == 0
    assert "(chordal)" in lines_of(out)["cost"]
    assert lines_of(out)["certificate"].startswith("globally optimal  (λ_min ")
    code, out, _ = cli(
        "optimize", "ring.g2o", "--certify", "--initial", "given", "--max-iterations", 0
    )
    assert code == 1
    assert "globally optimal" not in out


def test_the_same_input_gives_the_same_bytes(cli, tmp_path):
    write_g2o("ring.g2o", circle("SE3"))
    for name in ("a", "b"):
        assert cli("optimize", "ring.g2o", "--out", f"{name}.g2o")[0] == 0
    assert (tmp_path / "a.g2o").read_bytes() == (tmp_path / "b.g2o").read_bytes()
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_each_part_of_a_graph_is_solved(cli):
    write_g2o("two.g2o", two_parts())
    code, out, _ = cli("optimize", "two.g2o", "--out", "best.toro", "--no-picture")
    assert code == 0
    assert lines_of(out)["components"].startswith(
        "2 (of 40, 40 poses): solved one by one, not placed"
    )
    best = read_graph("best.toro").positions
    np.testing.assert_allclose(best[:40], best[40:], atol=1e-6)
    assert not Path("best.png").exists()


def test_parts_that_priors_place_are_placed(cli):
    graph = two_parts()
    nodes = np.array([0, graph.num_nodes // 2])
    information = np.tile(np.eye(graph.dim), (2, 1, 1))
    write_g2o("two.g2o", graph.with_priors(Priors(nodes, graph.Ts_world_node[nodes], information)))
    _, out, _ = cli("optimize", "two.g2o")
    assert lines_of(out)["components"].endswith("each placed in the world")


def test_a_picture_alone(cli):
    write_g2o("ring.g2o", circle(is_known=False))
    code, _, _ = cli("optimize", "ring.g2o", "--plot", "look.png")
    assert code == 0
    assert [path.name for path in Path().iterdir() if path.suffix == ".png"] == ["look.png"]


def test_a_loss_makes_light_of_a_false_loop(cli):
    graph = circle()
    Zs = graph.Ts_first_second.copy()
    Zs[-1] = se2_exp([8.0, 3.0, 1.0])
    write_g2o("ring.g2o", replace(graph, Ts_first_second=Zs))
    clean = optimize(graph).solution.graph.positions

    def off(*words: str) -> float:
        assert cli("optimize", "ring.g2o", "--out", "best.g2o", "--no-picture", *words)[0] == 0
        return float(np.abs(read_g2o("best.g2o").positions - clean).max())

    assert off() > 0.5
    assert off("--loss", "cauchy", "--width", "1") < 0.1


def test_false_loops_are_named_and_left_out(cli):
    graph = circle(nodes=120)
    false = np.arange(graph.num_edges - 3, graph.num_edges)
    Zs = graph.Ts_first_second.copy()
    Zs[false] = se2_exp(np.random.default_rng(5).normal(size=(3, 3)) * [8.0, 8.0, 2.0])
    write_g2o("ring.g2o", replace(graph, Ts_first_second=Zs))
    code, out, _ = cli("optimize", "ring.g2o", "--robust", "gnc", "--certify", "--out", "best.g2o")
    assert code == 0
    count, named = lines_of(out)["rejected"].split(" of 60 loops: ")
    assert {"57-117", "58-118", "59-119"} <= set(named.split(", "))
    assert int(count) <= 5  # one true edge in a hundred is an outlier by chance
    assert lines_of(out)["certificate"].startswith("globally optimal")
    best = read_g2o("best.g2o")
    assert best.num_edges == graph.num_edges
    clean = optimize(graph).solution.graph.positions
    assert np.abs(best.positions - clean).max() < 10 * NOISE


def test_ctrl_c_keeps_the_best_so_far(cli, monkeypatch):
    write_g2o("ring.g2o", circle())
    show = Steps.show

    def interrupting(self: Steps, done: int, total: int, text: str) -> None:
        show(self, done, total, text)
        if done == 1 and text.startswith("cost"):
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Steps, "show", interrupting)
    code, out, err = cli("optimize", "ring.g2o", "--out", "best.g2o", "--initial", "spanning_tree")
    assert code == 130
    assert err == "odomap: interrupted: these are the best poses so far\n"
    assert lines_of(out)["iterations"] == "1: stopped on request"
    assert np.isfinite(read_g2o("best.g2o").Ts_world_node).all()


def test_one_that_does_not_converge_is_written_all_the_same(cli):
    write_g2o("ring.g2o", circle())
    words = ["--initial", "given", "--max-iterations", "1", "--out", "best.g2o"]
    code, _, err = cli("optimize", "ring.g2o", *words)
    assert code == 1
    assert err == "odomap: not converged: 1 iterations were spent\n"
    assert Path("best.g2o").exists()


def test_lines_passed_over_are_told(cli):
    write_g2o("ring.g2o", circle())
    with open("ring.g2o", "a") as file:
        file.write("EDGE_SWITCHABLE 1 2\nEDGE_SWITCHABLE 2 3\n")
    code, _, err = cli("optimize", "ring.g2o", "--skip-unknown")
    assert code == 0
    assert err == "odomap: warning: 2 lines of EDGE_SWITCHABLE passed over\n"


# ---- what it refuses ----


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["none.g2o"], "none.g2o: No such file"),
        (["bad.g2o"], "bad.g2o:2: EDGE_SE2: 'x' is not a number"),
        (["ring.g2o", "--width", "2"], "--width says where a loss sets in: give --loss, too"),
        (["ring.g2o", "--loss", "huber", "--width", "0"], "--width is 0: a positive number"),
        (["ring.g2o", "--certify", "--cost", "geodesic"], "the proof is of the chordal cost"),
        (["ring.g2o", "--certify", "--loss", "huber"], "no proof with a robust loss"),
        (["ring.g2o", "--out", "ring.g2o"], "ring.g2o: is the input itself"),
        (["ring.g2o", "--out", "a.png"], "a.png: two results would go into this file"),
        (["ring.g2o", "--out", "folder"], "folder: cannot be written: a folder of that name"),
        (["ring.g2o", "--out", "a.g2o", "--plot", "folder.png"], "folder.png: cannot be written: "),
        (["ring.g2o", "--out", "pipe"], "pipe: cannot be written: it is a device, a pipe"),
        (["far.g2o", "--robust", "gnc"], "far.g2o: edge 58 (19-39) is 1e+200 m long: remove it"),
        (["ring.g2o", "--plot", "a.pdf"], "--plot a.pdf: only PNG is drawn"),
        (["ring.g2o", "--max-iterations", "-1"], "iterations"),
        (["edges.g2o", "--initial", "given"], "edges.g2o: solve: initial 'given' asks for poses"),
        (["held.g2o", "--out", "a.toro"], "a.toro: TORO files have no nodes that are held"),
        (["held.g2o", "--certify"], "held.g2o: certificate: "),
        (["ring.g2o", "--metod", "dogleg"], "(did you mean '--method'?)"),
    ],
)
def test_bad_input_is_one_line(cli, words, message):
    ring = circle()
    write_g2o("ring.g2o", ring)
    write_g2o("edges.g2o", circle(is_known=False))
    held = np.isin(ring.ids, [0, 9])
    write_g2o("held.g2o", replace(ring, is_fixed=held))
    Zs = ring.Ts_first_second.copy()
    Zs[-1, 0, 2] = 1e200  # squares of squares of it are no numbers
    write_g2o("far.g2o", replace(ring, Ts_first_second=Zs))
    os.mkfifo("pipe")
    Path("folder").mkdir()
    Path("folder.png").mkdir()
    Path("bad.g2o").write_text("VERTEX_SE2 0 0 0 0\nEDGE_SE2 0 1 x 0 0 1 0 0 1 0 1\n")
    code, out, err = cli("optimize", *words)
    assert (code, out) == (2, "")
    assert len(err.splitlines()) == 1
    assert message in err
    assert [path.name for path in Path().glob("*.png")] == ["folder.png"]
    assert not Path("a.g2o").exists()


def test_priors_alone(cli):
    ring = circle("SE3")
    rest = ring.without(np.ones(ring.num_edges, bool))
    tied = replace(rest, priors=Priors(np.arange(40), ring.Ts_world_node, ring.information[:40]))
    for poses in (ring.Ts_world_node, np.full_like(ring.Ts_world_node, np.nan)):
        write_g2o("tied.g2o", replace(tied, Ts_world_node=poses))
        assert read_g2o("tied.g2o").num_edges == 0
        assert cli("optimize", "tied.g2o", "--out", "best.g2o")[0] == 0
        np.testing.assert_allclose(read_g2o("best.g2o").positions, ring.positions, atol=1e-9)


def test_from_python(tmp_path):
    graph = circle()
    result = optimize(graph, tmp_path / "best.g2o", loss=Loss("huber"), cost="geodesic")
    assert result.solution.converged
    assert result.sizes == (40,)
    assert result.written == (tmp_path / "best.g2o",)
    with pytest.raises(InputError, match="nothing to solve"):
        optimize(graph.without(np.ones(graph.num_edges, bool)))
