"""Pose graphs as TORO text, the format before g2o.

    VERTEX2 id  x y θ                   EDGE2 i j  x y θ  I11 I12 I22 I33 I13 I23
    VERTEX3 id  x y z roll pitch yaw    EDGE3 i j  x y z roll pitch yaw  I11 I12 ... I66

In the plane the entries of the information come in an order of their own; in space they are the
upper triangle, row by row. R = Rz(yaw) Ry(pitch) Rx(roll), and I is taken as it stands, as that of
(translation, rotation). TORO knows poses and edges, no more: nodes held, priors, landmarks and
Sim3 go into g2o files. Plain or gzip; what was read is written and read again bit for bit.

Reference: G. Grisetti, C. Stachniss, W. Burgard, "Nonlinear constraint network optimization for
efficient map learning", IEEE Transactions on Intelligent Transportation Systems 10(3), 2009.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from odomap.backend.graphs.posegraph import PoseGraph
from odomap.errors import InputError
from odomap.files.g2o import G2O, ROLES, write_rows
from odomap.files.graphlines import Array, Layout, Lines, Rows, parse_lines
from odomap.files.graphparts import Parts
from odomap.files.graphposes import euler_from_rotation, rotation_from_euler
from odomap.files.text import read_text
from odomap.geometry.lie import quaternion_from_rotation, rotation_from_quaternion

__all__ = ["TORO", "check_toro", "parts_of_toro", "read_toro", "write_toro"]

TORO: Mapping[str, Layout] = MappingProxyType(
    {
        "VERTEX2": Layout(1, 3),
        "VERTEX3": Layout(1, 6),
        "EDGE2": Layout(2, 3 + 6),
        "EDGE3": Layout(2, 6 + 21),
    }
)
"""What follows each tag."""

ORDER_2D = (0, 1, 4, 2, 5, 3)
"""Where I11 I12 I13 I22 I23 I33 stand among TORO's entries."""


def read_toro(path: str | Path, *, skip_unknown: bool = False) -> PoseGraph:
    """Read a pose graph from TORO text.

    Args:
        path: the file, plain or gzip.
        skip_unknown: whether lines of unknown tags are passed over; else they are an error.

    Returns:
        The graph; poses are NaN where the file declares no vertex.

    Raises:
        InputError: names the file and the line of what is wrong.
    """
    file = Path(path)
    return parts_of_toro(parse_lines(file, read_text(file), TORO, skip_unknown)).graph()


def write_toro(path: str | Path, graph: PoseGraph) -> None:
    """Write a pose graph as TORO text; the same graph gives the same bytes.

    Args:
        path: the file; gzipped if it ends in `.gz`.
        graph: SE2 or SE3, with nodes and edges only.

    Raises:
        InputError: the graph holds what TORO cannot say.
        OutputError: it cannot be written.
    """
    file = Path(path)
    check_toro(file, graph)
    parts = Parts.of(file, graph)
    if graph.group == "SE2":
        inverse = [*range(3), *(3 + np.argsort(ORDER_2D))]
        edges = replace(parts.edges, numbers=parts.edges.numbers[:, inverse])
        write_rows(file, [("VERTEX2", parts.nodes), ("EDGE2", edges)])
    else:
        blocks = [("VERTEX3", parts.nodes), ("EDGE3", parts.edges)]
        write_rows(file, [(tag, _with_euler(rows)) for tag, rows in blocks])


def check_toro(file: Path, graph: PoseGraph) -> None:
    """Raise if a graph holds what a TORO file cannot say."""
    extra = {
        "nodes that are held": bool(graph.is_fixed.any()),
        "priors": bool(len(graph.priors.node)),
        "landmarks": bool(len(graph.points.ids)),
        "scales": graph.group == "Sim3",
    }
    for what, there in extra.items():
        if there:
            raise InputError(f"{file}: TORO files have no {what}: write a .g2o file")


def parts_of_toro(lines: Lines) -> Parts:
    """Sort the lines of a TORO file into the parts of a graph.

    Raises:
        InputError: lines of the plane and of space.
    """
    tags = list(lines.rows)
    mixed = [tag for tag in tags if tag[-1] != tags[0][-1]]
    if mixed:
        line = lines.rows[mixed[0]].lines[0]
        raise InputError(
            f"{lines.file}:{line}: {mixed[0]} does not go with the {tags[0]} before it: "
            "a graph is 2D or 3D, not a mixture"
        )
    flat = not tags or tags[0][-1] == "2"
    nodes, edges = (lines.get(tag, TORO[tag]) for tag in _tags(flat))
    if flat:
        columns = [*range(3), *(3 + k for k in ORDER_2D)]
        edges = replace(edges, numbers=edges.numbers[:, columns])
    else:
        nodes, edges = _with_quaternion(nodes), _with_quaternion(edges)
    _, _, prior, landmark, sight = ROLES["SE2" if flat else "SE3"]
    none = [
        Rows.none(Layout(ids, G2O[tag].numbers))
        for ids, tag in ((1, prior), (1, landmark), (2, sight), (1, "FIX"))
    ]
    return Parts(lines.file, "SE2" if flat else "SE3", nodes, edges, *none)


def _tags(flat: bool) -> tuple[str, str]:
    return ("VERTEX2", "EDGE2") if flat else ("VERTEX3", "EDGE3")


def _with_quaternion(rows: Rows) -> Rows:
    """Return rows x y z qx qy qz qw ... for rows x y z roll pitch yaw ..."""
    wxyz = quaternion_from_rotation(rotation_from_euler(rows.numbers[:, 3:6]))
    return _turned(rows, wxyz[:, [1, 2, 3, 0]], 6)


def _with_euler(rows: Rows) -> Rows:
    """Return rows x y z roll pitch yaw ... for rows x y z qx qy qz qw ..."""
    wxyz = rows.numbers[:, [6, 3, 4, 5]]
    return _turned(rows, euler_from_rotation(rotation_from_quaternion(wxyz)), 7)


def _turned(rows: Rows, rotation: Array, rest: int) -> Rows:
    columns = [rows.numbers[:, :3], rotation, rows.numbers[:, rest:]]
    return replace(rows, numbers=np.concatenate(columns, axis=1))
