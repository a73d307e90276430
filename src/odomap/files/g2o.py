"""Pose graphs as g2o text, the format that every solver reads.

    VERTEX_SE2 id  x y θ                         EDGE_SE2 i j  x y θ  I
    VERTEX_SE3:QUAT id  x y z qx qy qz qw        EDGE_SE3:QUAT i j  x y z qx qy qz qw  I
    VERTEX_SIM3:QUAT id  x y z qx qy qz qw s     EDGE_SIM3:QUAT i j  ... s  I
    VERTEX_XY, VERTEX_TRACKXYZ id  point         EDGE_SE2_XY, EDGE_SE3_TRACKXYZ i l [o]  point  I
    EDGE_PRIOR_SE2, EDGE_SE3_PRIOR i [o]  pose  I          FIX id; PARAMS_SE3OFFSET o  pose

I is the upper triangle of the information, row by row, in the order (translation, rotation[, log
scale]), taken as it stands in the file; o names where a sensor sits on the pose: what it measured
is brought to the pose (`graphoffsets`). Poses are on the grid of `graphposes` and numbers are
written so that they read back exactly: what was read is written and read again bit for bit. Plain
or gzip. The Sim3 tags are odomap's own.

Reference: R. Kümmerle, G. Grisetti, H. Strasdat, K. Konolige, W. Burgard, "g2o: A general framework
for graph optimization", ICRA 2011.
"""

import gzip
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from odomap.backend.graphs.posegraph import Group, PoseGraph
from odomap.errors import InputError
from odomap.files.atomic import write_bytes
from odomap.files.graphlines import Layout, Lines, Rows, parse_lines
from odomap.files.graphoffsets import priors_at_node, sights_at_node
from odomap.files.graphparts import Parts
from odomap.files.text import read_text

__all__ = ["G2O", "parts_of_g2o", "read_g2o", "write_g2o", "write_rows"]

G2O: Mapping[str, Layout] = MappingProxyType(
    {
        "VERTEX_SE2": Layout(1, 3),
        "VERTEX_SE3:QUAT": Layout(1, 7),
        "VERTEX_SIM3:QUAT": Layout(1, 8),
        "VERTEX_XY": Layout(1, 2),
        "VERTEX_TRACKXYZ": Layout(1, 3),
        "FIX": Layout(-1, 0),
        "PARAMS_SE3OFFSET": Layout(1, 7),
        "EDGE_PRIOR_SE2": Layout(1, 3 + 6),
        "EDGE_SE3_PRIOR": Layout(2, 7 + 21),
        "EDGE_SIM3_PRIOR": Layout(1, 8 + 28),
        "EDGE_SE2": Layout(2, 3 + 6),
        "EDGE_SE3:QUAT": Layout(2, 7 + 21),
        "EDGE_SIM3:QUAT": Layout(2, 8 + 28),
        "EDGE_SE2_XY": Layout(2, 2 + 3),
        "EDGE_SE3_TRACKXYZ": Layout(3, 3 + 6),
    }
)
"""What follows each tag."""

ROLES: Mapping[str, tuple[str, str, str, str, str]] = MappingProxyType(
    {
        "SE2": ("VERTEX_SE2", "EDGE_SE2", "EDGE_PRIOR_SE2", "VERTEX_XY", "EDGE_SE2_XY"),
        "SE3": (
            "VERTEX_SE3:QUAT",
            "EDGE_SE3:QUAT",
            "EDGE_SE3_PRIOR",
            "VERTEX_TRACKXYZ",
            "EDGE_SE3_TRACKXYZ",
        ),
        "Sim3": (
            "VERTEX_SIM3:QUAT",
            "EDGE_SIM3:QUAT",
            "EDGE_SIM3_PRIOR",
            "VERTEX_TRACKXYZ",
            "EDGE_SE3_TRACKXYZ",
        ),
    }
)
"""Tags of nodes, edges, priors, landmarks and sights in a graph of each group."""

NOT_MOVED = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def read_g2o(path: str | Path, *, skip_unknown: bool = False) -> PoseGraph:
    """Read a pose graph from g2o text.

    Args:
        path: the file, plain or gzip.
        skip_unknown: whether lines of unknown tags are passed over; else they are an error.

    Returns:
        The graph: nodes in the order of the file. Where it declares no vertex, those that edges
        name, in order of their names, with poses of NaN.

    Raises:
        InputError: names the file and the line of what is wrong.
    """
    file = Path(path)
    return parts_of_g2o(parse_lines(file, read_text(file), G2O, skip_unknown)).graph()


def write_g2o(path: str | Path, graph: PoseGraph) -> None:
    """Write a pose graph as g2o text; the same graph gives the same bytes.

    Args:
        path: the file; gzipped if it ends in `.gz`.
        graph: all poses known, or none; the same for landmarks.

    Raises:
        InputError: two vertices have one name, or poses are known in part.
        OutputError: it cannot be written.
    """
    file = Path(path)
    parts = Parts.of(file, graph)
    node, edge, prior, landmark, sight = ROLES[graph.group]
    beside = (parts.priors, G2O[prior].ids - 1), (parts.sights, G2O[sight].ids - 2)
    offsets = any(len(rows) for rows, count in beside if count)
    none = Rows.of(np.zeros(int(offsets), np.int64), np.array([NOT_MOVED] * int(offsets)))
    blocks = [
        ("PARAMS_SE3OFFSET", none),
        (node, parts.nodes),
        (landmark, parts.landmarks),
        ("FIX", parts.fixed),
        (prior, _with_offset(parts.priors, G2O[prior].ids)),
        (edge, parts.edges),
        (sight, _with_offset(parts.sights, G2O[sight].ids)),
    ]
    write_rows(file, blocks)


def write_rows(file: Path, blocks: list[tuple[str, Rows]]) -> None:
    """Write lines of tags, numbers so that they read back exactly; gzip if it ends in `.gz`."""
    data = "".join(line for tag, rows in blocks for line in _lines(tag, rows)).encode("ascii")
    write_bytes(file, gzip.compress(data, mtime=0) if file.suffix == ".gz" else data)


def _lines(tag: str, rows: Rows) -> Iterator[str]:
    for ids, numbers in zip(rows.ids.tolist(), rows.numbers.tolist()):
        yield " ".join([tag, *map(str, ids), *map(repr, numbers)]) + "\n"


def parts_of_g2o(lines: Lines) -> Parts:
    """Sort the lines of a g2o file into the parts of a graph.

    Raises:
        InputError: tags of two kinds of poses, or an offset that is not there.
    """
    group = _group(lines)
    node, edge, prior, landmark, sight = (lines.get(tag, G2O[tag]) for tag in ROLES[group])
    offsets = lines.get("PARAMS_SE3OFFSET", G2O["PARAMS_SE3OFFSET"])
    if G2O[ROLES[group][2]].ids == 2:
        prior = priors_at_node(lines.file, offsets, prior)
    if G2O[ROLES[group][4]].ids == 3:
        sight = sights_at_node(lines.file, offsets, sight)
    fixed = lines.get("FIX", G2O["FIX"])
    return Parts(lines.file, group, node, edge, prior, landmark, sight, fixed)


def _group(lines: Lines) -> Group:
    """Return the group that all tags belong to."""
    groups: tuple[Group, ...] = ("SE2", "SE3", "Sim3")
    possible, before = list(groups), ""
    for tag, rows in lines.rows.items():
        own = [g for g in groups if tag in ROLES[g] or (tag, g) == ("PARAMS_SE3OFFSET", "SE3")]
        own += ["Sim3"] if tag == "PARAMS_SE3OFFSET" else []
        if not own:
            continue
        both = [g for g in possible if g in own]
        if not both:
            raise InputError(
                f"{lines.file}:{rows.lines[0]}: {tag} does not go with the {before} before it: "
                "a graph is 2D, 3D or Sim3, not a mixture"
            )
        possible, before = both, tag
    return possible[0] if len(possible) < len(groups) else "SE2"


def _with_offset(rows: Rows, ids: int) -> Rows:
    """Return rows that name as many things as their tag wants: the offset 0 at the end."""
    missing = ids - rows.ids.shape[1]
    return replace(rows, ids=np.pad(rows.ids, ((0, 0), (0, missing))))
