"""Growth: by what a keyframe is less sure than the one it was placed against.

Where two keyframes lie to each other is as unsure as odometry was between them, and stays so
whatever loops tell of where both are in the world. So it is kept apart from their covariances, in
which closed loops have a part,

    Q = Σ_k − Ad(T_k_p) Σ_p Ad(T_k_p)ᵀ     of keyframe k and its parent p, when k had been mapped,

as a tangent at k and in the units of k, since loops change what a unit is in the world. The sum of
all Q on the way from the root, each carried along, is the covariance of odometry. Where a keyframe
is culled its children go to its parent, and the growths of both steps add up.

Reference: Mur-Artal, Montiel, Tardós, "ORB-SLAM: a versatile and accurate monocular SLAM system",
T-RO 2015, section III-D (essential graph).
"""

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.lie import se3_adjoint
from odomap.maps.states import Placement, States, compose, inverse, stretched

__all__ = ["growth_of", "hand_on"]

Array = NDArray[np.float64]


def growth_of(
    covariance: Array, of_parent: Array, S_world: Placement, S_parent: Placement
) -> Array:
    """Return the growth (6, 6) of a keyframe, in its units.

    It may be indefinite: covariances that were found one by one need not fit together.

    Args:
        covariance: (6, 6) of the keyframe, in units of the world.
        of_parent: (6, 6) of its parent, likewise.
        S_world: of the keyframe, (4, 4) pose and scale.
        S_parent: of its parent.
    """
    sure, of = stretched(covariance, 1.0 / S_world[1]), stretched(of_parent, 1.0 / S_parent[1])
    return sure - _carried(of, compose(inverse(S_world), S_parent))


def hand_on(states: States, keyframe: int, holder: int, children: NDArray[np.int64]) -> None:
    """Hand the growth of a keyframe that is culled on to what hung from it.

    Args:
        states: with the keyframe and its children as they are.
        keyframe: the one that goes.
        holder: whom its children hang from then; the eldest of them where it was the root.
        children: (n,) those that hung from it.
    """
    others, growths = children[children != holder], states.growths
    S = tuple(x[0] for x in states.placements(np.array([keyframe])))
    step = growths[keyframe].copy()
    growths[keyframe] = np.nan
    if len(others) < len(children):  # from the eldest child to the root that goes, and on
        S_holder = tuple(x[0] for x in states.placements(np.array([holder])))
        step = _carried(growths[holder], compose(inverse(S), S_holder))
        growths[holder] = np.nan
    growths[others] += _carried(step, compose(inverse(states.placements(others)), S))


def _carried(covariance: Array, S_to_from: Placement) -> Array:
    """Return a covariance (6, 6) of a tangent at one pose, of the tangent at others (..., 6, 6).

    Each is in the units there.
    """
    T, scale = S_to_from
    Ad = se3_adjoint(T)
    return np.asarray(Ad @ stretched(covariance, scale) @ np.swapaxes(Ad, -1, -2))
