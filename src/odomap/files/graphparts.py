"""The parts of a graph between its file and its arrays: vertices and edges by name.

A file names vertices in any order and ties them by name; `PoseGraph` holds indices and matrices.
`Parts` is what lies between, in the numbers and the order of a g2o file. `graph` looks names up
and makes matrices, `of` goes back. Nodes and landmarks share their names. A file may declare all
poses or none; then all that edges name are there, in the order of their names, their poses not
known (NaN). The same holds for landmarks. Lines keep their numbers until all is checked, so that
a message can name them. O(n log n).
"""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from odomap.backend.graphs.posegraph import GROUPS, Group, PoseGraph, Priors, Sights
from odomap.errors import InputError
from odomap.files.graphlines import Array, Index, Rows
from odomap.files.graphposes import (
    full_matrices,
    numbers_from_poses,
    poses_from_numbers,
    upper_triangles,
)

__all__ = ["Parts"]

SHORTEST = 1e-12
"""A quaternion with no larger number is one of zeros."""
LARGEST_SCALE = 60
"""Powers of ten: cubes of scales must be numbers, too."""


@dataclass(frozen=True)
class Parts:
    """A graph in the numbers of a g2o file.

    Attributes:
        file: where it stands, for messages.
        group: of the poses.
        nodes: name; pose.
        edges: two names; pose, upper triangle of the information.
        priors: name; pose, upper triangle.
        landmarks: name; point.
        sights: node, landmark; point, upper triangle.
        fixed: name.
    """

    file: Path
    group: Group
    nodes: Rows
    edges: Rows
    priors: Rows
    landmarks: Rows
    sights: Rows
    fixed: Rows

    def graph(self) -> PoseGraph:
        """Make arrays of it.

        Raises:
            InputError: names the line that names what is not there, or holds what cannot be.
        """
        if not (len(self.edges) or len(self.sights) or len(self.priors)):
            raise InputError(f"{self.file}: has no edges: there is nothing to solve")
        ends = [(self.edges, 0), (self.edges, 1), (self.priors, 0), (self.sights, 0)]
        nodes = self._declared(self.nodes, [*ends, (self.fixed, 0)])
        landmarks = self._declared(self.landmarks, [(self.sights, 1)])
        self._check_names(nodes, landmarks)
        first, second, prior, seer, fixed = (
            self._find(nodes, rows, k) for rows, k in [*ends, (self.fixed, 0)]
        )
        is_fixed = np.zeros(len(nodes), bool)
        is_fixed[fixed] = True
        poses, information = self._measured(self.edges)
        prior_poses, prior_information = self._measured(self.priors)
        d = GROUPS[self.group].space
        sights = Sights(
            landmarks.numbers,
            landmarks.ids[:, 0],
            seer,
            self._find(landmarks, self.sights, 1),
            self.sights.numbers[:, :d],
            full_matrices(self.sights.numbers[:, d:], d),
        )
        placed = self._placed(nodes)
        try:
            return PoseGraph(
                self.group,
                placed,
                first,
                second,
                poses,
                information,
                nodes.ids[:, 0],
                is_fixed,
                Priors(prior, prior_poses, prior_information),
                sights,
            )
        except InputError as error:
            raise self._located(error) from error

    @classmethod
    def of(cls, file: Path, graph: PoseGraph) -> "Parts":
        """Take a graph apart.

        Raises:
            InputError: what a file could not say: two vertices of one name, poses known in part.
        """
        group, points, priors = graph.group, graph.points, graph.priors
        edges = np.column_stack([graph.ids[graph.first], graph.ids[graph.second]])
        seen = np.column_stack([graph.ids[points.node], points.ids[points.point]])
        prior = graph.ids[priors.node]
        _check_unique(file, np.concatenate([graph.ids, points.ids]))
        poses = numbers_from_poses(graph.Ts_world_node, group)
        tied = np.concatenate([edges.ravel(), seen[:, 0], prior])
        return cls(
            file,
            group,
            _known(file, "pose", graph.ids, poses, tied),
            Rows.of(edges, _numbers(group, graph.Ts_first_second, graph.information)),
            Rows.of(prior, _numbers(group, priors.Ts_world_node, priors.information)),
            _known(file, "landmark", points.ids, points.points_world, seen[:, 1]),
            Rows.of(
                seen, np.column_stack([points.points_node, upper_triangles(points.information)])
            ),
            Rows.of(graph.ids[graph.is_fixed], np.zeros((int(graph.is_fixed.sum()), 0))),
        )

    def _declared(self, rows: Rows, ends: list[tuple[Rows, int]]) -> Rows:
        """Return the vertices: those declared, or those named where none is declared."""
        if len(rows):
            return rows
        names = np.unique(np.concatenate([end.ids[:, k] for end, k in ends]))
        return Rows.of(names, np.full((len(names), rows.numbers.shape[1]), np.nan))

    def _check_names(self, nodes: Rows, landmarks: Rows) -> None:
        """Refuse two vertices of one name."""
        names = np.concatenate([nodes.ids[:, 0], landmarks.ids[:, 0]])
        lines = np.concatenate([nodes.lines, landmarks.lines])
        order = np.argsort(names, kind="stable")
        same = np.flatnonzero(np.diff(names[order]) == 0)
        if len(same):
            name = names[order[same[0]]]
            before, line = sorted(lines[order[same[0] : same[0] + 2]])
            if before:
                what = f"vertex {name} is there twice, first in line {before}: remove one"
            else:
                line = self.sights.lines[np.argmax(self.sights.ids[:, 1] == name)]
                what = f"vertex {name} is a pose and a landmark at once"
            raise InputError(f"{self.file}:{line}: {what}")

    def _find(self, vertices: Rows, rows: Rows, column: int) -> Index:
        """Return the places of named vertices."""
        names = rows.ids[:, column]
        if not len(names):
            return np.zeros(0, np.int64)
        order = np.argsort(vertices.ids[:, 0], kind="stable")
        place = np.searchsorted(vertices.ids[order, 0], names)
        found = order[np.minimum(place, len(order) - 1)]
        missing = vertices.ids[found, 0] != names
        if missing.any():
            row = int(np.argmax(missing))
            what = "landmark" if rows is self.sights and column == 1 else "pose"
            raise InputError(
                f"{self.file}:{rows.lines[row]}: {what} {names[row]} is declared nowhere: "
                "is its VERTEX line missing?"
            )
        return np.asarray(found, np.int64)

    def _placed(self, nodes: Rows) -> Array:
        """Return the poses of the nodes, NaN where the file has none."""
        if len(self.nodes):
            return self._poses(nodes, nodes.numbers.shape[1])
        if len(self.fixed):
            raise InputError(
                f"{self.file}:{self.fixed.lines[0]}: FIX {self.fixed.ids[0, 0]}: its pose is not "
                "in the file: declare the vertices, or remove FIX"
            )
        return np.full((len(nodes), *_shape(self.group)), np.nan)

    def _measured(self, rows: Rows) -> tuple[Array, Array]:
        """Return measured poses and their information."""
        k = GROUPS[self.group].dim
        split = rows.numbers.shape[1] - k * (k + 1) // 2
        return self._poses(rows, split), full_matrices(rows.numbers[:, split:], k)

    def _poses(self, rows: Rows, width: int) -> Array:
        """Return the poses in the first columns of rows."""
        numbers = rows.numbers[:, :width]
        if self.group != "SE2":
            wrong = np.abs(numbers[:, 3:7]).max(axis=1) < SHORTEST
            what = "a quaternion of zeros: is its order x y z w?"
            if self.group == "Sim3" and not wrong.any():
                wrong = np.abs(np.log10(np.maximum(numbers[:, 7], 1e-300))) > LARGEST_SCALE
                what = "a scale that cannot be: is it a positive number, the last of the pose?"
            if wrong.any():
                raise InputError(f"{self.file}:{rows.lines[int(np.argmax(wrong))]}: {what}")
        return poses_from_numbers(numbers, self.group)

    def _located(self, error: InputError) -> InputError:
        """Say in which line stands what a graph refuses."""
        text = str(error).removeprefix("pose graph: ")
        found = re.match(r"(edge|prior|sight) (\d+)", text)
        if found is None:
            return InputError(f"{self.file}: {text}")
        rows = {"edge": self.edges, "prior": self.priors, "sight": self.sights}[found[1]]
        return InputError(f"{self.file}:{rows.lines[int(found[2])]}: {text}")


def _check_unique(file: Path, names: Index) -> None:
    values, counts = np.unique(names, return_counts=True)
    if (counts > 1).any():
        name = values[np.argmax(counts > 1)]
        raise InputError(f"{file}: cannot be written: two vertices have the name {name}")


def _known(file: Path, what: str, ids: Index, numbers: Array, tied: Index) -> Rows:
    """Return the vertices: all of them, or none where none is known and edges name them all."""
    unknown = np.isnan(numbers).any(axis=1)
    if not unknown.any():
        return Rows.of(ids, numbers)
    lost = ids[unknown] if not unknown.all() else np.setdiff1d(ids, tied)
    if len(lost):
        raise InputError(
            f"{file}: cannot be written: the {what} of vertex {lost[0]} is not known: solve first"
        )
    return Rows.of(ids[:0], numbers[:0])


def _shape(group: Group) -> tuple[int, int]:
    m = GROUPS[group].space + 1
    return m, m


def _numbers(group: Group, Ts: Array, information: Array) -> Array:
    return np.column_stack([numbers_from_poses(Ts, group), upper_triangles(information)])
