"""Truncated signed distances: many noisy depth images become one surface.

Every voxel near a surface holds D, the mean of its signed distances to the surfaces that depth
images saw, each cut at a band of a few voxels and weighted by how well it was measured. For
distances with Gaussian noise that mean is the least-squares surface: its zero is where the images
agree, and noise falls with the root of their number (Curless and Levoy). Room that is seen through
pulls D up again, so that what was measured wrongly or moved away fades.

Voxels live in blocks of 8³ (`tsdf_kernels`), made where a depth says that there is a surface. A
voxel takes 19 bytes, a block 10 kB: a room at 2 cm some 60 MB. The memory has a limit, reached with
an error and a mend, not with a machine that swaps.

Cost: 30 ms for a 640x480 image at 2 cm. Images in the same order give the same bytes.

Reference: B. Curless, M. Levoy, "A volumetric method for building complex models from range
images", SIGGRAPH 1996; M. Nießner, M. Zollhöfer, S. Izadi, M. Stamminger, "Real-time 3D
reconstruction at scale using voxel hashing", SIGGRAPH Asia 2013.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.geometry.camera import Camera
from odomap.geometry.pose import SE3
from odomap.maps.surface import Surface, extract

__all__ = ["Tsdf", "TsdfConfig", "TsdfFull"]

BLOCK_BYTES = 8**3 * 19 + 24 + 8 * 4
"""Of a block: voxels, place, entries of the table."""


class TsdfFull(InputError):
    """The surface needs more memory than allowed."""


@dataclass(frozen=True)
class TsdfConfig:
    """How depth images are fused."""

    voxel: float = 0.02
    """Side of a voxel, metres."""
    band_voxels: float = 4.0
    """Distances are cut at this many voxels."""
    near: float = 0.1
    """Depths below are not used, metres."""
    max_depth: float = 4.0
    """Depths beyond are not used, metres."""
    jump: float = 0.04
    """A pixel whose depth differs from a neighbour's by more than this share of it hangs in the air
    between two surfaces, and is dropped."""
    most_weight: float = 1000.0
    """A voxel's weight stops growing here; one look at 1 metre, square on, weighs 1."""
    free_weight: float = 0.5
    """Weight of seeing through a voxel, as a share of seeing a surface there."""
    memory_mb: float = 1500.0
    """Most memory for voxels."""

    def __post_init__(self) -> None:
        for name in ("voxel", "band_voxels", "near", "max_depth", "jump", "memory_mb"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise InputError(f"{name}: {value} must be above 0")
        if self.max_depth <= self.near:
            raise InputError(f"max_depth: {self.max_depth:g} m must be above {self.near:g} m")

    @property
    def band(self) -> float:
        """Largest distance kept, metres."""
        return self.band_voxels * self.voxel


class Tsdf:
    """A surface in the making.

    Args:
        config: voxel size, reach, memory.

    Attributes:
        config: the same.
        num_views: images fused so far.
        num_blocks: blocks of 8³ voxels.

    Example:
        >>> camera = Camera(intrinsics=(60.0, 60.0, 31.5, 23.5), resolution=(64, 48))
        >>> tsdf = Tsdf(TsdfConfig(voxel=0.05))
        >>> tsdf.integrate(np.full((48, 64), 2.0, np.float32), None, camera, SE3.identity())
        >>> wall = tsdf.surface()
        >>> bool(np.all(np.abs(wall.points[:, 2] - 2.0) < 1e-4))
        True
    """

    def __init__(self, config: TsdfConfig = TsdfConfig()) -> None:
        self.config = config
        self.num_views = 0
        self.num_blocks = 0
        self._slots = np.full(2, -1, np.int64)
        self._coords = np.zeros((0, 3), np.int64)
        self._distances = np.zeros((0, 512), np.float32)
        self._weights = np.zeros((0, 512), np.float32)
        self._colours = np.zeros((0, 512, 3), np.uint16)
        self._views = np.zeros((0, 512), np.uint8)
        self._grow(1024)

    @property
    def memory_mb(self) -> float:
        """Memory of the blocks in use, MB."""
        return self.num_blocks * BLOCK_BYTES / 1e6

    def integrate(
        self,
        depth: NDArray[np.float32],
        colour: NDArray[np.uint8] | None,
        camera: Camera,
        T_world_camera: SE3,
    ) -> None:
        """Fuse one depth image.

        Args:
            depth: (H, W) metres along the optical axis; 0, negative, NaN or infinite where unknown.
            colour: (H, W) grey or (H, W, 3) RGB of the same pixels, or None for grey.
            camera: its pinhole, without distortion.
            T_world_camera: where it was.

        Raises:
            InputError: sizes that do not fit, or a lens with distortion.
            TsdfFull: the blocks would need more than `memory_mb`.
        """
        from odomap.maps import tsdf_depth, tsdf_kernels

        c = self.config
        _check(depth, colour, camera)
        pinhole = np.array(camera.intrinsics)
        depth = np.ascontiguousarray(depth, np.float32)
        clean = np.empty_like(depth)
        tsdf_depth.clean_kernel(depth, c.near, c.max_depth, c.jump, clean)
        height, width = clean.shape
        slants = np.empty((-(-height // tsdf_depth.CELL), -(-width // tsdf_depth.CELL)), np.float32)
        tsdf_depth.slant_kernel(clean, pinhole, c.jump, slants)
        tiles = np.empty(
            (-(-height // tsdf_kernels.TILE), -(-width // tsdf_kernels.TILE)), np.float32
        )
        tsdf_depth.tile_kernel(clean, tsdf_kernels.TILE, tiles)
        shape = np.array([c.voxel, c.band, c.jump, c.most_weight, c.free_weight])
        T = np.ascontiguousarray(T_world_camera.matrix)
        self._enter(clean, pinhole, T, shape)
        tsdf_kernels.integrate_kernel(
            clean, slants, tiles, _rgb(colour, clean.shape), pinhole,
            np.ascontiguousarray(T_world_camera.inverse().matrix), shape, self._coords,
            self.num_blocks, self._distances, self._weights, self._colours, self._views,
        )  # fmt: skip
        self.num_views += 1

    def surface(self, min_views: int = 1, min_area_voxels: float = 100.0) -> Surface:
        """Return the surface as triangles, with normals and colours.

        Args:
            min_views: how many images must have seen a place.
            min_area_voxels: pieces that hang loose and have less area than this many faces of
                voxels are left out.

        Returns:
            Triangles turned counter-clockwise towards the free side.
        """
        n = self.num_blocks
        return extract(
            self._slots, self._coords[:n], self._distances[:n], self._weights[:n],
            self._colours[:n], self._views[:n], self.config.voxel, min_views, min_area_voxels,
        )  # fmt: skip

    def _enter(
        self, depth: NDArray[np.float32], pinhole: NDArray[np.float64], T: NDArray[np.float64],
        shape: NDArray[np.float64],
    ) -> None:  # fmt: skip
        """Make the blocks that this image needs, with more room as often as it takes."""
        from odomap.maps.tsdf_kernels import SIDE, enter_kernel

        c = self.config
        spacing = c.max_depth / float(pinhole[:2].min())
        stride = int(np.clip(0.25 * SIDE * c.voxel / spacing, 1, 4))
        while True:
            room = len(self._coords)
            count = enter_kernel(
                depth, pinhole, T, shape, stride, self._slots, self._coords, self.num_blocks, room
            )
            if count >= 0:
                self.num_blocks = count
                return
            self.num_blocks = room
            self._grow(2 * room)

    def _grow(self, blocks: int) -> None:
        """Make room for so many blocks, or as many as memory allows."""
        from odomap.maps.tsdf_kernels import rehash_kernel

        most = int(self.config.memory_mb * 1e6 / BLOCK_BYTES)
        if len(self._coords) >= most:
            raise TsdfFull(
                f"voxels of {self.config.voxel:g} m need more than {self.config.memory_mb:g} MB: "
                f"use larger ones (--voxel {2 * self.config.voxel:g}) or less depth (--max-depth)"
            )
        size = min(blocks, most)
        old = self._coords, self._distances, self._weights, self._colours, self._views
        self._coords, self._distances, self._weights, self._colours, self._views = (
            _longer(array, size) for array in old
        )
        # At most half full, so that probing stays short.
        self._slots = np.full(1 << (2 * size - 1).bit_length(), -1, np.int64)
        rehash_kernel(self._slots, self._coords, self.num_blocks)


def _longer(array: NDArray[Any], size: int) -> NDArray[Any]:
    out = np.zeros((size, *array.shape[1:]), array.dtype)
    out[: len(array)] = array
    return out


def _check(depth: NDArray[np.float32], colour: NDArray[np.uint8] | None, camera: Camera) -> None:
    """Raise an InputError unless the images are the camera's."""
    size = (camera.height, camera.width)
    if depth.shape != size:
        found = "x".join(map(str, depth.shape[::-1]))
        raise InputError(f"depth: is {found} pixels, its camera {camera.width}x{camera.height}")
    if colour is not None and (colour.shape[:2] != size or colour.shape[2:] not in ((), (3,))):
        raise InputError(f"colour: has shape {colour.shape}, depth {depth.shape}: give (H, W[, 3])")
    if camera.model != "pinhole" or np.any(camera.distortion):
        raise InputError("camera: depth is fused through a pinhole without distortion")


def _rgb(colour: NDArray[np.uint8] | None, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    if colour is None:
        return np.full((*shape, 3), 160, np.uint8)
    if colour.ndim == 2:
        colour = np.broadcast_to(colour[:, :, None], (*shape, 3))
    return np.ascontiguousarray(colour, np.uint8)
