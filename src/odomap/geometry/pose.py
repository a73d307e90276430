"""Poses as values: SO3, SE2, SE3, Sim3.

The problem: a pose is handed around a whole system, so it must not change under anybody's feet,
must not drift away from being a rotation, and should read as mathematics: letters cancel in

    T_world_camera = T_world_body @ T_body_camera          p_world = T_world_camera @ p_camera

Each class is a frozen value around one read-only matrix (T_a_b maps coordinates of b to a). A
matrix from outside is checked: shape, finite, rotation part orthonormal to 1e-6, then projected to
the nearest rotation; results of `@` are pulled back by one Newton step of the polar decomposition,
R ← R (3I - RᵀR) / 2, whose error is the square of the drift. Arrays of poses are plain (N, 4, 4)
stacks with the functions of `lie`; a product of values costs 20 µs and exp or log 0.1 ms, so use
stacks in loops.

Reference: N. J. Higham, "Computing the polar decomposition, with applications", SIAM J. Sci. Stat.
Comput. 7(4), 1986.
"""

from dataclasses import dataclass
from typing import ClassVar, Self, overload

import numpy as np
from numpy.typing import ArrayLike

from odomap.errors import InputError
from odomap.geometry import lie
from odomap.geometry.so3 import Array

__all__ = ["SE2", "SE3", "SO3", "Sim3"]

_TOLERANCE = 1e-6
"""How far RᵀR may be from I in a matrix given from outside."""

_ROUNDING = 4e-15
"""A matrix this close is kept bit for bit, so that values survive a round trip."""


_IDENTITY = {n: np.eye(n) for n in (2, 3, 4)}


def _is_reflection(R: Array) -> bool:
    """Say whether the determinant of R (2, 2) or (3, 3) is negative."""
    if len(R) == 2:
        (a, b), (c, d) = R.tolist()
        return bool(a * d < b * c)
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    return bool(a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g) < 0.0)


def _polished(R: Array) -> Array:
    """Take one Newton step towards the nearest rotation."""
    return np.asarray(0.5 * R @ (3.0 * np.eye(R.shape[-1]) - R.T @ R))


@dataclass(frozen=True, eq=False, repr=False)
class _Motion:
    """What the four values share: a checked, read-only matrix and its algebra."""

    matrix: Array

    _size: ClassVar[int]
    _space: ClassVar[int]

    def __post_init__(self) -> None:
        name, n = type(self).__name__, self._size
        try:
            given = np.array(self.matrix, dtype=np.float64)
        except (TypeError, ValueError):
            raise InputError(f"{name}: not a matrix of numbers, give ({n}, {n})") from None
        if given.shape != (n, n):
            raise InputError(f"{name}: matrix has shape {given.shape}, give ({n}, {n})")
        if not np.isfinite(given).all():
            raise InputError(f"{name}: matrix has NaN or infinite entries")
        self._check(given)
        self._freeze(given)

    def _check(self, given: Array) -> None:
        """Raise unless `given` is of the group to 1e-6, then make it so exactly, in place."""
        name, d = type(self).__name__, self._space
        last = _IDENTITY[self._size][d:]
        if given[d:].tolist() != last.tolist() and np.abs(given[d:] - last).max() > 1e-9:
            raise InputError(f"{name}: last row is {given[d].tolist()}, must be 0 … 0 1")
        scale = self._scale_of(given)
        R = given[:d, :d] / scale
        error = float(np.abs(R.T @ R - _IDENTITY[d]).max())
        if error > _TOLERANCE or _is_reflection(R):
            kind = "a reflection" if error <= _TOLERANCE else f"off by {error:.1e}"
            raise InputError(f"{name}: not a rotation ({kind}); transposed, or rounded too far?")
        if error > _ROUNDING:
            given[:d, :d] = scale * lie.orthonormalize(R)
        given[d:] = last

    def _scale_of(self, given: Array) -> float:
        return 1.0

    def _freeze(self, matrix: Array) -> None:
        matrix.setflags(write=False)
        object.__setattr__(self, "matrix", matrix)

    @classmethod
    def _trusted(cls, matrix: Array) -> Self:
        """Wrap a matrix that is known to be of the group."""
        value = object.__new__(cls)
        value._freeze(np.ascontiguousarray(matrix))
        return value

    @classmethod
    def identity(cls) -> Self:
        """Return the motion that moves nothing."""
        return cls._trusted(np.eye(cls._size))

    @property
    def R(self) -> Array:
        """The rotation, read-only."""
        return self.matrix[: self._space, : self._space]

    @overload
    def __matmul__(self, other: Self) -> Self: ...
    @overload
    def __matmul__(self, other: ArrayLike) -> Array: ...
    def __matmul__(self, other: "Self | ArrayLike") -> "Self | Array":
        """Compose with the same class, or map points (N, d) or (d,)."""
        if isinstance(other, _Motion):
            if type(other) is not type(self):
                ours, theirs = type(self).__name__, type(other).__name__
                raise InputError(f"{ours} @ {theirs}: compose values of one class")
            return self._compose(other)
        return self._apply(np.asarray(other, dtype=np.float64))

    def _compose(self, other: "_Motion") -> Self:
        product = self.matrix @ other.matrix
        d = self._space
        product[:d, :d] = _polished(product[:d, :d])
        return self._trusted(product)

    def _apply(self, points: Array) -> Array:
        d = self._space
        if points.ndim not in (1, 2) or points.shape[-1] != d:
            name, shape = type(self).__name__, points.shape
            raise InputError(f"{name} @ points: have shape {shape}, give (N, {d}) or ({d},)")
        moved = points @ self.matrix[:d, :d].T
        return np.asarray(moved if self._size == d else moved + self.matrix[:d, d])

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, _Motion) or type(other) is not type(self):
            return NotImplemented
        return np.array_equal(self.matrix, other.matrix)

    def __hash__(self) -> int:
        return hash((type(self), (self.matrix + 0.0).tobytes()))

    def __reduce__(self) -> tuple[object, ...]:
        return _rebuilt, (type(self), self.matrix)


def _rebuilt(cls: type[_Motion], matrix: Array) -> _Motion:
    """Restore a pickled or copied value bit for bit."""
    return cls._trusted(np.array(matrix))


class _Moving(_Motion):
    """A motion that also translates."""

    @property
    def t(self) -> Array:
        """The translation, metres, read-only."""
        return self.matrix[: self._space, self._space]


def _numbers(values: Array) -> str:
    return ", ".join(f"{v:.6g}" for v in np.ravel(values) + 0.0)


class SO3(_Motion):
    """A rotation in space.

    Args:
        matrix: (3, 3) rotation matrix.

    Raises:
        InputError: wrong shape, not finite, or not a rotation to 1e-6.
    """

    _size, _space = 3, 3

    @classmethod
    def exp(cls, phi: ArrayLike) -> "SO3":
        """Return the rotation by the vector phi (3,), rad."""
        return cls._trusted(lie.so3_exp(_finite(phi, 3)))

    @classmethod
    def from_quaternion(cls, wxyz: ArrayLike) -> "SO3":
        """Return the rotation of a quaternion w x y z (4,) of any length but 0."""
        return cls._trusted(lie.rotation_from_quaternion(_finite(wxyz, 4)))

    @property
    def quaternion(self) -> Array:
        """(4,) w x y z, w ≥ 0."""
        return lie.quaternion_from_rotation(self.matrix)

    def inverse(self) -> "SO3":
        """Return the rotation back."""
        return self._trusted(self.matrix.T)

    def log(self) -> Array:
        """Return the rotation vector (3,), rad, of length 0 to π."""
        return lie.so3_log(self.matrix)

    def adjoint(self) -> Array:
        """Return Ad (3, 3), the matrix itself."""
        return self.matrix

    def __repr__(self) -> str:
        return f"SO3(quaternion=[{_numbers(self.quaternion)}])"


class SE2(_Moving):
    """A rigid motion of the plane.

    Args:
        matrix: (3, 3) [[R, t], [0, 1]].

    Raises:
        InputError: wrong shape, not finite, or not a rigid motion to 1e-6.
    """

    _size, _space = 3, 2

    @classmethod
    def exp(cls, xi: ArrayLike) -> "SE2":
        """Return the motion of a twist (3,) x, y, θ."""
        return cls._trusted(lie.se2_exp(_finite(xi, 3)))

    @classmethod
    def from_parts(cls, theta: float, t: ArrayLike) -> "SE2":
        """Return the motion that turns by theta (rad) and then shifts by t (2,) metres."""
        matrix = np.eye(3)
        matrix[:2, :2], matrix[:2, 2] = lie.so2_exp(_finite([theta], 1)[0]), _finite(t, 2)
        return cls._trusted(matrix)

    @property
    def theta(self) -> float:
        """The heading in (-π, π], rad."""
        return float(lie.so2_log(self.R))

    def inverse(self) -> "SE2":
        """Return the motion back."""
        return self._trusted(lie.se2_inverse(self.matrix))

    def log(self) -> Array:
        """Return the twist (3,) x, y, θ."""
        return lie.se2_log(self.matrix)

    def adjoint(self) -> Array:
        """Return Ad (3, 3)."""
        return lie.se2_adjoint(self.matrix)

    def __repr__(self) -> str:
        return f"SE2(t=[{_numbers(self.t)}], theta={self.theta:.6g})"


class SE3(_Moving):
    """A rigid motion in space.

    Args:
        matrix: (4, 4) [[R, t], [0, 1]], metres.

    Raises:
        InputError: wrong shape, not finite, or not a rigid motion to 1e-6.

    Example:
        >>> T_world_body = SE3.from_parts(np.eye(3), [1.0, 0.0, 0.0])
        >>> (T_world_body @ T_world_body).t
        array([2., 0., 0.])
    """

    _size, _space = 4, 3

    @classmethod
    def exp(cls, xi: ArrayLike) -> "SE3":
        """Return the motion of a twist (6,): translation, rotation."""
        return cls._trusted(lie.se3_exp(_finite(xi, 6)))

    @classmethod
    def from_parts(cls, R: ArrayLike, t: ArrayLike) -> "SE3":
        """Return the motion that turns by R (3, 3) and then shifts by t (3,) metres."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = SO3(np.asarray(R)).matrix, _finite(t, 3)
        return cls._trusted(matrix)

    @classmethod
    def from_quaternion(cls, wxyz: ArrayLike, t: ArrayLike) -> "SE3":
        """Return the motion of a quaternion w x y z (4,) and a shift t (3,) metres."""
        matrix = np.eye(4)
        matrix[:3, :3] = lie.rotation_from_quaternion(_finite(wxyz, 4))
        matrix[:3, 3] = _finite(t, 3)
        return cls._trusted(matrix)

    @property
    def quaternion(self) -> Array:
        """(4,) w x y z, w ≥ 0."""
        return lie.quaternion_from_rotation(self.R)

    def inverse(self) -> "SE3":
        """Return the motion back."""
        return self._trusted(lie.se3_inverse(self.matrix))

    def log(self) -> Array:
        """Return the twist (6,): translation, rotation."""
        return lie.se3_log(self.matrix)

    def adjoint(self) -> Array:
        """Return Ad (6, 6)."""
        return lie.se3_adjoint(self.matrix)

    def __repr__(self) -> str:
        return f"SE3(t=[{_numbers(self.t)}], quaternion=[{_numbers(self.quaternion)}])"


class Sim3(_Moving):
    """A similarity in space.

    Args:
        matrix: (4, 4) [[sR, t], [0, 1]], s > 0.

    Raises:
        InputError: wrong shape, not finite, or not a similarity to 1e-6.
    """

    _size, _space = 4, 3

    @classmethod
    def exp(cls, xi: ArrayLike) -> "Sim3":
        """Return the similarity of a twist (7,): translation, rotation, log of the scale."""
        return cls._trusted(lie.sim3_exp(_finite(xi, 7)))

    @classmethod
    def from_parts(cls, scale: float, R: ArrayLike, t: ArrayLike) -> "Sim3":
        """Return the similarity p → scale · R p + t."""
        if not (np.isfinite(scale) and scale > 0):
            raise InputError(f"Sim3: the scale is {scale}, must be above 0")
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = scale * SO3(np.asarray(R)).matrix, _finite(t, 3)
        return cls._trusted(matrix)

    def _scale_of(self, given: Array) -> float:
        scale = float(np.cbrt(np.linalg.det(given[:3, :3])))
        if scale == 0:
            raise InputError("Sim3: the scale is 0, must be above 0")
        return abs(scale)

    def _compose(self, other: _Motion) -> "Sim3":
        product = self.matrix @ other.matrix
        scale = float(np.cbrt(np.linalg.det(product[:3, :3])))
        product[:3, :3] = scale * _polished(product[:3, :3] / scale)
        return self._trusted(product)

    @property
    def scale(self) -> float:
        """The scale s > 0."""
        return float(np.cbrt(np.linalg.det(self.matrix[:3, :3])))

    @property
    def R(self) -> Array:
        """The rotation (3, 3), without the scale."""
        return np.asarray(self.matrix[:3, :3] / self.scale)

    @property
    def quaternion(self) -> Array:
        """(4,) w x y z, w ≥ 0."""
        return lie.quaternion_from_rotation(self.R)

    def inverse(self) -> "Sim3":
        """Return the similarity back."""
        return self._trusted(lie.sim3_inverse(self.matrix))

    def log(self) -> Array:
        """Return the twist (7,): translation, rotation, log of the scale."""
        return lie.sim3_log(self.matrix)

    def adjoint(self) -> Array:
        """Return Ad (7, 7)."""
        return lie.sim3_adjoint(self.matrix)

    def __repr__(self) -> str:
        quaternion = _numbers(self.quaternion)
        return f"Sim3(scale={self.scale:.6g}, t=[{_numbers(self.t)}], quaternion=[{quaternion}])"


def _finite(values: ArrayLike, n: int) -> Array:
    """Return (n,) finite numbers, or say what is wrong."""
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"pose: {values!r} is not a list of {n} numbers") from None
    if array.shape != (n,) or not np.all(np.isfinite(array)):
        raise InputError(f"pose: {array.tolist()} must be {n} finite numbers")
    return array
