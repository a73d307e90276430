"""Verifying that two clouds are of one place, and measuring how they lie to each other.

A candidate is a guess of where one LiDAR was in the frame of another. The cloud is laid onto the
place there by GICP, and believed if all of this holds:

    it comes to rest                                    else the guess was too far off
    enough of it meets what is known, and closely       else it is somewhere else
    each saw what stands up in the other                else nothing speaks for it
    and neither looked through it                       else the places only look the same

The last is what tells: streets fit on streets, but not without walls where the other one looked
through (`lidar/sightlines`). Roads agree everywhere, cars come and go: what stands up counts, where
anything does. Registration takes errors for independent, and of thinned clouds they are not, so

    Σ = 12 (I + I₀)⁻¹ + diag(0.04 m/m, 0.007 rad/m)² e²

with e the root mean square distance of the points from the surface, and I₀ that of what nobody
knows, 1 m and 0.1 rad, along a tunnel. Errors are 0.3 (32 beams) to 1.4 (16 beams) of it, squared.

Cost: 20 ms beside the place.

Reference: A. Segal, D. Haehnel, S. Thrun, "Generalized-ICP", RSS 2009.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.geometry.lie import se3_adjoint, se3_inverse
from odomap.lidar.cloud import Cloud
from odomap.lidar.registration import Registration, register
from odomap.lidar.sightlines import Panorama, Seen
from odomap.system.cloudconfig import CloudClosingConfig
from odomap.system.cloudplaces import CloudPlaces, Places, cloud_points
from odomap.system.cloudsearch import Candidate

__all__ = ["CloudJudge", "Laid", "stands_up"]

Array = NDArray[np.float64]

LOWEST, TALL, FEWEST = 0.05, 2.0, 200
"""Share of the points that may be below the ground, height above it from which a thing stands up,
metres, and points that there must be of them."""
INFLATED = 12.0
FLOOR = np.array([0.04] * 3 + [0.007] * 3)
UNKNOWN = np.diag([1.0] * 3 + [0.1] * 3) ** 2


@dataclass(frozen=True, eq=False)
class Laid:
    """How a cloud lies on a place.

    Attributes:
        row: of the keyframe there.
        T_place_body: (4, 4) where the body is in its frame.
        information: (6, 6) of that, right tangent.
        num_inliers: points that meet what is known.
        overlap: share of them.
        doubt: the larger share of what stands up in one that the other looked through.
        reason: why it is not believed; empty if it is.
    """

    row: int
    T_place_body: Array
    information: Array
    num_inliers: int
    overlap: float
    doubt: float
    reason: str


class CloudJudge:
    """Lays clouds onto places, and judges whether they belong there.

    Args:
        T_body_lidar: (4, 4) where the LiDAR is on the body.
        config: what a cloud must show.
    """

    def __init__(self, T_body_lidar: Array, config: CloudClosingConfig) -> None:
        self._T_body_lidar, self._config = np.array(T_body_lidar), config
        self._places = CloudPlaces(config.neighbours, config.voxel, config.max_distance)

    def lay(self, places: Places, candidate: Candidate, points: Array, up: Array) -> Laid:
        """Lay a cloud onto a place.

        Args:
            places: of the map.
            candidate: which of them, and a first guess.
            points: (N, 3) seen from the LiDAR.
            up: (3,) which way is up there.
        """
        config, row = self._config, candidate.row
        there, ups = cloud_points(places.keyframes[row]), (up, places.Ts_world_lidar[row, 2, :3])
        guess = self._of_body(candidate.T_place_lidar)
        try:
            found = register(
                Cloud.of(points),
                self._places.target(places, row),
                "gicp",
                initial=candidate.T_place_lidar,
                voxel=config.voxel,
                max_distance=config.max_distance,
            )
        except InputError as error:
            return Laid(row, guess, np.zeros((6, 6)), 0, 0.0, 1.0, str(error))
        T, overlap = found.T_target_source, found.num_inliers / found.num_points
        seen = Panorama(there).judge(stands_up(points, ups[0]), T)
        back = Panorama(points).judge(stands_up(there, ups[1]), se3_inverse(T))
        return Laid(
            row,
            self._of_body(T),
            self._information(places, row, found),
            found.num_inliers,
            overlap,
            max(seen.doubt, back.doubt),
            _reason(found, overlap, (seen, back), config),
        )

    def _of_body(self, T_a_b: Array) -> Array:
        """Return how bodies lie of how their LiDARs do."""
        return np.asarray(self._T_body_lidar @ T_a_b @ se3_inverse(self._T_body_lidar))

    def _information(self, places: Places, row: int, found: Registration) -> Array:
        """Return the information (6, 6) of a body, honest about errors that are not independent."""
        known = np.linalg.inv(found.information + np.linalg.inv(UNKNOWN))
        covariance = INFLATED * known + np.diag((FLOOR * found.error) ** 2)
        to_body = se3_adjoint(self._T_body_lidar)
        to_here = se3_adjoint(se3_inverse(self._of_body(found.T_target_source)))
        bent = to_here @ places.bent(row, self._config.neighbours) @ to_here.T
        information = np.linalg.inv(to_body @ covariance @ to_body.T + bent)
        return np.asarray(0.5 * (information + information.T))


def _reason(
    found: Registration, overlap: float, seen: tuple[Seen, Seen], config: CloudClosingConfig
) -> str:
    """Say why a cloud is not believed to belong to a place; nothing if it is."""
    if not found.converged:
        return found.reason
    if overlap < config.overlap:
        return (
            f"{overlap:.0%} of {found.num_points} points meet what is known there, "
            f"{config.overlap:.0%} needed"
        )
    if found.error > config.misfit * config.voxel:
        most = config.misfit * config.voxel
        return (
            f"its points are {found.error:.3f} m off the surface there, in the mean, "
            f"{most:.3f} m allowed"
        )
    agree, doubt = min(s.agree for s in seen), max(s.doubt for s in seen)
    if agree < config.agree:
        return f"{agree:.0%} of what stands there was seen by both, {config.agree:.0%} needed"
    if doubt > config.against:
        return (
            f"of what stands there {doubt:.0%} is where the other sweep looked through, "
            f"{config.against:.0%} allowed"
        )
    return ""


def stands_up(points: Array, up: Array) -> Array:
    """Return the points (n, 3) that stand up above the ground; all where hardly any do."""
    heights = points @ up
    lowest = int(LOWEST * len(heights))
    ground = np.partition(heights, lowest)[lowest] if len(heights) else 0.0
    tall = heights > ground + TALL
    return points[tall] if tall.sum() >= FEWEST else points
