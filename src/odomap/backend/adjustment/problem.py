"""A bundle adjustment problem as arrays: views, points, lenses, and where points were seen.

View k looks through lens l from T_cw = T_camera_world; point m lies at p. An observation says that
it appeared at pixel u, of standard deviation 1/w. The best views, points and lenses minimise

    ½ Σ_o ρ( ‖ w_o ( π(θ_l, T_cw p) - u_o ) ‖² ),

with some views, points or numbers θ of the lenses held fixed. Where depth was measured too, its
inverse δ with weight v, a residual has a third part, v (1 / P_z - δ). The lens models π are those
of `geometry.camera`, and that of the BAL data sets, whose camera looks along -z:

    P = T_cw p,   q = -(P_x, P_y) / P_z,   π = f (1 + k₁|q|² + k₂|q|⁴) q.

This module holds the problem and refuses what cannot be one; `adjustment` solves it.

Reference: S. Agarwal, N. Snavely, S. Seitz, R. Szeliski, "Bundle adjustment in the large",
ECCV 2010 (BAL).
"""

from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from odomap.errors import InputError, nearest_name
from odomap.geometry.camera import MODELS

__all__ = ["BAL", "Adjustment", "num_parameters"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

BAL = "bal"
"""Name of the lens model f k1 k2 of the data sets "Bundle adjustment in the large"."""

_ROTATION = 1e-4
"""How far RᵀR may be from I."""
_BELOW = 1e-9
"""How far the last row of a transform may be from 0 0 0 1."""


@dataclass(frozen=True, eq=False)
class Adjustment:
    """A bundle adjustment problem, as arrays.

    What is not given has the default; after construction all arrays have the shapes said here.

    Attributes:
        Ts_camera_world: (K, 4, 4) of each view.
        points_world: (M, 3).
        view, point: (N,) which view saw which point.
        pixels: (N, 2) where.
        intrinsics: (L, P) numbers of each lens: f k1 k2 of "bal"; otherwise fx fy cx cy and then
            the coefficients of the model, as in `Camera`. Rows of several models are padded.
        model: name of the lens model, or a tuple of L names; "bal" or a key of `MODELS`.
        lens: (K,) through which lens each view looks. Default: the only one, or, if there are as
            many as views, one each.
        weights: (N,) inverse standard deviations of the pixels, or one for all. Default 1.
        is_fixed_view: (K,) bool, or one for all; views to hold. Default none.
        is_fixed_point: (M,) bool, or one for all; points to hold. Default none.
        is_free_intrinsic: (L, P) bool, (L, 1), (P,) or one for all: numbers of the lenses to
            adjust. Default none.
        inverse_depths: (N,) measured inverse depths along the views' axes, 1/m; NaN for one that
            was not measured. Default none.
        depth_weights: (N,) inverse standard deviations of these, m, or one for all. Default 1 with
            inverse depths, else none.

    Raises:
        InputError: shapes, indices, numbers that are not finite, an unknown model.

    Example:
        >>> T = np.tile(np.eye(4), (2, 1, 1))
        >>> T[1, 0, 3] = -1.0
        >>> problem = Adjustment(T, [[0.5, 0, 5]], [0, 1], [0, 0], [[370, 240], [270, 240]],
        ...                      [[500.0, 500, 320, 240]])
        >>> problem.num_views, problem.num_points, problem.num_observations
        (2, 1, 2)
    """

    Ts_camera_world: Array
    points_world: Array
    view: Index
    point: Index
    pixels: Array
    intrinsics: Array
    model: str | tuple[str, ...] = "pinhole"
    lens: Index = None  # type: ignore[assignment]
    weights: Array = 1.0  # type: ignore[assignment]
    is_fixed_view: Mask = False  # type: ignore[assignment]
    is_fixed_point: Mask = False  # type: ignore[assignment]
    is_free_intrinsic: Mask = False  # type: ignore[assignment]
    inverse_depths: Array | None = None
    depth_weights: Array | None = None

    def __post_init__(self) -> None:
        Ts = self._set("Ts_camera_world", _reals(self.Ts_camera_world, (4, 4), "Ts_camera_world"))
        points = self._set("points_world", _reals(self.points_world, (3,), "points_world"))
        pixels = self._set("pixels", _reals(self.pixels, (2,), "pixels"))
        intrinsics = np.array(self.intrinsics, np.float64, ndmin=2)
        self._set("intrinsics", _reals(intrinsics, intrinsics.shape[1:], "intrinsics"))
        k, m, n = len(Ts), len(points), len(pixels)
        if not (k and m and n):
            raise InputError(f"adjustment: {k} views, {m} points, {n} observations: nothing to do")
        self._set("view", _indices(self.view, (n, k), "view"))
        self._set("point", _indices(self.point, (n, m), "point"))
        self._set("lens", _indices(self._default_lens(k), (k, len(intrinsics)), "lens"))
        self._set("weights", _spread(np.asarray(self.weights, np.float64), (n,), "weights"))
        if self.inverse_depths is not None:
            deep = 1.0 if self.depth_weights is None else self.depth_weights
            depths = np.asarray(self.inverse_depths, np.float64)
            self._set("inverse_depths", _broadcast(depths, (n,), "inverse_depths"))
            self._set("depth_weights", _spread(np.asarray(deep), (n,), "depth_weights"))
        for name, shape in (
            ("is_fixed_view", (k,)),
            ("is_fixed_point", (m,)),
            ("is_free_intrinsic", intrinsics.shape),
        ):
            self._set(name, _spread(np.asarray(getattr(self, name), np.bool_), shape, name))
        self._check()

    @property
    def num_views(self) -> int:
        """K."""
        return len(self.Ts_camera_world)

    @property
    def num_points(self) -> int:
        """M."""
        return len(self.points_world)

    @property
    def num_observations(self) -> int:
        """N."""
        return len(self.pixels)

    @property
    def has_depth(self) -> Mask:
        """(N,) whether the depth of an observation was measured, and counts."""
        if self.inverse_depths is None or self.depth_weights is None:
            return np.zeros(self.num_observations, np.bool_)
        return np.asarray(~np.isnan(self.inverse_depths) & (self.depth_weights > 0.0))

    def some(self, rows: Mask) -> "Adjustment":
        """Return the problem with some of its observations, rows (N,)."""
        depths, deep = self.inverse_depths, self.depth_weights
        return replace(
            self,
            view=self.view[rows],
            point=self.point[rows],
            pixels=self.pixels[rows],
            weights=self.weights[rows],
            inverse_depths=None if depths is None else depths[rows],
            depth_weights=None if deep is None else deep[rows],
        )

    @property
    def models(self) -> tuple[str, ...]:
        """Name of the model of each lens, (L,)."""
        if isinstance(self.model, str):
            return (self.model,) * len(self.intrinsics)
        return tuple(self.model)

    def _set(self, name: str, value: NDArray[np.generic]) -> NDArray[np.generic]:
        object.__setattr__(self, name, value)
        return value

    def _default_lens(self, k: int) -> ArrayLike:
        given = cast("ArrayLike | None", self.lens)
        if given is not None:
            return given
        if len(self.intrinsics) == 1:
            return np.zeros(k, np.int64)
        if len(self.intrinsics) == k:
            return np.arange(k)
        raise InputError(f"adjustment: lens: say which of {len(self.intrinsics)} each view has")

    def _check(self) -> None:
        R = self.Ts_camera_world[:, :3, :3]
        error = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2))
        if error.max() > _ROTATION or np.linalg.det(R).min() < 0:
            bad = int(np.argmax(np.where(np.linalg.det(R) < 0, np.inf, error)))
            raise InputError(f"adjustment: Ts_camera_world[{bad}] is not a rotation and a place")
        below = np.abs(self.Ts_camera_world[:, 3] - [0.0, 0.0, 0.0, 1.0]).max(axis=1)
        if below.max() > _BELOW:
            bad = int(np.argmax(below))
            raise InputError(f"adjustment: Ts_camera_world[{bad}]: its last row is not 0 0 0 1")
        for name, weights in (("weights", self.weights), ("depth_weights", self.depth_weights)):
            if weights is not None and weights.min() < 0:
                raise InputError(f"adjustment: {name}: a standard deviation is not negative")
        if self.inverse_depths is not None and np.isinf(self.inverse_depths).any():
            raise InputError(
                "adjustment: inverse_depths: one is infinite; one that is not known is NaN"
            )
        if len(self.models) != len(self.intrinsics):
            raise InputError(
                f"adjustment: model: {len(self.models)} names for {len(self.intrinsics)} lenses"
            )
        for name in dict.fromkeys(self.models):
            num_parameters(name, self.intrinsics.shape[1])


def num_parameters(model: str, width: int) -> int:
    """Return how many of `width` columns of intrinsics a lens model uses.

    Args:
        model: "bal" or a key of `MODELS`.
        width: columns there are; a pinhole takes as many coefficients as they hold.

    Raises:
        InputError: an unknown model, or too few columns.

    Example:
        >>> num_parameters("pinhole", 9), num_parameters("double_sphere", 9)
        (9, 6)
    """
    if model == BAL:
        counts: tuple[int, ...] = (3,)
    elif model in MODELS:
        counts = tuple(4 + length for length in MODELS[model].lengths)
    else:
        known = (BAL, *MODELS)
        hint = nearest_name(str(model), known)
        raise InputError(
            f"adjustment: model: '{model}' is unknown{hint}; known are {', '.join(known)}"
        )
    fitting = [count for count in counts if count <= width]
    if not fitting:
        raise InputError(
            f"adjustment: intrinsics: {width} numbers per lens, {model} has {counts[0]} or more"
        )
    return max(fitting)


def _reals(values: ArrayLike, tail: tuple[int, ...], name: str) -> Array:
    """Return a fresh contiguous (n, *tail) float64 array."""
    try:
        array = np.array(values, dtype=np.float64, order="C")
    except (TypeError, ValueError):
        raise InputError(f"adjustment: {name}: not an array of numbers") from None
    if array.size == 0:
        array = array.reshape(0, *tail)
    if array.shape[1:] != tail:
        wanted = ", ".join(map(str, ("n", *tail)))
        raise InputError(f"adjustment: {name}: has shape {array.shape}, give ({wanted})")
    finite = np.isfinite(array)
    if not finite.all():
        row = int(np.argwhere(~finite)[0, 0])
        raise InputError(f"adjustment: {name}: row {row} holds a value that is not finite")
    return array


def _indices(values: ArrayLike, size: tuple[int, int], name: str) -> Index:
    """Return (n,) int64 that name some of a number of things."""
    n, count = size
    array = np.asarray(values)
    if array.shape != (n,) or not np.issubdtype(array.dtype, np.integer):
        raise InputError(
            f"adjustment: {name}: has shape {array.shape} of {array.dtype}, give ({n},) integers"
        )
    bad = (array < 0) | (array >= count)
    if bad.any():
        row = int(np.argmax(bad))
        raise InputError(f"adjustment: {name}: row {row} is {array[row]}, of {count} there are")
    return np.array(array, np.int64, order="C")


def _spread(values: NDArray[np.generic], shape: tuple[int, ...], name: str) -> NDArray[np.generic]:
    """Return a fresh array of that shape, what was given repeated."""
    if values.dtype == np.float64 and not np.isfinite(values).all():
        raise InputError(f"adjustment: {name} holds a value that is not finite")
    return _broadcast(values, shape, name)


def _broadcast(
    values: NDArray[np.generic], shape: tuple[int, ...], name: str
) -> NDArray[np.generic]:
    try:
        return np.array(np.broadcast_to(values, shape), order="C")
    except ValueError:
        raise InputError(f"adjustment: {name}: has shape {values.shape}, give {shape}") from None
