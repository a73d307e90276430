"""Laying a sweep down: where the body should be by then, and where else it may be.

A match only looks around its guess, and a body need not go on as before: a car brakes hard, a robot
turns round, a log has a gap. Laid down metres off, a sweep finds something to lie on, too: walls
along the way fit wherever one is along them, and what would not fit is left out as if it had moved
by itself. That shows in the match: fewer points lie on the map than usual and less well, or far
from where they should, or the steps do not come to rest. So of a match x that is strange, and for
a few sweeps after such a motion, is asked how the sweep lies on the one before alone, on surfaces
in voxels and with a wide search (`planefrontend`), from several guesses:

    x,    x_before exp(ξ Δt) with ξ = 0 (it stands still),    with ξ reversed.

The one with the least truncated square Σ min(r², 9 σ²) is where it is; another than the match must
be clearly better, since along a tunnel all are as good, and better still if the map there knows of
none that is. From there the front-end lays it onto its map once more, and if that slips off again,
the look at the sweep before is believed.

Where none fits as two sweeps of this place do, the body is somewhere else, and lost.

Cost: nothing where a match is as usual; a strange one costs five others.

Reference: K. Koide et al., "Voxelized GICP for fast and accurate 3D point cloud registration", ICRA
2021 (distances to voxels, whose reach is their size).
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.lie import se3_exp, se3_inverse, se3_log
from odomap.lidar.cloudconfig import PointsConfig
from odomap.lidar.frontend import FrontEnd, SweepMatch
from odomap.lidar.planefrontend import PlaneFrontEnd, ThinSweep
from odomap.system.cloudconfig import CloudTrackingConfig
from odomap.system.cloudmotion import CloudMotion, is_fixed
from odomap.system.cloudview import CloudView

__all__ = ["CloudLayer", "Laid"]

Array = NDArray[np.float64]

COARSELY = 2.5
"""Side of the cells of which one point each is looked at, in voxels."""
OTHERWISE = 0.0, -1.0
"""Of the motion so far: what else a body may do."""
CLEARLY, SURELY = 0.97, 0.93
"""Share of the misfit that another guess may leave at most; and if the map does not know of it."""
NEAR = 0.3, 0.03
"""How far two places of a sweep may be apart that are one, metres and radians."""
TRUNCATED = 9.0
"""Squares from which on points lie on something else, in units of the error of the best."""
LESS = 0.65
"""Share of the points that two sweeps in a row have in common, below which they do not fit."""


@dataclass(frozen=True, eq=False)
class Laid:
    """A sweep laid down.

    Attributes:
        match: where.
        twist: (6,) how the body moved to there, per second.
        wrong: why it cannot be; empty if it can.
    """

    match: SweepMatch
    twist: Array
    wrong: str = ""


@dataclass(frozen=True, eq=False)
class _Seen:
    """A sweep that was placed: T_odom_middle (4, 4) and twist (6,)."""

    view: CloudView
    T_odom_middle: Array
    twist: Array


class CloudLayer:
    """Lays sweeps onto what a front-end knows, and if need be onto the one before.

    Args:
        front_end: has the map.
        motion: of the body.
        config: how.
    """

    def __init__(
        self, front_end: FrontEnd[Any], motion: CloudMotion, config: CloudTrackingConfig
    ) -> None:
        self._front_end, self._motion, self._config = front_end, motion, config
        self._seen: list[_Seen] = []

    def clear(self) -> None:
        """Forget the sweeps before."""
        self._seen = []

    def note(self, view: CloudView) -> None:
        """Remember a sweep that was placed: the motion says where."""
        motion = self._motion
        self._seen = [*self._seen[-1:], _Seen(view, motion.T_odom_middle, motion.twist)]

    def lay(self, view: CloudView, seconds: float) -> Laid:
        """Lay a sweep down where it should be, and look elsewhere if that is strange."""
        motion, wrong = self._motion, ""
        guess = motion.predicted(seconds), motion.twist
        laid = self._lay(self._front_end, view.prepared, guess, seconds, self._rounds(view))
        if self._seen and seconds > 0.0 and motion.is_strange(laid.match, seconds):
            laid, wrong = self._look_around(view, laid, seconds)
        return replace(laid, wrong=wrong or self._wrong(laid.match, seconds))

    def _rounds(self, view: CloudView) -> int:
        """Return how often a sweep is laid down: once if no times say what a motion does to it."""
        has_times = view.points is not None and view.points.has_times
        return self._config.rounds if has_times else 1

    def _lay(
        self,
        front_end: FrontEnd[Any],
        prepared: Any,
        guess: tuple[Array, Array],
        seconds: float,
        rounds: int,
    ) -> Laid:
        """Lay a sweep down from a guess, and again with the motion that this gives."""
        T, twist = guess
        for n in range(rounds):
            match = front_end.match(prepared, T, twist, again=n > 0)
            T = match.T_map_body
            twist = self._motion.twist_to(T, seconds)
        return Laid(match, twist)

    def _look_around(self, view: CloudView, laid: Laid, seconds: float) -> tuple[Laid, str]:
        """Look where a sweep lies on the one before; where it is then, and why it is nowhere."""
        before, motion, rounds = self._seen[-1], self._motion, self._rounds(view)
        front_end, prepared = _looking(before, view)
        guesses = [(laid.match.T_map_body, laid.twist)]
        there = front_end.lying(prepared, *guesses[0])
        for factor in OTHERWISE:
            twist = factor * motion.twist
            guesses.append((motion.T_odom_middle @ se3_exp(twist * seconds), twist))
        found = []
        for T, twist in guesses:
            front_end.expect_anything()
            found.append(self._lay(front_end, prepared, (T, twist), seconds, rounds))
        best, left = _best(there, found)
        if motion.is_poor(laid.match) and (wrong := self._fits_nowhere(found)):
            return laid, wrong
        if left > CLEARLY or not is_fixed(best.match) or _is_near(best.match, laid.match):
            return laid, ""
        at = best.match.T_map_body, best.twist
        again = self._lay(self._front_end, view.prepared, at, seconds, rounds)
        if not is_fixed(again.match) and left > SURELY:  # the map says that any place is as good
            return laid, ""
        if is_fixed(again.match) and _is_near(again.match, best.match):
            return again, ""
        # How many points lie on its own map is what its matches are compared by.
        held = replace(best.match, num_inliers=again.match.num_inliers)
        held = replace(held, num_points=again.match.num_points, error=again.match.error)
        return Laid(held, best.twist), ""

    def _fits_nowhere(self, found: list[Laid]) -> str:
        """Say why a sweep is nowhere near the one before; empty if it is, or nobody can say."""
        if len(self._seen) < 2:
            return ""
        older, before = self._seen
        front_end, prepared = _looking(older, before.view)
        usual = front_end.match(prepared, before.T_odom_middle, before.twist).share
        best = max((laid.match for laid in found), key=lambda match: match.share)
        if best.share >= LESS * usual:
            return ""
        return (
            f"only {best.share:.0%} of {best.num_points} points lie on the sweep before, "
            f"{usual:.0%} of that do on the one before: carried off?"
        )

    def _wrong(self, match: SweepMatch, seconds: float) -> str:
        """Say why a match cannot be; empty if it can."""
        config = self._config
        if match.share < config.min_share:
            return (
                f"only {match.share:.0%} of {match.num_points} points lie on what is known, "
                f"{config.min_share:.0%} needed"
            )
        moved = se3_log(se3_inverse(self._motion.T_odom_middle) @ match.T_map_body)
        far = float(np.linalg.norm(moved[:3]))
        if far > config.fastest * max(seconds, 0.1):
            return f"it would have moved by {far:.1f} m in {seconds:.2g} s"
        return self._motion.doubt(match, seconds)


def _looking(before: _Seen, view: CloudView) -> tuple[PlaneFrontEnd, ThinSweep]:
    """Return the surfaces of a sweep alone, and another to be laid onto them."""
    front_end = PlaneFrontEnd(PointsConfig(matched=COARSELY))
    assert before.view.points is not None
    assert view.points is not None
    front_end.insert(front_end.prepare(before.view.points), before.T_odom_middle, before.twist)
    return front_end, front_end.prepare(view.points)


def _best(there: SweepMatch, found: list[Laid]) -> tuple[Laid, float]:
    """Return the one that fits best, and its misfit as a share of that of where it is."""
    fine = min(match.error for match in (there, *(laid.match for laid in found))) ** 2
    best = min(found, key=lambda laid: _misfit(laid.match, fine))
    return best, _misfit(best.match, fine) / max(_misfit(there, fine), 1e-12)


def _misfit(match: SweepMatch, fine: float) -> float:
    """Return Σ min(r², 9 σ²) of a match."""
    return match.share * match.error**2 + (1.0 - match.share) * TRUNCATED * fine


def _is_near(one: SweepMatch, other: SweepMatch) -> bool:
    """Say whether two matches of a sweep place it alike."""
    off = se3_log(se3_inverse(one.T_map_body) @ other.T_map_body)
    return bool(np.linalg.norm(off[:3]) < NEAR[0] and np.linalg.norm(off[3:]) < NEAR[1])
