"""Whether a laser is mounted as its rig says: how it sees the body move against what wheels say.

A laser that hangs upside down sees every turn the other way round; one that was mounted turned sees
the body go aside; one whose beams are said to be further apart than they are sees turns too large.
To scans alone nothing of that looks wrong: the map comes out mirrored, turned or bent. Wheels
contradict it,

    θ_laser = g θ_wheels,      t_laser ∥ R(α) t_wheels,

where g = 1 and α = 0 if all is as the rig says. Of each part of the way that is long enough the
scans at both ends are laid onto each other without asking the wheels, which is one vote. Votes in a
row that agree with each other, but not with the rig, are believed; wheels that slip now and then do
not agree for so long. Once as many agree with the rig, nothing is looked at any more.

Cost: some 10 ms for a vote, a dozen of them in the beginning of a run.

Reference: A. Censi, A. Franchi, L. Marchionni, G. Oriolo, "Simultaneous calibration of odometry and
sensor parameters for mobile robots", IEEE Trans. Robotics 29(2), 2013.
"""

from collections import deque

import numpy as np
from numpy.typing import NDArray

from odomap.errors import CalibrationError
from odomap.geometry.planar import between_planar
from odomap.lidar.correlative import search_near
from odomap.lidar.grid import OccupancyGrid
from odomap.lidar.gridmatching import match_to_grid
from odomap.lidar.scans import ScanPoints
from odomap.sensors.rig import LidarMount
from odomap.system.scanconfig import ScanTrackingConfig

__all__ = ["MountCheck"]

Array = NDArray[np.float64]

VOTES = 6
"""So many in a row that agree are believed."""
WAY, TURN = (0.5, 1.5), (0.15, 0.6)
"""Least and largest motion between two scans that vote, metres and radians."""
STRAIGHT = 0.1
"""Turn up to which a way tells of the direction, radians."""
FITS = 0.5
"""Share of the beams that must lie on walls of the scan before."""
SURE = 0.05
"""Standard deviation up to which a shift is known, metres."""
WRONG_TURN, WRONG_WAY = 0.25, 0.25
"""How far g must be from 1, and α from 0, to be wrong."""
ALIKE = 0.2
"""How far votes may be from their median to agree."""
SHORT, SLIPPED = 0.15, 1.6
"""Way from which on it is compared, metres, and how many times as far it may seem."""
POINTS = 120
"""Beams that are searched with."""
CELL, TIMES = 0.1, 3
"""Of the grid of the scan before, metres, and how often that is laid into it, to be believed."""


class MountCheck:
    """Compares the motion that a laser sees with that of the wheels.

    Args:
        mount: of the laser.
        config: whether it does, and when a scan says anything.
    """

    def __init__(self, mount: LidarMount, config: ScanTrackingConfig) -> None:
        self._mount, self._config = mount, config
        self._before: tuple[ScanPoints, Array] | None = None
        is_asked = config.checks_mount
        self._turns: deque[float] | None = deque(maxlen=VOTES) if is_asked else None
        self._ways: deque[float] | None = deque(maxlen=VOTES) if is_asked else None

    @property
    def is_done(self) -> bool:
        """Whether the rig is trusted."""
        return self._turns is None and self._ways is None

    def check(self, scan: ScanPoints | None, x_odom_body: Array | None) -> None:
        """Take in a scan as `doubt` does.

        Raises:
            CalibrationError: something cannot be as the rig says.
        """
        if doubt := self.doubt(scan, x_odom_body):
            raise CalibrationError(doubt)

    def doubt(self, scan: ScanPoints | None, x_odom_body: Array | None) -> str:
        """Take in a scan; say what cannot be as the rig says, empty if nothing is known against it.

        Args:
            scan: the scan, None where there is none.
            x_odom_body: (3,) where the wheels say that the body is, None where they say nothing.
        """
        if self.is_done:
            return ""
        if scan is None or x_odom_body is None or len(scan) < self._config.min_hits:
            self._before = None
            return ""
        if self._before is None:
            self._before = scan, x_odom_body
            return ""
        before, x_before = self._before
        motion = between_planar(x_before, x_odom_body)
        way, turn = float(np.hypot(*motion[:2])), abs(float(motion[2]))
        turns = self._turns if turn >= TURN[0] else None
        ways = self._ways if way >= WAY[0] and turn <= STRAIGHT else None
        is_far = way > WAY[1] or turn > TURN[1]
        if turns is None and ways is None and not is_far:
            return ""
        self._before = scan, x_odom_body
        if is_far:
            return ""
        seen = _motion_seen(before, scan, way, turn)
        if seen is None or not _went_as_far(float(np.hypot(*seen[0][:2])), way):
            return ""
        if turns is not None:
            turns.append(float(seen[0][2] / motion[2]))
        if ways is not None and seen[1]:
            across = motion[0] * seen[0][1] - motion[1] * seen[0][0]
            ways.append(float(np.arctan2(across, motion[:2] @ seen[0][:2])))
        return self._wrong_turns() or self._wrong_ways()

    def _wrong_turns(self) -> str:
        if self._turns is None or (g := _agreed(np.array(self._turns))) is None:
            return ""
        if abs(g - 1.0) <= WRONG_TURN:
            self._turns = None
            return ""
        name, mend = f"laser '{self._mount.name}'", "of a rig.yaml"
        if abs(g + 1.0) <= WRONG_TURN:
            return (
                f"{name} sees every turn the other way round than the wheels: it hangs upside down,"
                f" or its beams come in the other order: say so in T_body_lidar or angles {mend}"
            )
        if abs(g) <= WRONG_TURN:
            return (
                f"{name} sees nothing of the turns that the wheels say: its scans or the odometry "
                "are not of this drive, or it hangs"
            )
        first, last, _ = self._mount.angles
        view = float(np.degrees(abs(last - first)))
        said = f", of {view / g:.0f}° instead of {view:.0f}°" if 0.0 < view / g <= 360.0 else ""
        return (
            f"{name} sees turns {g:.2f} times as large as the wheels: its field of view is another"
            f"{said}: mend its angles in a rig.yaml, or leave out wheels that are wrong with "
            "--scan-tracking.use-odometry False"
        )

    def _wrong_ways(self) -> str:
        if self._ways is None:
            return ""
        turned = np.array(self._ways)
        middle = _agreed(np.angle(np.exp(1j * (turned - turned[-1:])))) if len(turned) else None
        if middle is None:
            return ""
        alpha = float(np.angle(np.exp(1j * (turned[-1] + middle))))
        if abs(alpha) <= WRONG_WAY:
            self._ways = None
            return ""
        side = "left" if alpha > 0.0 else "right"
        return (
            f"laser '{self._mount.name}' sees the body go {abs(np.degrees(alpha)):.0f}° to the "
            f"{side} of where the wheels say: it is mounted turned by {-np.degrees(alpha):.0f}°: "
            "say so in T_body_lidar of a rig.yaml"
        )


def _went_as_far(seen_m: float, way: float) -> bool:
    """Say whether the wheels did not slip, as far as can be told: ranges are metres in any view."""
    return way < SHORT or way / SLIPPED < seen_m < way * SLIPPED


def _agreed(votes: Array) -> float | None:
    """Return what votes (n,) agree on, None if they do not or are too few."""
    if len(votes) < VOTES:
        return None
    middle = float(np.median(votes))
    largest = max(1.0, abs(middle))
    return middle if (np.abs(votes - middle) <= ALIKE * largest).all() else None


def _motion_seen(
    before: ScanPoints, scan: ScanPoints, way: float, turn: float
) -> tuple[Array, bool] | None:
    """Return the motion (3,) between two scans by themselves, and whether the shift is sure."""
    grid = OccupancyGrid(CELL, keeps_hits=True)
    for _ in range(TIMES):
        grid.insert(before.origin, before.hits, between=before.between)
    some = scan.hits[:: max(1, len(scan) // POINTS)]
    x = search_near(grid, some, np.zeros(3), 1.3 * way + 0.1, 2.0 * turn + 0.1)
    match = match_to_grid(grid, scan.hits, scan.normals, x)
    if match.on_walls < FITS:
        return None
    weakest = float(np.linalg.eigvalsh(match.information[:2, :2])[0])
    return match.x_grid_body, weakest * SURE**2 > 1.0
