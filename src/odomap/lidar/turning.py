"""Turning: when a LiDAR measured a point, from the direction in which it is.

A LiDAR that turns evenly looks into each direction at its own moment. Clockwise (seen from above),
with a sweep that begins at azimuth φ₀ and is stamped when the LiDAR looks towards φₛ,

    t(φ) = P ([φ₀ - φ]₂π - [φ₀ - φₛ]₂π) / 2π,

P seconds a turn and [·]₂π what is left of whole turns; counter-clockwise both differences change
sign. While the LiDAR turns with its carrier by ω, a turn takes P/(1 + ω P/2π): at 1 rad/s and 10 Hz
that is 1.6 %, less than what most recordings leave open about their stamps.

Reference: A. Geiger et al., "Vision meets robotics: the KITTI dataset", Int. J. Robotics Research
32(11), 2013.
"""

import numpy as np
from numpy.typing import NDArray

__all__ = ["turn_times"]

Array = NDArray[np.float64]


def turn_times(
    azimuth: Array, period: float, clockwise: bool, begin: float, stamped: float
) -> Array:
    """Return when points were measured, from their azimuths.

    Args:
        azimuth: (N,) to the left of straight ahead, radians.
        period: seconds a turn takes.
        clockwise: whether the LiDAR turns to its right.
        begin: azimuth at which a sweep begins.
        stamped: azimuth at the moment of the stamp; equal to `begin` for that of the beginning.

    Returns:
        (N,) seconds since the stamp, finite also where an azimuth is not.
    """
    turn, full = (-1.0 if clockwise else 1.0), 2 * np.pi
    before = (turn * (stamped - begin)) % full
    since = np.nan_to_num(turn * (azimuth - begin)) % full
    return np.asarray((since - before) * (period / full))
