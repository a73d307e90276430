"""The cloud of a map: what a 3D LiDAR saw from all keyframes, in one frame.

Keyframes keep their sweeps as seen from where they were; where that is, the map says. So the cloud
of everything is made anew with the path as it is known by now,

    p_world = T_world_body T_body_lidar p,

one point for each voxel, the first that fell into it, so that ground driven over twice is not twice
as dense. Of a map in pieces, whose places to each other are not known, the largest is shown.

Reference: R. B. Rusu, S. Cousins, "3D is here: Point Cloud Library (PCL)", ICRA 2011.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.lidar.voxels import first_in_voxels
from odomap.maps.atlas import Atlas
from odomap.maps.map import Map
from odomap.sensors.rig import Rig

__all__ = ["CloudMap", "cloud_of_map"]

Array = NDArray[np.float64]

VOXEL = 0.2
"""Side of the voxels of which one point each is kept, metres."""


@dataclass(frozen=True, eq=False)
class CloudMap:
    """A cloud, and the path that it was seen from.

    Attributes:
        points: (N, 3) in the world.
        intensities: (N,) float32 how strongly they returned.
        path: (K, 3) where the keyframes are, in order.
        notes: what a person should know, one sentence each.
    """

    points: Array
    intensities: NDArray[np.float32]
    path: Array
    notes: tuple[str, ...] = ()

    def columns(self) -> dict[str, NDArray[np.float32]]:
        """Return what a file of points holds: x, y, z and intensity."""
        x, y, z = self.points.astype(np.float32).T
        return {"x": x, "y": y, "z": z, "intensity": self.intensities}


def cloud_of_map(map: Map, rig: Rig, voxel: float = VOXEL) -> CloudMap:
    """Make the cloud of a map from its keyframes, at their poses of now.

    Args:
        map: what is remembered.
        rig: the sensors it was made with.
        voxel: side of the voxels of which one point each is kept, metres.

    Raises:
        InputError: no keyframe has a cloud, or the rig has no 3D LiDAR.
    """
    mount = next((mount for mount in rig.lidars if mount.angles[2] == 0), None)
    if mount is None:
        raise InputError("the rig has no 3D LiDAR, of which the map could hold what it saw")
    if not voxel > 0.0:
        raise InputError(f"voxel: {voxel} must be above 0")
    pieces = Atlas(map).pieces
    largest = max(pieces, key=lambda piece: len(piece.keyframe_ids), default=None)
    with map.lock:
        ids = map.keyframe_ids
        if largest is not None:
            ids = ids[np.isin(ids, largest.keyframe_ids)]
        Ts = np.asarray(map.Ts_world_body(ids)) if len(ids) else np.zeros((0, 4, 4))
        clouds = [map.keyframe(k).cloud for k in ids.tolist()]
    parts = []
    for T, cloud in zip(Ts @ mount.T_body_lidar.matrix, clouds, strict=True):
        if cloud is not None and len(cloud):
            seen = np.zeros((len(cloud), 4))
            seen[:, : cloud.shape[1]] = cloud
            seen[:, :3] = seen[:, :3] @ T[:3, :3].T + T[:3, 3]
            parts.append(seen[first_in_voxels(seen[:, :3], voxel)])
    if not parts:
        raise InputError("the map holds no clouds: these are of a 3D LiDAR")
    points = np.concatenate(parts)
    points = points[first_in_voxels(np.ascontiguousarray(points[:, :3]), voxel)]
    notes: tuple[str, ...] = ()
    if len(pieces) > 1:
        share = len(ids) / map.num_keyframes
        notes = (f"the map is in {len(pieces)} pieces: {share:.0%} of it are shown",)
    return CloudMap(points[:, :3], points[:, 3].astype(np.float32), Ts[:, :3, 3], notes)
