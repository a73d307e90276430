"""A street of boxes around a block, seen by a LiDAR: clouds at known poses, and maps."""

import numpy as np

from odomap.geometry.lie import se3_adjoint, se3_exp, se3_inverse
from odomap.lidar.voxels import into_cells, mean_points
from odomap.maps.edges import ODOMETRY
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map

SIDE, UP, FAR, VOXEL = 50.0, 1.7, 40.0, 0.4
STEP = np.array([0.004, 0.004, 0.004, 2e-4, 2e-4, 4e-4])
"""Standard deviations of a step of odometry."""


class Street:
    """A square road between houses, poles and hedges.

    Args:
        seed: which.
        beams: of the LiDAR.
    """

    def __init__(self, seed=0, beams=16):
        rng = np.random.default_rng([seed, 40])
        boxes = []
        for side in (-1.0, 1.0):
            along = 0.0
            while along < 4 * SIDE - 3:
                wide, deep = rng.uniform(4, 11), rng.uniform(4, 9)
                off = side * (rng.uniform(7, 10) + deep / 2)
                centre = self.at(along + wide / 2, off)
                half = np.array([wide, deep])[:: -1 if self.ahead(along + wide / 2)[0] == 0 else 1]
                tall = rng.uniform(0.8, 1.6) if rng.random() < 0.2 else rng.uniform(4, 10)
                boxes.append([*centre - half / 2, 0, *centre + half / 2, tall])
                along += wide + rng.choice([0.5, 2.0, 5.0])
            for along in np.cumsum(rng.uniform(4, 14, 20)):
                centre, thick = self.at(along, side * rng.uniform(5, 6)), rng.uniform(0.1, 0.5)
                boxes.append([*centre - thick, 0, *centre + thick, rng.uniform(2.5, 6)])
        self.boxes = np.array(boxes)
        azimuths = np.linspace(-np.pi, np.pi, 200, endpoint=False)
        e, a = np.meshgrid(np.radians(np.linspace(-18, 14, beams)), azimuths, indexing="ij")
        self.rays = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], -1)
        self.rays = self.rays.reshape(-1, 3)
        self.seen = {}

    @staticmethod
    def ahead(along):
        return np.array([[1, 0], [0, 1], [-1, 0], [0, -1]], float)[int(along // SIDE) % 4]

    def at(self, along, left=0.0):
        """Return a place (2,) beside the middle of the road, its corners at 0, SIDE, …"""
        ahead = self.ahead(along)
        corner = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])[int(along // SIDE) % 4] * SIDE
        return corner + ahead * (along % SIDE) + left * np.array([-ahead[1], ahead[0]])

    def pose(self, along, left, backwards=False, rng=None):
        """Return T_world_body (4, 4) of a vehicle there, swaying a little."""
        T, ahead = np.eye(4), self.ahead(along) * (-1 if backwards else 1)
        T[:2, :2] = [[ahead[0], -ahead[1]], [ahead[1], ahead[0]]]
        T[:3, 3] = *self.at(along, left), UP
        sway = np.zeros(6) if rng is None else rng.normal(0, [0, 0.1, 0.02, 0.01, 0.01, 0.03])
        return T @ se3_exp(sway)

    def drive(self, first, last, left=-1.75, seed=0):
        """Return poses every 2.5 m from one distance along the road to another, either way."""
        rng, backwards = np.random.default_rng([seed, 41]), last < first
        alongs = np.arange(first, last, -2.5 if backwards else 2.5)
        return np.array([self.pose(along, left, backwards, rng) for along in alongs])

    def cloud(self, T_world_lidar, seed):
        """Return the thinned cloud (N, 4) float32 that a LiDAR sees; the same whenever asked."""
        key = T_world_lidar.tobytes(), seed
        if key not in self.seen:
            self.seen[key] = self._cast(T_world_lidar, seed)
        return self.seen[key]

    def _cast(self, T_world_lidar, seed):
        rng, origin = np.random.default_rng([seed, 42]), T_world_lidar[:3, 3]
        rays = self.rays @ T_world_lidar[:3, :3].T
        middles = 0.5 * (self.boxes[:, :2] + self.boxes[:, 3:5])
        boxes = self.boxes[np.linalg.norm(middles - origin[:2], axis=1) < FAR]
        with np.errstate(divide="ignore", invalid="ignore"):
            low = (boxes[:, None, :3] - origin) / rays
            high = (boxes[:, None, 3:] - origin) / rays
            enter = np.minimum(low, high).max(axis=2)
            leave = np.maximum(low, high).min(axis=2)
            ranges = np.where((enter > 0) & (enter < leave), enter, np.inf).min(axis=0)
            ground = np.where(rays[:, 2] < 0, -origin[2] / rays[:, 2], np.inf)
        ranges = np.minimum(ranges, ground)
        kept = (ranges < FAR) & (rng.random(len(ranges)) > 0.02)
        points = self.rays[kept] * (ranges[kept] + rng.normal(0, 0.01, kept.sum()))[:, None]
        cells = into_cells(points, VOXEL)
        means = np.empty((len(cells), 3))
        mean_points(cells.keys, cells.sums, VOXEL, means)
        return np.column_stack([means, np.full(len(means), 0.5)]).astype(np.float32)


class Drive:
    """Drives along poses, with odometry that drifts, and makes a map on the way.

    Args:
        street: where.
        Ts: (K, 4, 4) true poses of the body.
        drift: factor on the errors of odometry.
        T_body_lidar: where the LiDAR is.
        seed: of the errors.
    """

    def __init__(self, street, Ts, drift=1.0, T_body_lidar=None, seed=0):
        self.T_body_lidar = np.eye(4) if T_body_lidar is None else T_body_lidar
        self.true, self.map, self.loops = Ts, Map(), []
        self.clouds = [street.cloud(T @ self.T_body_lidar, k) for k, T in enumerate(Ts)]
        self.sigma, self.rng = STEP * drift, np.random.default_rng([seed, 43])
        self.ids = []

    def go(self, closer=None, last=None, done=None):
        """Drive on to a keyframe, closing loops with a closer; `done` is told of each."""
        for k in range(len(self.ids), len(self.true) if last is None else last):
            keyframe = self._keyframe(k)
            job = None if closer is None else closer.add(keyframe)
            if job is not None:
                change = job.solve()
                self.loops += change.loops
                change.write(self.map)
            if done is not None:
                done(self)
        job = None if closer is None else closer.last()
        if job is not None:
            job.solve().write(self.map)
        return self

    def _keyframe(self, k):
        keyframe = Keyframe(self.map.new_keyframe_id(), 10**9 * k, cloud=self.clouds[k])
        self.ids.append(keyframe.id)
        if k == 0:
            self.map.add_keyframe(keyframe, self.true[0], covariance=np.zeros((6, 6)))
            return keyframe
        before = self.ids[-2]
        step = se3_inverse(self.true[k - 1]) @ self.true[k]
        step = step @ se3_exp(self.rng.normal(0, self.sigma))
        Ad = se3_adjoint(se3_inverse(step))
        covariance = Ad @ self.map.covariance(before) @ Ad.T + np.diag(self.sigma**2)
        T = self.map.place(before, step)
        self.map.add_keyframe(keyframe, T, covariance=covariance)
        self.map.add_edge(before, keyframe.id, step, np.diag(self.sigma**-2), ODOMETRY)
        return keyframe

    @property
    def errors(self):
        """(K,) how far keyframes are from where they were, also those that went; metres."""
        return np.linalg.norm(
            self.map.Ts_world_body(self.ids)[:, :3, 3] - self.true[:, :3, 3][: len(self.ids)],
            axis=1,
        )

    @property
    def accepted(self):
        """Loops that are believed."""
        return [loop for loop in self.loops if loop.is_accepted]
