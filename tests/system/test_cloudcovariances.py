"""What steps of a 3D LiDAR's odometry claim, one, some and many of them, held against the truth.

Between two keyframes lies what the map drifted by, which edges say, and what both sweeps are off by
themselves, which frames say. Many edges must not be as unsure as the sweeps are together, nor one
edge as sure as the map.
"""

import numpy as np
import pytest

from odomap.geometry.lie import se3_adjoint, se3_inverse, se3_log
from sweepruns import Kept, played

WORLDS = {
    "16 beams": (16, ""),
    "64 beams": (64, "&columns=450"),
    "solid state": (16, "&pattern=solid_state"),
}
SEEDS, FRAMES = (0, 1), 55


class Followed:
    """A street that was followed: keyframes, their covariances, and the steps between them."""

    def __init__(self, world, seed):
        beams, more = WORLDS[world]
        source = Kept("street", beams, FRAMES, seed, more=more)
        _, _, result = played(source, source.rig)
        map, path = result.map, result.trajectory
        ids = sorted(map.keyframe_ids.tolist())
        rows = np.searchsorted(path.stamps_ns, [map.keyframe(k).stamp_ns for k in ids])
        self.Ts, self.true = path.Ts_world_body[rows], source.truth.Ts_world_body[rows]
        self.own = path.covariances[rows] - map.covariances(np.array(ids))
        edges, at = map.edges(), {k: n for n, k in enumerate(ids)}
        self.steps = {
            (at[i], at[j]): np.linalg.inv(information)
            for i, j, information in zip(
                edges.i.tolist(), edges.j.tolist(), edges.information, strict=True
            )
        }

    def __len__(self):
        return len(self.Ts)

    def between(self, i, j):
        """Return the error (6,) of j as seen from i, and its covariance (6, 6)."""
        T = se3_inverse(self.Ts[i]) @ self.Ts[j]
        to_here = se3_adjoint(se3_inverse(T))
        P = to_here @ self.own[i] @ to_here.T + self.own[j]
        for k in range(i, j):
            rest = se3_adjoint(se3_inverse(self.Ts[j]) @ self.Ts[k + 1])
            P = P + rest @ self.steps[k, k + 1] @ rest.T
        return se3_log(se3_inverse(se3_inverse(self.true[i]) @ self.true[j]) @ T), P

    def squares(self, count):
        """Return the normalised errors squared, per degree of freedom, over so many keyframes."""
        pairs = [self.between(i, i + count) for i in range(len(self) - count)]
        return [float(e @ np.linalg.solve(P, e)) / 6.0 for e, P in pairs]


@pytest.mark.parametrize("world", WORLDS)
def test_errors_over_one_step_and_over_many_are_as_large_as_is_claimed(world):
    ways = [Followed(world, seed) for seed in SEEDS]
    for count in (1, 5, 15):
        mean = float(np.mean(np.concatenate([way.squares(count) for way in ways])))
        assert 0.3 < mean < 2.5, (count, mean)
    for way in ways:
        # White errors of sweeps do not add up: a long way is not as unsure as its sweeps together.
        _, short = way.between(1, 2)
        _, long = way.between(1, len(way) - 1)
        turns = np.trace(long[3:, 3:]) / np.trace(short[3:, 3:])
        assert turns < 0.5 * (len(way) - 2)
        assert np.sqrt(np.trace(short[:3, :3])) < 0.05
