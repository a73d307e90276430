"""States: where the keyframes are. The only world quantities the map keeps.

Everything else hangs from a keyframe, in its units. A keyframe k is placed by a similarity

    p_world = S_k p_k = t_k + s_k R_k p_k,     S_k = (T_world_body, scale) = ((R_k, t_k), s_k)

with s_k = 1 for all sensors that know metres. A frame, landmark or stub at (T, s) relative to k is
at S_k (T, s) = ((R_k R, t_k + s_k R_k t), s_k s) in the world. Correcting a loop, also one that
closes a drift of scale, is then one write of this table, and all that hangs from it follows.
Composition, inverse and action are batched NumPy, O(1) per pose.

Reference: H. Strasdat, J. Montiel, A. Davison, Scale drift-aware large scale monocular SLAM, 2010.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odomap.maps.columns import grown

__all__ = ["States", "act", "act_inverse", "compose", "inverse", "stretched"]

_COLUMNS = ("Ts_world_body", "scales", "v_world_body", "biases", "covariances", "growths")

Placement = tuple[NDArray[np.float64], NDArray[np.float64]]


def compose(a: Placement, b: Placement) -> Placement:
    """Return S_a S_b; each a pair of (..., 4, 4) poses and (...) scales."""
    (T_a, s_a), (T_b, s_b) = a, b
    s = np.asarray(s_a)
    T = T_a @ T_b
    T[..., :3, 3] = T_a[..., :3, 3] + s[..., None] * (T_a[..., :3, :3] @ T_b[..., :3, 3:])[..., 0]
    return T, s * s_b


def inverse(a: Placement) -> Placement:
    """Return the inverse of S = ((R, t), s): ((Rᵀ, -Rᵀ t / s), 1 / s)."""
    T_a, s_a = a
    s = np.asarray(s_a, np.float64)
    T = np.zeros_like(T_a)
    R_t = np.swapaxes(T_a[..., :3, :3], -1, -2)
    T[..., :3, :3] = R_t
    T[..., :3, 3] = -(R_t @ T_a[..., :3, 3:])[..., 0] / s[..., None]
    T[..., 3, 3] = 1.0
    return T, 1.0 / s


def act(a: Placement, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return S p = t + s R p for (N, 3) points and one placement or N of them."""
    T, s = a
    rotated = np.einsum("...ij,...j->...i", T[..., :3, :3], points)
    return np.asarray(T[..., :3, 3] + np.asarray(s)[..., None] * rotated)


def act_inverse(a: Placement, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return S⁻¹ p = Rᵀ (p - t) / s for (N, 3) points and one placement or N of them."""
    T, s = a
    turned = np.einsum("...ji,...j->...i", T[..., :3, :3], points - T[..., :3, 3])
    return np.asarray(turned / np.asarray(s)[..., None])


def stretched(
    covariances: NDArray[np.float64], by: NDArray[np.float64] | float
) -> NDArray[np.float64]:
    """Return covariances (..., 6, 6) of (translation, rotation) with lengths in other units.

    Args:
        covariances: in some units.
        by: (...) how many of the other units one of these is.
    """
    if isinstance(by, float) and by == 1.0:
        return np.array(covariances)
    units = np.ones((*np.shape(by), 6))
    units[..., :3] = np.asarray(by)[..., None]
    return np.asarray(covariances * units[..., :, None] * units[..., None, :])


class States:
    """Table of keyframe states; the row of a keyframe is its id.

    Attributes:
        Ts_world_body: (K, 4, 4) poses.
        scales: (K,) world units per unit of the keyframe.
        v_world_body: (K, 3) velocities, m/s, NaN where unknown.
        biases: (K, 6) gyroscope (rad/s) and accelerometer (m/s²) biases.
        covariances: (K, 6, 6) of T_world_body, tangent (translation, rotation), right update; NaN
            where unknown.
        growths: (K, 6, 6) by what each is less sure than its parent (`growth`), in its own units;
            NaN where unknown, and until somebody has told.
    """

    def __init__(self) -> None:
        self._rows = 0
        self._Ts = np.zeros((0, 4, 4))
        self._scales = np.zeros(0)
        self._velocities = np.zeros((0, 3))
        self._biases = np.zeros((0, 6))
        self._covariances = np.zeros((0, 6, 6))
        self._growths = np.zeros((0, 6, 6))

    def __len__(self) -> int:
        return self._rows

    def extend(self, rows: int) -> None:
        """Make sure that there are at least so many rows."""
        self._Ts = grown(self._Ts, rows)
        self._scales = grown(self._scales, rows)
        self._velocities = grown(self._velocities, rows)
        self._biases = grown(self._biases, rows)
        self._covariances = grown(self._covariances, rows)
        self._growths = grown(self._growths, rows)
        self._rows = max(self._rows, rows)

    @property
    def Ts_world_body(self) -> NDArray[np.float64]:
        """(K, 4, 4) poses, a view that may be written."""
        return self._Ts[: self._rows]

    @property
    def scales(self) -> NDArray[np.float64]:
        """(K,) world units per unit of the keyframe, a view that may be written."""
        return self._scales[: self._rows]

    @property
    def v_world_body(self) -> NDArray[np.float64]:
        """(K, 3) velocities, a view that may be written."""
        return self._velocities[: self._rows]

    @property
    def biases(self) -> NDArray[np.float64]:
        """(K, 6) biases, a view that may be written."""
        return self._biases[: self._rows]

    @property
    def covariances(self) -> NDArray[np.float64]:
        """(K, 6, 6) covariances, a view that may be written."""
        return self._covariances[: self._rows]

    @property
    def growths(self) -> NDArray[np.float64]:
        """(K, 6, 6) growths, a view that may be written."""
        return self._growths[: self._rows]

    def twin(self) -> "States":
        """Return the same table, copied."""
        twin = States()
        twin.restore({name: getattr(self, name) for name in _COLUMNS})
        return twin

    def dump(self) -> dict[str, NDArray[Any]]:
        """Return copies of all columns."""
        return {name: getattr(self, name).copy() for name in _COLUMNS}

    def restore(self, columns: Mapping[str, NDArray[Any]]) -> None:
        """Fill an empty table with what `dump` returned."""
        self.graft(columns, 0)

    def graft(self, columns: Mapping[str, NDArray[Any]], offset: int) -> None:
        """Take in another table; the row of its keyframe k is offset + k here."""
        end = offset + len(columns["scales"])
        self.extend(end)
        for name in _COLUMNS:
            getattr(self, name)[offset:end] = columns[name]

    def placements(self, rows: NDArray[np.int64]) -> Placement:
        """Return copies of the (n, 4, 4) poses and (n,) scales of some rows."""
        return self._Ts.take(rows, axis=0), self._scales.take(rows)

    def move(self, rows: NDArray[np.int64], placements: Placement) -> None:
        """Write new poses and scales, and turn and scale what is expressed with them.

        A velocity turns with its body, v ← (s'/s) R' Rᵀ v. The tangent of a covariance is in the
        body, so it does not turn; its translation scales with s'/s.

        Args:
            rows: (n,) distinct rows.
            placements: (n, 4, 4) poses and (n,) scales.
        """
        Ts, scales = placements
        old = self._Ts[rows]
        ratio = scales / self._scales[rows]
        turn = Ts[:, :3, :3] @ np.swapaxes(old[:, :3, :3], 1, 2)
        turned = (turn @ self._velocities[rows][:, :, None])[..., 0]
        self._velocities[rows] = ratio[:, None] * turned
        if np.any(ratio != 1.0):
            self._covariances[rows] = stretched(self._covariances[rows], ratio)
        self._Ts[rows] = Ts
        self._scales[rows] = scales
