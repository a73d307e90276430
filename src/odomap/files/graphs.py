"""Pose graphs from a file that is g2o or TORO: told apart by their tags.

The two formats share no tag, so that the first known one says what a file is, whatever its name.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from odomap.backend.graphs.posegraph import PoseGraph
from odomap.files.g2o import G2O, parts_of_g2o, write_g2o
from odomap.files.graphlines import parse_lines
from odomap.files.text import read_text
from odomap.files.toro import TORO, check_toro, parts_of_toro, write_toro

__all__ = ["GraphFile", "check_graph_file", "read_graph", "read_graph_file", "write_graph"]


@dataclass(frozen=True)
class GraphFile:
    """What a file holds.

    Attributes:
        graph: the pose graph.
        format: "g2o" or "toro".
        skipped: how many lines of each unknown tag were passed over.
    """

    graph: PoseGraph
    format: Literal["g2o", "toro"]
    skipped: Mapping[str, int]


def read_graph(path: str | Path, *, skip_unknown: bool = False) -> PoseGraph:
    """Read a pose graph from g2o or TORO text, plain or gzip; see `read_g2o`."""
    return read_graph_file(path, skip_unknown).graph


def read_graph_file(path: str | Path, skip_unknown: bool = False) -> GraphFile:
    """Read a pose graph, and say what kind of file it is and what was left out.

    Args:
        path: the file, plain or gzip.
        skip_unknown: whether lines of unknown tags are passed over; else they are an error.

    Raises:
        InputError: names the file and the line of what is wrong.
    """
    file = Path(path)
    text = read_text(file)
    if _is_toro(text):
        lines = parse_lines(file, text, TORO, skip_unknown)
        return GraphFile(parts_of_toro(lines).graph(), "toro", lines.skipped)
    lines = parse_lines(file, text, G2O, skip_unknown)
    return GraphFile(parts_of_g2o(lines).graph(), "g2o", lines.skipped)


def write_graph(path: str | Path, graph: PoseGraph) -> None:
    """Write a pose graph: TORO where the name ends in .toro or .graph (.gz), else g2o.

    Raises:
        InputError: the graph holds what the format cannot say.
        OutputError: it cannot be written.
    """
    file = Path(path)
    (write_toro if _is_toro_name(file) else write_g2o)(file, graph)


def check_graph_file(path: str | Path, graph: PoseGraph) -> None:
    """Raise if a file of that name cannot hold a graph, before it is solved."""
    if _is_toro_name(Path(path)):
        check_toro(Path(path), graph)


def _is_toro_name(file: Path) -> bool:
    suffix = Path(file.stem).suffix if file.suffix == ".gz" else file.suffix
    return suffix.lower() in (".toro", ".graph")


def _is_toro(text: str) -> bool:
    """Whether the first tag that is known is one of TORO's."""
    for line in text.split("\n"):
        tag = line.split(None, 1)[:1]
        if tag and (tag[0] in TORO or tag[0] in G2O):
            return tag[0] in TORO
    return False
