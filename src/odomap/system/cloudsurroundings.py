"""What a map has around a body: clouds of keyframes near by, for a front-end to match with.

A body that was recognised in a map goes on there with what the map has seen around,

    { T_world_k T_body_lidar cloud_k :  |t_k - t_body| ≤ reach },

as the world has it now. One that is only placed, and adds nothing, gets new surroundings when it
has left the middle of these.

Reference: K. Koide, J. Miura, E. Menegatti, "A portable three-dimensional LiDAR-based system for
long-term and wide-area people behavior measurement", IJARS 16(2), 2019 (placing in a cloud map).
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from odomap.lidar.frontend import FrontEnd
from odomap.maps.map import Map
from odomap.system.cloudconfig import CloudTrackingConfig

__all__ = ["Surroundings"]

Array = NDArray[np.float64]


class Surroundings:
    """Fills a front-end with what a map has around a body.

    Args:
        map: keyframes with clouds.
        T_body_lidar: (4, 4) where the LiDAR is on the body.
        config: how far around.
    """

    def __init__(self, map: Map, T_body_lidar: Array, config: CloudTrackingConfig) -> None:
        self._map, self._T_body_lidar, self._config = map, np.array(T_body_lidar), config
        self._middle = np.full(3, np.inf)

    def is_left(self, T_world_body: Array) -> bool:
        """Say whether a body has left the middle of what is around it."""
        off = float(np.linalg.norm(T_world_body[:3, 3] - self._middle))
        return not off <= self._config.left

    def surround(self, front_end: FrontEnd[Any], T_world_body: Array) -> int:
        """Add what is around a body at (4, 4) to a front-end; return the nearest keyframe."""
        self._middle = np.array(T_world_body[:3, 3])
        ids = self._map.keyframe_ids
        Ts = self._map.Ts_world_body(ids)
        away = np.linalg.norm(Ts[:, :3, 3] - self._middle, axis=1)
        for row in np.flatnonzero(away <= self._config.around):
            cloud = self._map.keyframe(int(ids[row])).cloud
            if cloud is not None:
                T = Ts[row] @ self._T_body_lidar
                front_end.seed(cloud[:, :3].astype(np.float64) @ T[:3, :3].T + T[:3, 3])
        return int(ids[np.argmin(away)])
