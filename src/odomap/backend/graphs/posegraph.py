"""Pose graphs: poses tied together by measured relative motions.

Node i has a pose T_i = T_world_node; an edge says that T_i⁻¹ T_j was measured as Z with information
Ω, the inverse covariance of the error in the tangent at Z. The best poses minimise

    ½ Σ_edges ρ( rᵀ Ω r ),     r = log( Z⁻¹ T_i⁻¹ T_j ),

with poses in SE(2), SE(3) or Sim(3). A prior measures a pose in the world; a sight measures a
landmark p in the frame of a node, r = R_iᵀ (p - t_i) - z. The graph as a whole may move freely
unless a node is fixed or has a prior, and so may each of its connected components.

This module holds the problem as arrays and refuses what cannot be one; `solve` finds the poses.

Reference: G. Grisetti, R. Kümmerle, C. Stachniss, W. Burgard, "A tutorial on graph-based SLAM",
IEEE Intelligent Transportation Systems Magazine 2(4), 2010.
"""

import copy
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Literal, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from odomap.errors import InputError

__all__ = ["GROUPS", "Group", "GroupSize", "PoseGraph", "Priors", "Sights"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Group = Literal["SE2", "SE3", "Sim3"]
Namer = Callable[[int], str]


class GroupSize(NamedTuple):
    """Numbers of a group: unknowns of a pose, dimensions of space."""

    dim: int
    space: int


GROUPS = MappingProxyType({"SE2": GroupSize(3, 2), "SE3": GroupSize(6, 3), "Sim3": GroupSize(7, 3)})
"""Unknowns per pose and dimensions of space of each group."""

_SYMMETRY = 1e-6
"""How far an information matrix may be from its transpose, relative to its largest entry."""

_DEFINITE = 1e-9
"""How negative an eigenvalue may be by rounding, relative to the largest."""

_ROTATION = 1e-4
"""How far RᵀR may be from I: files round to six digits."""


@dataclass(frozen=True)
class Priors:
    """Measured poses in the world: node (P,), Ts_world_node (P, m, m), information (P, k, k)."""

    node: Index
    Ts_world_node: Array
    information: Array


@dataclass(frozen=True)
class Sights:
    """Landmarks and where nodes saw them.

    Attributes:
        points_world: (M, d), NaN where unknown.
        ids: (M,) names in files.
        node: (S,) which node saw.
        point: (S,) which landmark.
        points_node: (S, d) measured in the frame of the node.
        information: (S, d, d).
    """

    points_world: Array
    ids: Index
    node: Index
    point: Index
    points_node: Array
    information: Array


@dataclass(frozen=True, eq=False)
class PoseGraph:
    """A pose graph, as arrays.

    Attributes:
        group: "SE2", "SE3" or "Sim3"; k = 3, 6, 7 unknowns per pose, matrices of m = 3, 4, 4 rows.
        Ts_world_node: (N, m, m); NaN where unknown, to be initialised. Sim3 holds s R.
        first, second: (E,) nodes of each edge.
        Ts_first_second: (E, m, m) measured.
        information: (E, k, k) inverse covariance, tangent (translation, rotation, log scale).
        ids: (N,) names of the nodes in files; 0 to N - 1 unless given.
        is_fixed: (N,) bool; nodes to hold where they are. None unless given.
        priors: poses measured in the world.
        points: landmarks, and sights of them.

    Raises:
        InputError: shapes, indices, values that are not finite, what is not a rotation,
            information that is not symmetric and positive semidefinite.

    Example:
        >>> step, unknown = np.eye(3), np.full((2, 3, 3), np.nan)
        >>> step[0, 2] = 1.0
        >>> graph = PoseGraph("SE2", unknown, [0], [1], [step], [np.eye(3)])
        >>> graph.num_nodes, graph.num_edges, graph.dim
        (2, 1, 3)
    """

    group: Group
    Ts_world_node: Array
    first: Index
    second: Index
    Ts_first_second: Array
    information: Array
    ids: Index = None  # type: ignore[assignment]
    is_fixed: NDArray[np.bool_] = None  # type: ignore[assignment]
    priors: Priors = None  # type: ignore[assignment]
    points: Sights = None  # type: ignore[assignment]
    size: GroupSize = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.group not in GROUPS:
            raise InputError(f"pose graph: group '{self.group}' is unknown; SE2, SE3 or Sim3")
        size = GROUPS[self.group]
        self._set("size", size)
        m = size.space + 1
        self._set("Ts_world_node", _reals(self.Ts_world_node, (m, m), "Ts_world_node"))
        n = len(self.Ts_world_node)
        self._set("ids", np.arange(n) if self.ids is None else _indices(self.ids, None, "ids"))
        fixed = np.zeros(n, bool) if self.is_fixed is None else np.asarray(self.is_fixed, bool)
        self._set("is_fixed", fixed)
        for name in ("first", "second"):
            self._set(name, _indices(getattr(self, name), n, name))
        self._set("Ts_first_second", _reals(self.Ts_first_second, (m, m), "Ts_first_second"))
        k = size.dim
        self._set("information", _reals(self.information, (k, k), "information"))
        self._set("priors", _checked_priors(self.priors, n, size))
        self._set("points", _checked_points(self.points, n, size))
        self._check()

    def _set(self, name: str, value: object) -> None:
        object.__setattr__(self, name, value)

    def _check(self) -> None:
        n, e = self.num_nodes, self.num_edges
        if not (len(self.ids) == len(self.is_fixed) == n):
            raise InputError(f"pose graph: ids and is_fixed must have one entry per node ({n})")
        in_order = np.sort(self.ids)
        twice = in_order[1:] == in_order[:-1]
        if twice.any():
            name = in_order[1:][np.argmax(twice)]
            raise InputError(f"pose graph: two nodes are called {name}: ids must differ")
        if not (len(self.second) == len(self.Ts_first_second) == len(self.information) == e):
            raise InputError("pose graph: edge arrays differ in length")
        loops = np.flatnonzero(self.first == self.second)
        if len(loops):
            name = self.name_of_edge(int(loops[0]))
            raise InputError(f"pose graph: {name}: a node cannot be tied to itself")
        _check_transforms(self.Ts_first_second, self.name_of_edge, self.group)
        _check_information(self.information, self.name_of_edge)
        known = ~np.isnan(self.Ts_world_node).any(axis=(1, 2))
        _check_transforms(
            self.Ts_world_node[known],
            lambda i: f"node {self.ids[np.flatnonzero(known)[i]]}",
            self.group,
        )
        if (self.is_fixed & ~known).any():
            node = self.ids[np.flatnonzero(self.is_fixed & ~known)[0]]
            raise InputError(f"pose graph: node {node} is to be held, but its pose is not known")

    def name_of_edge(self, edge: int) -> str:
        """Return how messages call an edge."""
        return f"edge {edge} ({self.ids[self.first[edge]]} to {self.ids[self.second[edge]]})"

    @property
    def dim(self) -> int:
        """Unknowns of one pose: 3, 6 or 7."""
        return self.size.dim

    @property
    def space(self) -> int:
        """Dimensions of space: 2 or 3."""
        return self.size.space

    @property
    def num_nodes(self) -> int:
        """How many poses there are."""
        return len(self.Ts_world_node)

    @property
    def num_edges(self) -> int:
        """How many relative motions were measured."""
        return len(self.first)

    @property
    def is_loop(self) -> NDArray[np.bool_]:
        """(E,) whether an edge ties nodes that do not follow each other by name."""
        i, j = self.ids[self.first], self.ids[self.second]
        return np.asarray(np.maximum(i, j) - np.minimum(i, j) != 1)

    @property
    def positions(self) -> Array:
        """(N, d) positions of the nodes in the world, metres."""
        return self.Ts_world_node[:, : self.space, self.space]

    def placed(self, Ts_world_node: Array, points_world: Array | None = None) -> Self:
        """Return the same graph at other poses (N, m, m) and landmarks (M, d), unchecked."""
        other = copy.copy(self)
        other._set("Ts_world_node", Ts_world_node)
        if points_world is not None:
            other._set("points", replace(self.points, points_world=points_world))
        return other

    def with_priors(self, priors: Priors) -> Self:
        """Return the same graph with other priors, unchecked."""
        other = copy.copy(self)
        other._set("priors", priors)
        return other

    def without(self, edges: NDArray[np.bool_]) -> Self:
        """Return the graph without the edges marked (E,); what is left needs no second check."""
        other, keep = copy.copy(self), ~np.asarray(edges, bool)
        if not keep.all():
            for name in ("first", "second", "Ts_first_second", "information"):
                other._set(name, getattr(self, name)[keep])
        return other


def _reals(values: ArrayLike, tail: tuple[int, ...], name: str) -> Array:
    try:
        array = np.array(values, np.float64, order="C")
    except (TypeError, ValueError):
        raise InputError(f"pose graph: {name} is not an array of numbers") from None
    if array.size == 0:
        return np.zeros((0, *tail))
    if array.ndim != len(tail) + 1 or array.shape[1:] != tail:
        want = ", ".join(str(n) for n in ("n", *tail))
        raise InputError(f"pose graph: {name} has shape {array.shape}, give ({want})")
    return array


def _indices(values: ArrayLike, count: int | None, name: str) -> Index:
    try:
        array = np.array(values)
    except (TypeError, ValueError):
        array = np.zeros((0, 0))
    if array.ndim != 1 or (array.size and array.dtype.kind not in "iu"):
        raise InputError(f"pose graph: {name} must be a list of whole numbers")
    if array.size and array.max() > np.iinfo(np.int64).max:
        raise InputError(f"pose graph: {name} holds a number beyond 2^63")
    array = array.astype(np.int64)
    if count is not None and array.size and not 0 <= array.min() <= array.max() < count:
        raise InputError(f"pose graph: {name} names a node or landmark that does not exist")
    return array


def _checked_priors(priors: Priors | None, n: int, size: GroupSize) -> Priors:
    m, k = size.space + 1, size.dim
    if not isinstance(priors, Priors | None):
        raise InputError("pose graph: priors must be given as `Priors`")
    if priors is None:
        return Priors(np.zeros(0, np.int64), np.zeros((0, m, m)), np.zeros((0, k, k)))
    node = _indices(priors.node, n, "priors.node")
    Ts = _reals(priors.Ts_world_node, (m, m), "priors.Ts_world_node")
    information = _reals(priors.information, (k, k), "priors.information")
    if not len(node) == len(Ts) == len(information):
        raise InputError("pose graph: arrays of priors differ in length")
    _check_transforms(Ts, lambda i: f"prior {i}", "Sim3" if k == 7 else "SE3")
    _check_information(information, lambda i: f"prior {i}")
    return Priors(node, Ts, information)


def _checked_points(points: Sights | None, n: int, size: GroupSize) -> Sights:
    d = size.space
    if not isinstance(points, Sights | None):
        raise InputError("pose graph: points must be given as `Sights`")
    if points is None:
        none = np.zeros(0, np.int64)
        return Sights(np.zeros((0, d)), none, none, none, np.zeros((0, d)), np.zeros((0, d, d)))
    world = _reals(points.points_world, (d,), "points.points_world")
    checked = Sights(
        world,
        _indices(points.ids, None, "points.ids"),
        _indices(points.node, n, "points.node"),
        _indices(points.point, len(world), "points.point"),
        _reals(points.points_node, (d,), "points.points_node"),
        _reals(points.information, (d, d), "points.information"),
    )
    count = len(checked.node)
    if len(checked.ids) != len(world) or not (
        len(checked.point) == len(checked.points_node) == len(checked.information) == count
    ):
        raise InputError("pose graph: arrays of landmarks differ in length")
    if not np.isfinite(checked.points_node).all():
        raise InputError("pose graph: a sight of a landmark is not finite")
    _check_information(checked.information, lambda s: f"sight {s}")
    return checked


def _check_transforms(Ts: Array, name: Namer, group: str) -> None:
    """Refuse matrices that are not finite, or not of the group."""
    if not len(Ts):
        return
    finite = np.isfinite(Ts).all(axis=(1, 2))
    if not finite.all():
        raise InputError(f"pose graph: {name(int(np.argmin(finite)))}: a value is not finite")
    d = Ts.shape[1] - 1
    skewed = (np.abs(Ts[:, d] - np.eye(d + 1)[d]) > 1e-9).any(axis=1)
    if skewed.any():
        which = int(np.argmax(skewed))
        raise InputError(f"pose graph: {name(which)}: the last row must be 0 … 0 1")
    R = Ts[:, :d, :d]
    determinant = np.linalg.det(R)
    scale = np.cbrt(np.abs(determinant)) if group == "Sim3" else np.ones(len(Ts))
    scale = np.maximum(scale, 1e-300)[:, None, None]
    off = np.abs(np.swapaxes(R, 1, 2) @ R / scale**2 - np.eye(d)).max(axis=(1, 2))
    wrong = (off > _ROTATION) | (determinant <= 0)
    if wrong.any():
        which = int(np.argmax(wrong))
        raise InputError(
            f"pose graph: {name(which)}: not a rotation (off by {off[which]:.1e}): "
            "is a quaternion of zeros, or its order wrong?"
        )


def _check_information(information: Array, name: Namer) -> None:
    """Refuse information that is not finite, symmetric and positive semidefinite."""
    if not len(information):
        return
    finite = np.isfinite(information).all(axis=(1, 2))
    if not finite.all():
        which = int(np.argmin(finite))
        raise InputError(f"pose graph: {name(which)}: its information is not finite")
    largest = np.abs(information).max(axis=(1, 2))
    skew = np.abs(information - np.swapaxes(information, 1, 2)).max(axis=(1, 2))
    if (skew > _SYMMETRY * largest).any():
        which = int(np.argmax(skew > _SYMMETRY * largest))
        raise InputError(f"pose graph: {name(which)}: its information is not symmetric")
    values = np.linalg.eigvalsh(information)
    negative = values[:, 0] < -_DEFINITE * np.maximum(values[:, -1], 1e-300)
    if negative.any():
        which = int(np.argmax(negative))
        raise InputError(
            f"pose graph: {name(which)}: its information is indefinite (an eigenvalue is "
            f"{values[which, 0]:.3g}): is the order of its entries right?"
        )
