"""Edges between motions of the plane, compiled: imported where there are any (`graphproblem`)."""

from odomap.backend.graphs.edges import compile_edges

__all__ = ["warm_up"]


def warm_up() -> None:
    """Compile the kernels of `edges` for motions of the plane."""
    compile_edges("SE2")
