"""Surfaces: points with normals and colours, and triangles between them.

A surface without triangles is a cloud. `extract` finds the zero of a field of signed distances
(`surface_kernels`) and leaves out pieces that hang loose: a piece is what triangles connect, and
one with less area than some faces of voxels is noise of the depth.

Cost: 0.2 µs per voxel of blocks with a surface; a room at 2 cm takes about a second.

Reference: S. F. F. Gibson, "Constrained elastic surface nets: generating smooth surfaces from
binary segmented data", MICCAI 1998.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError

__all__ = ["Surface", "extract"]

F32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False, repr=False)
class Surface:
    """Points in the world, and triangles between them.

    Attributes:
        points: (N, 3) float32, metres.
        normals: (N, 3) float32 unit vectors towards the free side, or None.
        colours: (N, 3) uint8 RGB, or None.
        faces: (M, 3) int32 rows of points, counter-clockwise seen from the free side.

    Raises:
        InputError: arrays that do not fit together.
    """

    points: F32
    normals: F32 | None = None
    colours: NDArray[np.uint8] | None = None
    faces: NDArray[np.int32] = field(default_factory=lambda: np.zeros((0, 3), np.int32))

    def __post_init__(self) -> None:
        count = len(self.points)
        for name, array in (
            ("points", self.points),
            ("normals", self.normals),
            ("colours", self.colours),
        ):
            if array is not None and array.shape != (count, 3):
                raise InputError(f"{name}: have shape {array.shape}, give ({count}, 3)")
        if self.faces.ndim != 2 or self.faces.shape[1] != 3:
            raise InputError(f"faces: have shape {self.faces.shape}, give (M, 3)")
        if len(self.faces) and not 0 <= self.faces.min() <= self.faces.max() < count:
            raise InputError(f"faces: name points that are not among the {count}")

    def __repr__(self) -> str:
        return f"Surface({len(self.points)} points, {len(self.faces)} triangles)"

    def extent(self) -> NDArray[np.float64]:
        """Return (3,) how far it reaches along each axis, metres."""
        if not len(self.points):
            return np.zeros(3)
        return np.asarray(np.ptp(self.points.astype(np.float64), axis=0))

    def cloud(self) -> "Surface":
        """Return the points alone."""
        return Surface(self.points, self.normals, self.colours)

    def areas(self) -> NDArray[np.float64]:
        """Return (M,) areas of the triangles, m²."""
        a, b, c = (self.points[self.faces[:, k]].astype(np.float64) for k in range(3))
        return np.asarray(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1))


def extract(
    slots: NDArray[np.int64], coords: NDArray[np.int64], distances: F32, weights: F32,
    colours: NDArray[np.uint16], views: NDArray[np.uint8], voxel: float, min_views: int,
    min_area_voxels: float,
) -> Surface:  # fmt: skip
    """Return the surface where the signed distances of a hashed grid are zero.

    Args:
        slots: the table of the hash.
        coords: (B, 3) places of the blocks.
        distances: (B, 512) metres.
        weights: (B, 512), 0 where nothing is known.
        colours: (B, 512, 3) in 1/256 of a grey level.
        views: (B, 512) images that saw a surface near the voxel.
        voxel: metres.
        min_views: least of them at one corner of a cell.
        min_area_voxels: least area of a loose piece, in faces of voxels.
    """
    from odomap.maps.surface_kernels import quads_kernel, vertices_kernel

    grid = slots, coords, distances, weights
    shape = np.array([voxel, 2.0 * voxel, float(min_views)])
    index = np.empty((len(coords), 512), np.int32)
    count = 0
    for fill in (False, True):  # how many there are is known after the first time
        points, normals = np.empty((count, 3), np.float32), np.empty((count, 3), np.float32)
        rgb = np.empty((count, 3), np.uint8)
        count = vertices_kernel(*grid, colours, views, shape, index, fill, points, normals, rgb)
    count = 0
    for fill in (False, True):
        faces = np.empty((count, 3), np.int32)
        count = quads_kernel(*grid, shape[1], index, points, fill, faces)
    return without_loose(Surface(points, normals, rgb, faces), min_area_voxels * voxel * voxel)


def without_loose(surface: Surface, min_area: float) -> Surface:
    """Return a surface without pieces of less than `min_area` m², and without points of no face."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    count, faces = len(surface.points), surface.faces
    if not len(faces):
        return Surface(surface.points[:0], *_chosen(surface, np.zeros(count, np.bool_)))
    ends = np.concatenate([faces[:, :2], faces[:, 1:]])
    links = coo_array((np.ones(len(ends), np.int8), (ends[:, 0], ends[:, 1])), (count, count))
    pieces, piece = connected_components(links, directed=False)
    area = np.bincount(piece[faces[:, 0]], surface.areas(), pieces)
    kept_faces = faces[area[piece[faces[:, 0]]] >= min_area]
    kept = np.zeros(count, np.bool_)
    kept[kept_faces.ravel()] = True
    number = np.cumsum(kept, dtype=np.int32) - np.int32(1)
    return Surface(surface.points[kept], *_chosen(surface, kept), number[kept_faces])


def _chosen(
    surface: Surface, rows: NDArray[np.bool_]
) -> tuple[F32 | None, NDArray[np.uint8] | None]:
    normals, colours = surface.normals, surface.colours
    return (
        None if normals is None else normals[rows],
        None if colours is None else colours[rows],
    )
