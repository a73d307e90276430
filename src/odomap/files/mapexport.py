"""What other programs want of a map: its landmarks, its keyframes, its graph.

    landmarks  points in the world as PLY        p_world = S_anchor p_anchor
    keyframes  T_world_body by stamp as TUM text
    graph      keyframes and the edges between them as g2o

Edges are those that were measured. A keyframe that no measured edge ties to its parent in the
spanning tree is tied to it by where both are, with unit information: odometry keeps no edges, and a
graph in pieces is of no use. Only the pieces of a map that are apart (`maps/atlas`) stay so. Where
keyframes have scales of their own the graph is one of similarities: S_k = [s R, t] and S_i_j =
[s R, t].

Reference: G. Grisetti, R. Kümmerle, C. Stachniss, W. Burgard, "A tutorial on graph-based SLAM",
IEEE Intelligent Transportation Systems Magazine 2(4), 2010.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from odomap.backend.graphs.posegraph import PoseGraph
from odomap.errors import InputError
from odomap.files.clouds import write_ply
from odomap.files.g2o import write_g2o
from odomap.files.trajectories import write_tum
from odomap.geometry.trajectory import Trajectory
from odomap.maps.atlas import beginnings
from odomap.maps.edges import GAP, EdgeTable
from odomap.maps.map import Map
from odomap.maps.states import compose, inverse
from odomap.maps.surface import Surface

__all__ = ["keyframe_trajectory", "landmark_cloud", "map_graph", "write_map_parts"]

Array = NDArray[np.float64]


def landmark_cloud(map: Map) -> Surface:
    """Return the landmarks of a map as a cloud in the world, by id."""
    return Surface(map.points_world(map.landmark_ids).astype(np.float32))


def keyframe_trajectory(map: Map) -> Trajectory:
    """Return the poses of the living keyframes by stamp; of those with one stamp the first."""
    with map.lock:
        ids = map.keyframe_ids
        stamps = np.array([map.keyframe(k).stamp_ns for k in ids.tolist()], np.int64)
        _, first = np.unique(stamps, return_index=True)
        return Trajectory(stamps[first], map.Ts_world_body(ids[first]))


def map_graph(map: Map) -> tuple[PoseGraph, int]:
    """Return the pose graph of a map, and how many of its edges were not measured.

    Nodes are the living keyframes and the culled ones that an edge names; the root of the spanning
    tree is held. Across a gap there is no edge.
    """
    with map.lock:
        alive, edges, begins = map.keyframe_ids, _measured(map.edges()), beginnings(map)
        ids = np.unique(np.concatenate([alive, edges.i, edges.j]))
        Ts = map.Ts_world_body(ids)
        scales = np.array([map.scale(k) for k in ids.tolist()])
        parents = np.array([map.parent(k) for k in ids.tolist()], np.int64)
    tied = {frozenset(pair) for pair in zip(edges.i.tolist(), edges.j.tolist())}
    child = np.array(
        [p >= 0 and frozenset((k, p)) not in tied for k, p in zip(ids.tolist(), parents.tolist())],
        np.bool_,
    )
    child &= ~np.isin(ids, begins)
    row, holder = np.flatnonzero(child), np.searchsorted(ids, parents[child])
    links = compose(inverse((Ts[holder], scales[holder])), (Ts[row], scales[row]))
    is_rigid = bool((scales == 1.0).all() and (edges.scales_i_j == 1.0).all())
    k = 6 if is_rigid else 7
    information = np.zeros((len(edges.i) + len(row), k, k))
    information[:, range(k), range(k)] = 1.0
    information[: len(edges.i), :6, :6] = edges.information
    graph = PoseGraph(
        "SE3" if is_rigid else "Sim3",
        _matrices(Ts, scales),
        np.concatenate([np.searchsorted(ids, edges.i), holder]),
        np.concatenate([np.searchsorted(ids, edges.j), row]),
        np.concatenate([_matrices(edges.Ts_i_j, edges.scales_i_j), _matrices(*links)]),
        information,
        ids=ids,
        is_fixed=parents == -1,
    )
    return graph, len(row)


def _measured(edges: EdgeTable) -> EdgeTable:
    """Return the edges that are none across a gap."""
    keep = np.array(edges.kind, str) != GAP
    return EdgeTable(
        edges.i[keep],
        edges.j[keep],
        edges.Ts_i_j[keep],
        edges.scales_i_j[keep],
        edges.information[keep],
        tuple(kind for kind in edges.kind if kind != GAP),
    )


def _matrices(Ts: Array, scales: Array) -> Array:
    matrices = Ts.copy()
    matrices[:, :3, :3] *= scales[:, None, None]
    return matrices


def write_map_parts(
    map: Map,
    points: str | Path | None = None,
    trajectory: str | Path | None = None,
    graph: str | Path | None = None,
) -> list[str]:
    """Write parts of a map for other programs.

    Args:
        map: what is remembered.
        points: PLY file for the landmarks.
        trajectory: TUM file for the keyframes.
        graph: g2o file for keyframes and edges.

    Returns:
        What was written, a line each: the file, and what is in it.

    Raises:
        InputError: there is nothing to write, or a measured edge is none that a graph may have.
        OutputError: a file cannot be written.
    """
    if map.num_keyframes == 0:
        raise InputError("the map is empty: there is nothing to export")
    said = []
    if points is not None:
        write_ply(points, cloud := landmark_cloud(map))
        said.append(f"{points}: {len(cloud.points)} landmarks")
    if trajectory is not None:
        write_tum(trajectory, path := keyframe_trajectory(map))
        said.append(f"{trajectory}: {len(path)} keyframes")
    if graph is not None:
        made, links = map_graph(map)
        write_g2o(graph, made)
        of_tree = f", {links} of them from the poses" if links else ""
        said.append(
            f"{graph}: {made.num_nodes} poses ({made.group}), {made.num_edges} edges{of_tree}"
        )
    return said
