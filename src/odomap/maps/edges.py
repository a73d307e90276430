"""Edges: measured relative placements of two keyframes, what a pose graph is made of.

An edge (i, j) says S_i_j = S_i⁻¹ S_j was measured as (T_i_j, scale_i_j) with an information matrix
over the tangent (translation, rotation), right update. A measurement is never changed: an edge to a
keyframe that was culled keeps its ids, and the stub says where that end is. Where they would grow
with time, some may be replaced by few that say the same of the keyframes which are left.

Reference: R. Kümmerle et al., g2o: a general framework for graph optimization, 2011.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.maps.columns import grown

__all__ = ["FOLDED", "GAP", "LOOP", "ODOMETRY", "EdgeTable", "Edges"]

LOOP = "loop"
"""Kind of the edges that say where two keyframes of one place lie to each other."""
GAP = "gap"
"""Kind of the edges that say where nothing is known of that: a piece begins (`atlas`)."""
ODOMETRY = "odometry"
"""Kind of the edges that only the wheels say something of."""
FOLDED = "folded"
"""Kind of the edges that say what others said, to keyframes that were culled."""


@dataclass(frozen=True, eq=False)
class EdgeTable:
    """Edges as arrays, a copy.

    Attributes:
        i: (E,) int64 keyframe ids.
        j: (E,) int64 keyframe ids.
        Ts_i_j: (E, 4, 4) measured poses of j in i, in the units of i.
        scales_i_j: (E,) units of i per unit of j.
        information: (E, 6, 6).
        kind: (E,) what measured it, such as "odometry" or "loop".
    """

    i: NDArray[np.int64]
    j: NDArray[np.int64]
    Ts_i_j: NDArray[np.float64]
    scales_i_j: NDArray[np.float64]
    information: NDArray[np.float64]
    kind: tuple[str, ...]


class Edges:
    """A growing table of edges; rows are numbered in the order they came."""

    def __init__(self) -> None:
        self._ends = np.zeros((0, 2), np.int64)
        self._Ts = np.zeros((0, 4, 4))
        self._scales = np.zeros(0)
        self._information = np.zeros((0, 6, 6))
        self._kind: list[str] = []

    def __len__(self) -> int:
        return len(self._kind)

    def add(
        self,
        i: int,
        j: int,
        T_i_j: NDArray[np.float64],
        information: NDArray[np.float64],
        kind: str,
        scale_i_j: float,
    ) -> int:
        """Append an edge and return its row."""
        row = len(self._kind)
        self._ends = grown(self._ends, row + 1)
        self._Ts = grown(self._Ts, row + 1)
        self._scales = grown(self._scales, row + 1)
        self._information = grown(self._information, row + 1)
        self._ends[row] = i, j
        self._Ts[row] = T_i_j
        self._scales[row] = scale_i_j
        self._information[row] = information
        self._kind.append(kind)
        return row

    def replace(self, rows: NDArray[np.int64], others: EdgeTable) -> None:
        """Remove edges, and append others; those that follow move up."""
        stay = np.delete(np.arange(len(self)), rows)
        self._ends = np.concatenate([self._ends[stay], np.column_stack([others.i, others.j])])
        self._Ts = np.concatenate([self._Ts[stay], others.Ts_i_j])
        self._scales = np.concatenate([self._scales[stay], others.scales_i_j])
        self._information = np.concatenate([self._information[stay], others.information])
        self._kind = [*(self._kind[row] for row in stay.tolist()), *others.kind]

    def ends_of_gaps(self) -> set[int]:
        """Return the keyframes on either side of gaps."""
        if GAP not in self._kind:
            return set()
        rows = [row for row, kind in enumerate(self._kind) if kind == GAP]
        return set(self._ends[rows].ravel().tolist())

    def restore(self, table: EdgeTable) -> None:
        """Fill an empty table with the edges of another."""
        self._ends = np.column_stack([table.i, table.j]).astype(np.int64)
        self._Ts = table.Ts_i_j.copy()
        self._scales = table.scales_i_j.copy()
        self._information = table.information.copy()
        self._kind = list(table.kind)

    def twin(self) -> "Edges":
        """Return the edges there are now; rows are never written again, so none is copied."""
        twin = Edges()
        twin._ends, twin._Ts, twin._scales = self._ends, self._Ts, self._scales
        twin._information, twin._kind = self._information, self._kind.copy()
        return twin

    def table(self) -> EdgeTable:
        """Return all edges, copied."""
        rows = len(self._kind)
        return EdgeTable(
            self._ends[:rows, 0].copy(),
            self._ends[:rows, 1].copy(),
            self._Ts[:rows].copy(),
            self._scales[:rows].copy(),
            self._information[:rows].copy(),
            tuple(self._kind),
        )
