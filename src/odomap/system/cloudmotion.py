"""How a body with a LiDAR moves: its twist, and how unsure that leaves where it is.

Sweeps are laid where the body should be by then, x exp(ξ Δt). What a match says of the step (Λ, its
information) is weighed against how a body can move, with V the covariance of ξ:

    D = (V + diag(σ_a, σ_ω)² Δt²) Δt²,    P_step = (D⁻¹ + Λ)⁻¹,    V ← P_step / Δt²

Along a tunnel Λ is zero: ξ stays what it was, and one error of it makes all steps too long. With
A = P_step D⁻¹ the share of an old error that a step still has, C the covariance of place and step,
and S = A + s (I - A) what of a sweep's error stays in the map, one over its age (`planematching`),

    P ← Ad P Adᵀ + S P_own Sᵀ + C Aᵀ + A Cᵀ,   C ← Ad (C Aᵀ + S P_step),   P_own = P_step + B U Bᵀ,

U being by what rates change from sweep to sweep, and B how that bends a sweep. So P, of the steps
from keyframe to keyframe, is what the map drifts by, with a floor for each metre. What a sweep errs
by itself, (I - S) P_own (I - S)ᵀ, is white and belongs to the frame alone: along a path it does not
add up, but for the first one, where all is counted from. C runs on through keyframes.

A stamp before the last one, or hardly after it, tells no time: a sweep takes as long as is usual. A
body not seen for long may be anywhere; of one that was carried off much less lies on what is known.

Reference: T. D. Barfoot, "State estimation for robotics", Cambridge 2017, section 10.1 (a motion
with white noise on acceleration).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.lie import se3_adjoint, se3_exp, se3_inverse, se3_log
from odomap.lidar.frontend import SweepMatch
from odomap.system.cloudconfig import CloudTrackingConfig

__all__ = ["CloudMotion", "is_fixed"]

Array = NDArray[np.float64]

LEARNING = 0.1
"""Weight of the last sweep in what is usual."""
LONGEST_S, LONGEST = 1.0, 3.0
"""Time over which a body is taken to go on as before; or so many times as long as it is usual."""
SHORTEST = 0.1
"""Of the usual time between sweeps: in less no sweep is taken, and no speed can be told of it."""
LESS = 0.65
"""Share of the points that usually lie on what is known, below which a match is looked at twice."""
STEADY, STRANGE = (0.01, 0.003), 4.0
"""How unsteady the steadiest motion is from sweep to sweep, metres and radians; and how many times
what is usual is strange."""
FIXED = 1.0
"""Largest standard deviation of a place, in metres, that a match says something of."""
LEARNT = 5
"""Sweeps after which it is known how unsteady a motion is."""
AFTERWARDS = 2
"""Sweeps after a strange motion, which are looked at twice, too."""
POOR, FEWER, WORSE = 3.0, 0.05, 0.17
"""How many times what is usual a match is worse that is poor; by what share the number of points on
the map differs from sweep to sweep at least, and their misfit."""
TRUNCATED = 9.0
"""Squares of the usual error from which on points lie on nothing."""
FINEST = 1e-3
"""Least standard deviation of a step before it is matched, metres and radians."""


@dataclass
class _Usual:
    """What a number usually is, and the square of by how much it differs from sweep to sweep."""

    value: float = 0.0
    square: float = 0.0
    learnt: int = 0

    def learn(self, now: float) -> None:
        """Take in one more, which counts as much as any as long as they are few."""
        self.learnt += 1
        weight, off = max(LEARNING, 1.0 / self.learnt), now - self.value
        self.value += weight * off
        if self.learnt > 1:
            self.square += weight * (off * off - self.square)

    def above(self, now: float, least: float) -> float:
        """Return by how many times what is usual it is above, which is a share of it at least."""
        spread = max(self.square**0.5, least * self.value)
        return (now - self.value) / spread if spread > 0.0 else 0.0


class CloudMotion:
    """Follows a body from the middle of one sweep to the middle of the next.

    Args:
        config: how bodies move.

    Attributes:
        T_odom_middle: (4, 4) the body in the middle of the last sweep.
        twist: (6,) per second.
        since: (6, 6) covariance of all steps since the last keyframe.
    """

    def __init__(self, config: CloudTrackingConfig) -> None:
        self._config = config
        self._middle_ns = -1
        self._usual_s = 0.0
        self.begin(np.eye(4), -1)

    def begin(self, T_odom_middle: Array, middle_ns: int, sure: Array | None = None) -> None:
        """Begin anywhere, which is sure to a covariance (6, 6): of the motion nothing is known."""
        config = self._config
        self.T_odom_middle, self.twist = T_odom_middle, np.zeros(6)
        self._V = np.diag(np.repeat([config.unknown, config.unknown_rad], 3) ** 2)
        self._C, self.since = np.zeros((6, 6)), np.zeros((6, 6)) if sure is None else sure
        self._unsteady2 = np.repeat([config.unsteady, config.unsteady_rad], 3) ** 2
        self.own = np.zeros((6, 6))
        self._share, self._square, self._count, self._misfit = (_Usual() for _ in range(4))
        self._gone, self._shaken, self._was_fixed = 0, 0, False
        self._middle_ns = max(middle_ns, self._middle_ns)

    @property
    def known(self) -> tuple[Array, Array]:
        """The twist (6,), and its information (6, 6)."""
        return self.twist, np.asarray(np.linalg.inv(self._V))

    def know(self, twist: Array, information: Array) -> None:
        """Take notice of a twist (6,) that is known to an information (6, 6)."""
        self.twist, self._V = twist, _together(self._V, information)

    def hang(self) -> None:
        """Count from here on: a keyframe is where the body is."""
        self.since = np.zeros((6, 6))

    def seconds_to(self, middle_ns: int) -> float:
        """Return the time that has passed since the last sweep that was placed."""
        seconds = (middle_ns - self._middle_ns) * 1e-9
        return seconds if seconds > SHORTEST * self._usual_s else self._usual_s

    def predicted(self, seconds: float) -> Array:
        """Return where (4, 4) the body should be by then."""
        return np.asarray(self.T_odom_middle @ se3_exp(self.twist * seconds))

    def is_anywhere(self, seconds: float) -> bool:
        """Say whether nobody saw it for so long that it may be anywhere by now."""
        return self._usual_s > 0.0 and seconds > max(LONGEST_S, LONGEST * self._usual_s)

    def twist_to(self, T_odom_middle: Array, seconds: float) -> Array:
        """Return the motion per second that leads to a pose; that known if there was no time."""
        if seconds <= 0.0:
            return self.twist
        return np.asarray(se3_log(se3_inverse(self.T_odom_middle) @ T_odom_middle) / seconds)

    def over(self, seconds: float) -> Array:
        """Return the covariance (6, 6) of a motion of so many seconds, as it is known."""
        return np.asarray(self._V * seconds**2)

    def is_strange(self, match: SweepMatch, seconds: float) -> bool:
        """Say whether a match is not like those before, or the motion was not a moment ago."""
        if not self._gone:
            return False
        slides = self._was_fixed and not is_fixed(match)
        is_odd = not match.converged or slides or self._shaken > 0 or self.is_poor(match)
        return is_odd or self._is_off(match, seconds)

    def is_poor(self, match: SweepMatch) -> bool:
        """Say whether fewer points lie on the map than usual, or less well."""
        is_less = self._count.above(match.num_inliers, FEWER) < -POOR
        return is_less or self._misfit.above(self._misfit_of(match), WORSE) > POOR

    def _misfit_of(self, match: SweepMatch) -> float:
        """Return Σ min(r², 9 σ²) with σ the usual error, relative to what it usually is."""
        share, usual, square = match.share, self._share.value, self._square.value
        if not square > 0.0:
            return 1.0
        misfit = share * match.error**2 / square + (1.0 - share) * TRUNCATED
        return misfit / (usual + (1.0 - usual) * TRUNCATED)

    def doubt(self, match: SweepMatch, seconds: float) -> str:
        """Say why a match looks as if the body was carried off; empty if it does not.

        Another place has much less on what is known than those before, as has what comes in sight
        behind a corner; but that lies where it should, and shows that it does.
        """
        if match.share >= LESS * self._share.value:
            return ""
        if match.converged and is_fixed(match) and self._off(match, seconds) < STRANGE:
            return ""
        return (
            f"only {match.share:.0%} of {match.num_points} points lie on what is known, "
            f"{self._share.value:.0%} did before, and not where they should: carried off?"
        )

    def _is_off(self, match: SweepMatch, seconds: float) -> bool:
        """Say whether a match is far from where it should be, as soon as it is known how far is."""
        return self._gone > LEARNT and self._off(match, seconds) > STRANGE

    def _off(self, match: SweepMatch, seconds: float) -> float:
        """Return how far a match is from where it should be, in units of how far is usual."""
        off = _sizes(se3_log(se3_inverse(self.predicted(seconds)) @ match.T_map_body))
        n = max(seconds / self._usual_s, 1.0) if self._usual_s > 0.0 else 1.0
        longer = np.sqrt(n * (n + 1.0) * (2.0 * n + 1.0) / 6.0)  # changes of n sweeps, added up
        usual = np.maximum(_sizes(np.sqrt(self._unsteady2)) * self._usual_s, STEADY)
        return float(np.max(off / (longer * usual)))

    def go(
        self, match: SweepMatch, twist: Array, seconds: float, middle_ns: int, unseen: bool,
        fixed: bool,
    ) -> Array:  # fmt: skip
        """Take a match as where the body is; return the covariance (6, 6) since the keyframe.

        Args:
            match: of a sweep.
            twist: (6,) that leads there.
            seconds: since the last one.
            middle_ns: of the sweep.
            unseen: whether nobody saw how it moved in between.
            fixed: whether it was laid onto a map that is as it is, and no part of it.
        """
        loose = self._loose(seconds, unseen)
        step = _together(loose, match.information)
        kept = step @ np.linalg.inv(loose)
        Ad = se3_adjoint(se3_inverse(se3_inverse(self.T_odom_middle) @ match.T_map_body))
        shared = Ad @ self._C @ kept.T
        grown = Ad @ self.since @ Ad.T + _grown(shared + shared.T)
        is_off = self._is_off(match, seconds)
        self._shaken = AFTERWARDS if is_off else max(self._shaken - 1, 0)
        if self._gone:
            self._unsteady2 += LEARNING * ((twist - self.twist) ** 2 - self._unsteady2)
        if fixed:
            grown = _together(grown + loose, match.information)
            self.own = self._own(match, step, np.eye(6), seconds / 8.0)
            self._C = shared + step
        else:
            stays = self._stays(match, kept)
            grown = grown + self._own(match, step, stays, 0.0) + self._drift(match)
            if not self._gone:  # all is counted from the first, deskewed by the motion after it
                grown = grown + self._own(match, step, np.eye(6), seconds * 3.0 / 8.0)
            self.own = self._own(match, step, np.eye(6) - stays, seconds / 8.0)
            self._C = shared + stays @ step
        self._gone, self._was_fixed = self._gone + 1, is_fixed(match)
        self.since = grown
        self._misfit.learn(self._misfit_of(match))
        self._count.learn(match.num_inliers)
        self._share.learn(match.share)
        self._square.learn(match.error**2)
        self.T_odom_middle, self.twist = match.T_map_body, twist
        if seconds > 0.0:
            usual = self._usual_s or seconds
            self._V, self._usual_s = step / seconds**2, usual + LEARNING * (seconds - usual)
        self._middle_ns = max(middle_ns, self._middle_ns + round(seconds * 1e9))
        return np.asarray(grown + self.own)

    def _own(self, match: SweepMatch, step: Array, part: Array, since: float) -> Array:
        """Return the covariance (6, 6) of a part (6, 6) of a sweep's own error.

        A change Δξ of the motion from sweep to sweep bends a sweep; where the body was half a sweep
        before its middle, at the stamp, is off by ⅛ Δξ Δt, which is the time given.
        """
        bends = np.zeros((6, 6)) if match.bends is None else match.bends
        bent = part @ bends + since * np.eye(6)
        return np.asarray(part @ step @ part.T + bent @ np.diag(self._unsteady2) @ bent.T)

    def _drift(self, match: SweepMatch) -> Array:
        """Return the covariance (6, 6) that a step adds whatever points say."""
        config = self._config
        way = np.linalg.norm(match.T_map_body[:3, 3] - self.T_odom_middle[:3, 3])
        return np.asarray(way * np.diag(np.repeat([config.drift, config.drift_rad], 3) ** 2))

    def _stays(self, match: SweepMatch, kept: Array) -> Array:
        """Return what (6, 6) of the error of a sweep stays in the map."""
        stays = match.stays
        if stays is None:
            stays = np.sqrt(self._config.renewal) * np.eye(6)
        return np.asarray(kept + stays @ (np.eye(6) - kept))

    def _loose(self, seconds: float, unseen: bool) -> Array:
        """Return the covariance (6, 6) of a step before it is matched."""
        config = self._config
        change = np.array([config.acceleration, config.angular]) * seconds
        if unseen:
            change += np.array([config.unseen, config.unseen_rad])
        V = self._V + np.diag(np.repeat(change, 3) ** 2)
        return np.asarray(V * seconds**2 + FINEST**2 * np.eye(6))


def _sizes(tangent: Array) -> Array:
    """Return how far a tangent (6,) moves, and turns."""
    return np.array([np.linalg.norm(tangent[:3]), np.linalg.norm(tangent[3:])])


def is_fixed(match: SweepMatch) -> bool:
    """Say whether a match says where it is, whatever the rotation."""
    H = match.information
    of_place = H[:3, :3] - H[:3, 3:] @ np.linalg.pinv(H[3:, 3:]) @ H[3:, :3]
    return bool(np.linalg.eigvalsh(of_place)[0] > FIXED**-2)


def _together(loose: Array, information: Array) -> Array:
    """Return (6, 6) of what is unsure by one covariance, and was measured with an information."""
    sure = np.linalg.inv(np.linalg.inv(loose) + information)
    return np.asarray(0.5 * (sure + sure.T))


def _grown(M: Array) -> Array:
    """Return what of a symmetric (6, 6) makes less sure: errors that undo others do not count."""
    values, axes = np.linalg.eigh(M)
    return np.asarray((axes * np.maximum(values, 0.0)) @ axes.T)
