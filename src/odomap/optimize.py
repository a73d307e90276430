"""One call from a pose graph's file to its best poses: file → solver → file, proof, picture.

    result = odomap.optimize.optimize("intel.g2o", "best.g2o", certify=True)
    result.solution.cost_after, result.certificate.certified, result.written

What cannot work (a file that could not hold the result, a proof that does not exist for such a
graph) is said before anything is solved. Ctrl-C ends the descent at once and keeps the best poses
so far. A graph in several parts is solved part by part, and says so: nothing places one part
relative to another.
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from odomap.backend.graphs.posegraph import PoseGraph
from odomap.errors import InputError
from odomap.files.atomic import write_bytes
from odomap.files.graphs import GraphFile, check_graph_file, read_graph_file, write_graph
from odomap.solving import Tell, check_out, compile_imported

if TYPE_CHECKING:
    from odomap.backend.descent import IterationRecord
    from odomap.backend.graphs.certificate import Certificate
    from odomap.backend.graphs.solve import Cost, Initial, Solution
    from odomap.geometry.robust import Loss

__all__ = ["OptimizeResult", "optimize", "picture_beside"]


FARTHEST = 1e70
"""Metres; squares of squares of what is measured must be numbers, too."""


@dataclass(frozen=True)
class OptimizeResult:
    """What an optimisation found.

    Attributes:
        solution: poses, costs, and why the solver stopped.
        cost: the cost that was minimised.
        certificate: whether the poses are proven to be the best; None if not asked for.
        sizes: nodes of each connected component, the largest first.
        num_loose: how many of them neither a prior nor a fixed node places in the world.
        skipped: lines of the file that were passed over, by tag.
        seconds: to solve, start included; reading, compiling, proof and pictures are not.
        is_interrupted: whether Ctrl-C ended it.
        written: the graph and the picture, if asked for.
    """

    solution: "Solution"
    cost: "Cost"
    certificate: "Certificate | None"
    sizes: tuple[int, ...]
    num_loose: int
    skipped: Mapping[str, int]
    seconds: float
    is_interrupted: bool
    written: tuple[Path, ...]


def optimize(
    graph: str | Path | PoseGraph,
    out: str | Path | None = None,
    *,
    cost: "Cost | None" = None,
    method: Literal["gauss_newton", "levenberg_marquardt", "dogleg"] = "dogleg",
    initial: "Initial" = "auto",
    loss: "Loss | None" = None,
    robust: Literal["gnc"] | None = None,
    certify: bool = False,
    max_iterations: int = 100,
    skip_unknown: bool = False,
    picture: str | Path | None = None,
    progress: Tell | None = None,
) -> OptimizeResult:
    """Find the best poses of a graph, and write them.

    Args:
        graph: a g2o or TORO file, plain or gzip; or a graph.
        out: where to write it at the poses found: TORO for .toro and .graph, else g2o.
        cost: geodesic or chordal; default geodesic, or chordal where a proof is asked for.
        method: of the descent.
        initial: where to begin: auto, given, spanning_tree or chordal.
        loss: robust loss of loop edges.
        robust: "gnc" finds false loop edges and leaves them out.
        certify: whether to prove that no poses are better, by the chordal cost.
        max_iterations: most steps.
        skip_unknown: whether lines of unknown tags are passed over.
        picture: PNG file for a picture of before and after; none is drawn without an edge.
        progress: called with (done, total, text).

    Raises:
        InputError: the file, or what is asked of it, cannot be.
        OutputError: the results cannot be written.

    Example:
        >>> result = optimize("intel.g2o", certify=True)  # doctest: +SKIP
        >>> result.certificate.reason  # doctest: +SKIP
        'globally optimal'
    """
    from odomap.backend.descent import SolverConfig
    from odomap.backend.graphs.certificate import certify as prove
    from odomap.backend.graphs.certificate import check_certifiable
    from odomap.backend.graphs.graphproblem import import_group
    from odomap.backend.graphs.solve import solve
    from odomap.system.worker import deferred_interrupt

    tell = progress or (lambda *_: None)
    cost = _checked_cost(cost, loss, certify)
    config = SolverConfig(method=method, iterations=max_iterations)
    file = _opened(graph, skip_unknown)
    check_out(graph, out, picture)
    if out is not None:
        check_graph_file(out, file.graph)
    import_group(file.graph.group, len(file.graph.points.node) > 0)
    compile_imported(tell)
    with deferred_interrupt() as interrupt:
        try:
            if certify:
                check_certifiable(file.graph)
            if robust is not None:
                _check_lengths(file.graph)
            start = time.perf_counter()
            solution = solve(
                file.graph,
                cost=cost,
                initial=initial,
                loss=loss,
                robust=robust,
                config=config,
                stop=interrupt,
                progress=lambda record: tell(record.iteration, 0, _step(record)),
            )
        except InputError as error:
            where = f"{graph}: " if isinstance(graph, str | Path) else ""
            raise InputError(f"{where}{str(error).removeprefix('pose graph: ')}") from error
        seconds = time.perf_counter() - start
        written = _write(file.graph, solution, out, picture)
        is_interrupted = interrupt.is_set()
    kept = solution.graph.without(solution.is_rejected)
    certificate = prove(kept) if certify and not is_interrupted else None
    parts = _parts(kept)
    return OptimizeResult(
        solution, cost, certificate, *parts, file.skipped, seconds, is_interrupted, written
    )


def picture_beside(out: Path) -> Path:
    """Return where the picture of a result goes: intel.png beside intel.g2o.gz."""
    stem = out.with_suffix("") if out.suffix == ".gz" else out
    return stem.with_suffix(".png")


def _step(record: "IterationRecord") -> str:
    return f"cost {record.cost:.6g}  step {record.step:.1e}"


def _checked_cost(cost: "Cost | None", loss: "Loss | None", certify: bool) -> "Cost":
    """Return the cost to minimise, before anything is read."""
    if not certify:
        return cost or "geodesic"
    if cost == "geodesic":
        raise InputError("the proof is of the chordal cost: leave out the geodesic one")
    if loss is not None and loss.name != "quadratic":
        raise InputError(f"there is no proof with a robust loss: leave out '{loss.name}'")
    return "chordal"


def _opened(graph: str | Path | PoseGraph, skip_unknown: bool) -> GraphFile:
    if isinstance(graph, PoseGraph):
        return GraphFile(graph, "g2o", {})
    return read_graph_file(graph, skip_unknown)


def _check_lengths(graph: PoseGraph) -> None:
    """Refuse edges whose covariances, carried along them, are no numbers."""
    length = np.abs(graph.Ts_first_second[:, : graph.space, graph.space]).max(axis=1)
    if (length > FARTHEST).any():
        edge = int(np.argmax(length))
        name = f"edge {edge} ({graph.ids[graph.first[edge]]}-{graph.ids[graph.second[edge]]})"
        raise InputError(f"{name} is {length[edge]:.3g} m long: remove it, or leave out robust")


def _parts(graph: PoseGraph) -> tuple[tuple[int, ...], int]:
    """Return how many nodes each connected component has, the largest first, and how many float."""
    from odomap.backend.graphs.components import find_components

    components = find_components(graph, through_landmarks=True)
    sizes = sorted(np.bincount(components.label).tolist(), reverse=True)
    return tuple(sizes), int(components.is_free.sum())


def _write(
    before: PoseGraph, solution: "Solution", out: str | Path | None, picture: str | Path | None
) -> tuple[Path, ...]:
    written = []
    if out is not None:
        write_graph(out, solution.graph)
        written.append(Path(out))
    if picture is not None and solution.graph.num_edges:
        from odomap.views.graphs import graph_figure
        from odomap.views.style import figure_png

        name, positions = _start(before)
        figure = graph_figure(solution.graph, positions, solution.is_rejected, name)
        write_bytes(picture, figure_png(figure, dpi=110))
        written.append(Path(picture))
    return tuple(written)


def _start(graph: PoseGraph) -> tuple[str, NDArray[np.float64]]:
    """Return what to show as the start: the file's poses, or where dead reckoning leads."""
    from odomap.backend.graphs.components import find_components
    from odomap.backend.graphs.initialization import spanning_tree

    if np.isfinite(graph.Ts_world_node).all():
        return "Before", graph.positions
    steps = np.where(graph.is_loop, 0.0, 1.0)
    if find_components(graph, steps).count == find_components(graph).count:
        Ts, name = spanning_tree(graph, steps), "Before: dead reckoning"
    else:
        Ts, name = spanning_tree(graph), "Before: along a spanning tree"
    return name, Ts[:, : graph.space, graph.space]
