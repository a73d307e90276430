"""A pose graph that nodes, edges and priors are added to, one at a time and checked once.

Nodes are known by their names (ids). What is added is checked by the rules of `PoseGraph` before
anything is changed, and nothing that is there already is looked at again.

Nodes tied to each other form a *part*, which may move as a whole until a prior or a fixed node
holds it. When an edge ties two parts, one that may move is moved so that the edge is met exactly;
of two, the younger. A node without a pose is a part that has to be moved: so a chain of odometry
is placed link by link, and a map begun apart falls into place when its first loop closes.

Cost: O(1) per addition; a part that moves is rewritten, and parts are joined smaller to larger.

Reference: G. Grisetti, R. Kümmerle, C. Stachniss, W. Burgard, "A tutorial on graph-based SLAM",
IEEE Intelligent Transportation Systems Magazine 2(4), 2010.
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from odomap.backend.graphs.growing import GrowingArray
from odomap.backend.graphs.neighbourhood import EdgeLists, Neighbourhood
from odomap.backend.graphs.posegraph import GROUPS, Group, PoseGraph, Priors
from odomap.errors import InputError
from odomap.geometry.lie import se2_inverse, se3_inverse, sim3_inverse

__all__ = ["GrowingGraph"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Bool = NDArray[np.bool_]


@dataclass
class _Part:
    """Nodes tied to each other, oldest first where it matters: `anchor` holds them if free."""

    nodes: list[int]
    anchor: int
    is_free: bool


class GrowingGraph:
    """A pose graph to which is added.

    Args:
        group: "SE2", "SE3" or "Sim3".

    Attributes:
        edges: edge lists of its nodes.
        unplaced: nodes whose poses are not known yet.
    """

    def __init__(self, group: Group) -> None:
        if group not in GROUPS:
            raise InputError(f"pose graph: group '{group}' is unknown; SE2, SE3 or Sim3")
        m, k = GROUPS[group].space + 1, GROUPS[group].dim
        none = np.zeros(0, np.int64)
        self._empty = PoseGraph(group, np.zeros((0, m, m)), none, none, np.zeros(0), np.zeros(0))
        self._inverse = {"SE2": se2_inverse, "SE3": se3_inverse, "Sim3": sim3_inverse}[group]
        self._index: dict[int, int] = {}
        self._next_id = 0
        self._Ts, self._ids = GrowingArray((m, m), np.float64), GrowingArray((), np.int64)
        self._is_fixed, self._is_held = GrowingArray((), np.bool_), GrowingArray((), np.bool_)
        self._first, self._second = GrowingArray((), np.int64), GrowingArray((), np.int64)
        self._measured = GrowingArray((m, m), np.float64)
        self._information = GrowingArray((k, k), np.float64)
        self._prior_node = GrowingArray((), np.int64)
        self._prior_T, self._prior_information = (
            GrowingArray((m, m), np.float64),
            GrowingArray((k, k), np.float64),
        )
        self._priors_of: dict[int, list[int]] = {}
        self._parts: list[_Part] = []
        self.unplaced: set[int] = set()
        self.edges = EdgeLists()

    @property
    def num_nodes(self) -> int:
        """How many poses there are."""
        return len(self._Ts)

    @property
    def num_edges(self) -> int:
        """How many relative motions were measured."""
        return len(self._first)

    @property
    def num_priors(self) -> int:
        """How many poses were measured in the world."""
        return len(self._prior_node)

    @property
    def Ts_world_node(self) -> Array:
        """(N, m, m) poses, which may be written."""
        return self._Ts.rows

    @property
    def ids(self) -> Index:
        """(N,) names of the nodes."""
        return self._ids.rows

    @property
    def is_held(self) -> Bool:
        """(N,) nodes that stay: those fixed, and the anchor of each part that could move."""
        return self._is_held.rows

    @property
    def num_parts(self) -> int:
        """How many parts nothing ties to each other."""
        return len({id(part) for part in self._parts})

    def index_of(self, node: int) -> int:
        """Return the index of a node known by its id."""
        try:
            return self._index[node]
        except (KeyError, TypeError):
            raise InputError(f"pose graph: node {node} is unknown; add it first") from None

    def add_node(self, T_world_node: ArrayLike | None, node: int | None, is_fixed: bool) -> int:
        """Add a node that nothing ties yet; return its id."""
        node = self._next_id if node is None else node
        if isinstance(node, bool) or not isinstance(node, int | np.integer):
            raise InputError(f"pose graph: the id of a node is a whole number, not {node!r}")
        if not -(2**63) <= node < 2**63:
            raise InputError(f"pose graph: node {node}: an id has 64 bits; give a smaller one")
        if node in self._index:
            raise InputError(f"pose graph: node {node} is there already")
        T = self._unknown(1)[0]
        if T_world_node is not None:
            T = np.asarray(T_world_node, np.float64)
            if not np.isfinite(T).all():
                raise InputError(f"pose graph: node {node}: a value is not finite")
        elif not self.num_nodes:
            T = np.eye(self._empty.space + 1)
        self._checked(Ts_world_node=T[None], ids=[node], is_fixed=[is_fixed])
        index = self.num_nodes
        self._Ts.append(T)
        self._ids.append(node)
        self._is_fixed.append(is_fixed)
        self._is_held.append(True)
        self.edges.add_node()
        self._parts.append(_Part([index], index, not is_fixed))
        self._index[int(node)] = index
        if np.isnan(T).any():
            self.unplaced.add(index)
        self._next_id = max(self._next_id, int(node) + 1)
        return int(node)

    def add_edge(self, i: int, j: int, T_i_j: ArrayLike, information: ArrayLike) -> int:
        """Add a measured motion between two nodes known by their ids; return the edge's index."""
        first, second = self.index_of(i), self.index_of(j)
        if first == second:
            raise InputError(f"pose graph: node {i} cannot be tied to itself")
        checked = self._checked(
            Ts_world_node=self._unknown(2),
            first=[0],
            second=[1],
            Ts_first_second=[T_i_j],
            information=[information],
            ids=[i, j],
        )
        self._first.append(first)
        self._second.append(second)
        self._measured.append(checked.Ts_first_second[0])
        self._information.append(checked.information[0])
        self.edges.add_edge(first, second)
        return self.num_edges - 1

    def add_prior(self, i: int, T_world_node: ArrayLike, information: ArrayLike) -> int:
        """Add a measured pose of a node known by its id; return the prior's index."""
        node = self.index_of(i)
        priors = Priors([0], [T_world_node], [information])  # type: ignore[arg-type]
        checked = self._checked(Ts_world_node=self._unknown(1), priors=priors).priors
        self._prior_node.append(node)
        self._prior_T.append(checked.Ts_world_node[0])
        self._prior_information.append(checked.information[0])
        self._priors_of.setdefault(node, []).append(self.num_priors - 1)
        return self.num_priors - 1

    def nodes_of_edge(self, edge: int) -> list[int]:
        """Return the indices of both nodes of an edge."""
        return [int(self._first.rows[edge]), int(self._second.rows[edge])]

    def node_of_prior(self, prior: int) -> int:
        """Return the index of the node a prior is of."""
        return int(self._prior_node.rows[prior])

    def settle_prior(self, prior: int) -> list[int]:
        """Hold a part by a prior; return the nodes that were moved there, if it was free."""
        node = self.node_of_prior(prior)
        part = self._parts[node]
        if not part.is_free:
            return []
        moved = self._move(part, node, self._prior_T.rows[prior])
        part.is_free = False
        self._is_held.rows[part.anchor] = False
        return moved

    def settle_edge(self, edge: int) -> list[int] | None:
        """Join the parts that an edge ties; return the nodes moved, or None if it must wait."""
        i, j = self.nodes_of_edge(edge)
        a, b = self._parts[i], self._parts[j]
        if a is b:
            return []
        if i in self.unplaced and j in self.unplaced:
            return None
        Z, Ts, moved = self._measured.rows[edge], self._Ts.rows, list[int]()
        if self._gives_way(a, b):
            moved = self._move(a, i, Ts[j] @ self._inverse(Z))
            self._is_held.rows[a.anchor] = False
            self._join(a, b)
        elif b.is_free:
            moved = self._move(b, j, Ts[i] @ Z)
            self._is_held.rows[b.anchor] = False
            self._join(b, a)
        else:
            self._join(b, a)
        return moved

    def _gives_way(self, a: _Part, b: _Part) -> bool:
        """Say whether part `a` is the one to move onto `b`."""
        if not (a.is_free and b.is_free):
            return a.is_free
        if self.unplaced.isdisjoint((a.anchor, b.anchor)):
            return a.anchor > b.anchor
        return a.anchor in self.unplaced

    def _join(self, moved: _Part, kept: _Part) -> None:
        """Make one part of two, the smaller one's nodes joining the larger one's list."""
        small, large = sorted((moved, kept), key=lambda part: len(part.nodes))
        for node in small.nodes:
            self._parts[node] = large
        large.nodes.extend(small.nodes)
        large.anchor, large.is_free = kept.anchor, kept.is_free

    def _move(self, part: _Part, node: int, T: Array) -> list[int]:
        """Move a part as a whole so that one of its nodes comes to T; return its nodes."""
        Ts = self._Ts.rows
        if len(part.nodes) > 1:
            Ts[part.nodes] = T @ self._inverse(Ts[node]) @ Ts[part.nodes]
        Ts[node] = T
        self.unplaced.discard(node)
        return list(part.nodes)

    def whole(self) -> PoseGraph:
        """Return all of it, its arrays views of what grows."""
        return self._graph(
            self._Ts.rows,
            self._ids.rows,
            self._is_fixed.rows,
            self._first.rows,
            self._second.rows,
            slice(None),
            slice(None),
            self._prior_node.rows,
        )

    def around(self, seeds: Sequence[int], size: int) -> tuple[PoseGraph, Neighbourhood, list[int]]:
        """Return the graph near some nodes, what of the whole it is, and which priors it has."""
        near = self.edges.around(np.array(seeds, np.int64), size, self._is_held.rows)
        inner = near.nodes[: near.num_inner].tolist() if self._priors_of else []
        priors = [(p, at) for at, i in enumerate(inner) for p in self._priors_of.get(i, ())]
        which = [p for p, _ in priors]
        graph = self._graph(
            self._Ts.rows[near.nodes],
            self._ids.rows[near.nodes],
            self._is_fixed.rows[near.nodes],
            near.first,
            near.second,
            near.edges,
            np.array(which, np.int64),
            np.array([at for _, at in priors], np.int64),
        )
        return graph, near, which

    def _graph(
        self,
        Ts: Array,
        ids: Index,
        is_fixed: Bool,
        first: Index,
        second: Index,
        edges: Index | slice,
        priors: Index | slice,
        prior_node: Index,
    ) -> PoseGraph:
        """Return a pose graph of parts that were checked when they were added."""
        graph = copy.copy(self._empty)
        values = {
            "Ts_world_node": Ts,
            "ids": ids,
            "is_fixed": is_fixed,
            "first": first,
            "second": second,
            "Ts_first_second": self._measured.rows[edges],
            "information": self._information.rows[edges],
            "priors": Priors(
                prior_node, self._prior_T.rows[priors], self._prior_information.rows[priors]
            ),
        }
        for name, value in values.items():
            object.__setattr__(graph, name, value)
        return graph

    def _unknown(self, count: int) -> Array:
        """Return poses that are not known."""
        m = self._empty.space + 1
        return np.full((count, m, m), np.nan)

    def _checked(self, **fields: Any) -> PoseGraph:
        """Return a graph of its own of what is to be added, or refuse it."""
        none = np.zeros(0)
        edges = {"first": none, "second": none, "Ts_first_second": none, "information": none}
        return PoseGraph(self._empty.group, **(edges | fields))
