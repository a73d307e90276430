"""`odomap optimize`: the best poses of a pose graph."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from odomap.cli.progress import Steps

if TYPE_CHECKING:
    from odomap.geometry.robust import Loss
    from odomap.optimize import OptimizeResult

__all__ = ["Optimize", "chosen_loss", "chosen_picture"]

MOST_LISTED = 10
"""Rejected edges that are named."""


@dataclass(frozen=True)
class Optimize:
    """Find the best poses of a pose graph (g2o or TORO text, plain or .gz).

    Prints what was found; --out writes the graph at its best poses, and a picture of before and
    after beside it. Ctrl-C ends with the best poses so far. Exit code 1 if it did not converge.
    """

    graph: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="GRAPH")]
    """A .g2o or TORO file; poses may be missing."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Where to write the graph: TORO for .toro and .graph, else g2o; with .gz packed."""
    cost: Literal["geodesic", "chordal"] | None = None
    """Geodesic (that of g2o and GTSAM) or chordal (SE-Sync's); default geodesic, but chordal with
    --certify."""
    method: Literal["dogleg", "gauss_newton", "levenberg_marquardt"] = "dogleg"
    """How to descend."""
    initial: Literal["auto", "given", "chordal", "spanning_tree"] = "auto"
    """Where to begin; auto takes the better of what is given and chordal."""
    loss: Literal["huber", "cauchy", "geman_mcclure", "tukey", "dcs"] | None = None
    """Let loop edges that fit badly count less."""
    width: Annotated[float | None, tyro.conf.arg(metavar="SIGMAS")] = None
    """Where the loss sets in, in standard deviations; default by the loss."""
    robust: Literal["gnc"] | None = None
    """Gnc finds false loop edges, names them and leaves them out."""
    certify: bool = False
    """Prove that there are no better poses, if so."""
    max_iterations: Annotated[int, tyro.conf.arg(metavar="N")] = 100
    """Most steps."""
    skip_unknown: bool = False
    """Pass over lines of unknown tags."""
    plot: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """PNG file for the picture; default beside --out."""
    picture: Annotated[bool, tyro.conf.arg(help_behavior_hint="")] = True
    """Draw nothing beside --out."""
    quiet: bool = False
    """No progress."""

    def execute(self) -> int:
        """Solve, write, and say what was found."""
        from odomap.optimize import optimize

        loss = chosen_loss(self.loss, self.width)
        picture = chosen_picture(self.plot, self.out if self.picture else None)
        with Steps("optimize", self.quiet) as steps:
            result = optimize(
                self.graph,
                self.out,
                cost=self.cost,
                method=self.method,
                initial=self.initial,
                loss=loss,
                robust=self.robust,
                certify=self.certify,
                max_iterations=self.max_iterations,
                skip_unknown=self.skip_unknown,
                picture=picture,
                progress=steps.show,
            )
        for tag, count in result.skipped.items():
            print(f"odomap: warning: {count} lines of {tag} passed over", file=sys.stderr)
        for name, value in rows(result):
            print(f"{name:<16} {value}")
        if self.robust is not None:
            print(f"{'rejected':<16} {_rejected(result)}")
        return _code(result)


def chosen_loss(name: str | None, width: float | None) -> "Loss | None":
    """Return the loss that was asked for.

    Raises:
        InputError: a width that cannot be, or one without a loss.
    """
    from odomap.errors import InputError
    from odomap.geometry.robust import Loss

    if width is not None and name is None:
        raise InputError("--width says where a loss sets in: give --loss, too")
    if width is not None and not 0.0 < width < float("inf"):
        raise InputError(f"--width is {width:g}: a positive number expected")
    return None if name is None else Loss(name, width or 0.0)


def chosen_picture(plot: Path | None, out: Path | None) -> Path | None:
    """Return where the picture goes, None if there is none.

    Raises:
        InputError: it would not be a PNG file.
    """
    from odomap.errors import InputError
    from odomap.optimize import picture_beside

    if plot is not None and plot.suffix.lower() != ".png":
        raise InputError(f"--plot {plot}: only PNG is drawn: end the name in .png")
    return plot or (None if out is None else picture_beside(out))


def rows(result: "OptimizeResult") -> list[tuple[str, str]]:
    """Return the lines of the conclusion, name and value."""
    solution = result.solution
    graph = solution.graph
    landmarks = len(graph.points.ids)
    also = f", {landmarks} landmarks seen {len(graph.points.node)} times" if landmarks else ""
    loops = int(graph.is_loop.sum())
    lines = [
        ("graph", f"{graph.group}, {graph.num_nodes} poses, {graph.num_edges} edges{also}"),
        ("loops", f"{loops} edges"),
        ("components", _parts(result.sizes, result.num_loose)),
        ("start", solution.initial.replace("_", " ")),
        ("cost", f"{solution.cost_before:.8g} → {solution.cost_after:.8g}  ({result.cost})"),
        ("iterations", f"{solution.iterations}: {solution.reason}"),
        ("time", f"{result.seconds:.3f} s"),
    ]
    if result.certificate is not None:
        proof = result.certificate
        text = f"λ_min {proof.smallest_eigenvalue:.3g}, |S| {proof.norm:.3g}"
        within = f"proven optimal within {proof.suboptimality:.3g} of the cost {proof.cost:.8g}"
        lines += [
            ("certificate", f"{proof.reason}  ({text})"),
            ("", f"{within}: no poses cost less than {proof.lower_bound:.8g}"),
        ]
    return lines + [("wrote", str(path)) for path in result.written]


def _rejected(result: "OptimizeResult") -> str:
    """Return how many edges were found to be false, and the first of them by their nodes."""
    import numpy as np

    graph, edges = result.solution.graph, np.flatnonzero(result.solution.is_rejected)
    shown = [f"{graph.ids[graph.first[e]]}-{graph.ids[graph.second[e]]}" for e in edges]
    listed = ", ".join(shown[:MOST_LISTED]) + (", …" if len(shown) > MOST_LISTED else "")
    return f"{len(edges)} of {int(graph.is_loop.sum())} loops{': ' if shown else ''}{listed}"


def _parts(sizes: tuple[int, ...], num_loose: int) -> str:
    if len(sizes) == 1:
        return "1"
    shown = ", ".join(map(str, sizes[:5])) + (", …" if len(sizes) > 5 else "")
    placed = "not placed relative to each other" if num_loose else "each placed in the world"
    return f"{len(sizes)} (of {shown} poses): solved one by one, {placed}"


def _code(result: "OptimizeResult") -> int:
    if result.is_interrupted:
        print("odomap: interrupted: these are the best poses so far", file=sys.stderr)
        return 130
    if not result.solution.converged:
        print(f"odomap: not converged: {result.solution.reason}", file=sys.stderr)
        return 1
    return 0
