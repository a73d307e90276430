"""How sure a bundle adjustment is of its views.

At the solution the normal equations are the information of all unknowns. With points and what else
is not asked for marginalised, the covariance of the chosen views is a part of the inverse of the
reduced matrix, S = A - W C⁻¹ Wᵀ, undamped:

    Σ = E S⁻¹ Eᵀ,    E picks the rows of the views.

It is found by solving S X = Eᵀ with the sparse factor, six columns per view; S⁻¹ is never made.
The gauge is held as `gauge` says, and Σ is relative to what is held: zero for that.

Cost: one factorisation and six solves per view.

Reference: B. Triggs et al., "Bundle adjustment - a modern synthesis", 1999, sections 6 and 9.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from odomap.backend.adjustment.descent import Descent, checked_loss, state_of
from odomap.backend.adjustment.gauge import find_gauge
from odomap.backend.adjustment.layout import lay_out
from odomap.backend.adjustment.problem import Adjustment
from odomap.backend.adjustment.reduced import Factored
from odomap.errors import InputError
from odomap.geometry.robust import Loss

__all__ = ["ViewCovariance", "view_covariance"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class ViewCovariance:
    """The covariance of some views, given what is held.

    Attributes:
        views: (Q,) which.
        joint: (6Q, 6Q) of all together, in order; tangent (translation, rotation) of
            T_world_camera, right update: in the axes of each camera.
        intrinsics: (Q, P, P) of the numbers of their lenses; zero where held.
        is_held: (K, 6) coordinates of views that hold the gauge, besides the fixed views.
    """

    views: Index
    joint: Array
    intrinsics: Array
    is_held: Mask

    @property
    def covariances(self) -> Array:
        """(Q, 6, 6) of each view alone."""
        q = len(self.views)
        blocks = self.joint.reshape(q, 6, q, 6)
        return np.ascontiguousarray(blocks[np.arange(q), :, np.arange(q)])


def view_covariance(
    problem: Adjustment, views: ArrayLike, loss: Loss | None = None
) -> ViewCovariance:
    """Return the covariance of some views of a problem that is solved.

    Args:
        problem: at its solution, such as `AdjustmentSolution.problem`; weights that say the truth.
        views: (Q,) indices.
        loss: as it was solved with.

    Returns:
        Covariances; of a fixed view zero.

    Raises:
        InputError: a view that does not exist or sees nothing, or one not held by what it sees.
    """
    given = np.atleast_1d(np.asarray(views))
    if given.ndim != 1 or not (np.issubdtype(given.dtype, np.integer) or given.size == 0):
        raise InputError(
            f"view covariance: views: an array {given.shape} of {given.dtype}, give (Q,) indices"
        )
    chosen = given.astype(np.int64)
    loss = checked_loss(loss)
    gauge = find_gauge(problem)
    bad = (chosen < 0) | (chosen >= problem.num_views)
    if bad.any():
        raise InputError(f"view covariance: views: {chosen[bad][:1]} of {problem.num_views}")
    if (gauge.part[chosen] < 0).any():
        raise InputError(f"view covariance: view {chosen[gauge.part[chosen] < 0][0]} sees nothing")
    layout = lay_out(problem, gauge.is_held)
    reduced = Factored(layout, problem.lens)
    descent = Descent(state_of(problem, layout), layout, loss, reduced)
    values, _ = reduced.assemble(descent.linearise(0.0), 0.0)
    if not reduced.factor.factor(values):
        raise InputError(
            "view covariance: the system is singular: a view or a lens is not held by what is seen"
        )
    blocks, scale = layout.blocks, descent.system.scale
    width = problem.intrinsics.shape[1]
    rows = np.full((len(chosen), 6 + width), -1)
    for r, k in enumerate(chosen):
        b, q = blocks.pose[k], problem.lens[k]
        if b >= 0:
            rows[r, :6] = blocks.row[b] + np.arange(6)
        if blocks.lens[q] >= 0:
            used = int(descent.state.lenses.used[q])
            at = blocks.row[blocks.lens[q]] + blocks.lens_row[q]
            rows[r, 6 : 6 + used] = at + np.arange(used)
    rows[rows >= 0] = np.where(blocks.is_held[rows[rows >= 0]], -1, rows[rows >= 0])
    inverse = _part_of_inverse(reduced, rows.reshape(-1), scale)
    q, size = len(chosen), 6 + width
    whole = inverse.reshape(q, size, q, size)
    joint = whole[:, :6, :, :6].reshape(6 * q, 6 * q)
    intrinsics = whole[np.arange(q), 6:, np.arange(q), 6:]
    return ViewCovariance(chosen, joint.copy(), np.ascontiguousarray(intrinsics), gauge.is_held)


def _part_of_inverse(reduced: Factored, rows: Index, scale: Array) -> Array:
    """Return rows and columns (R, R) of the inverse, in unscaled unknowns; zero for rows of -1."""
    wanted = np.unique(rows[rows >= 0])
    columns = np.zeros((reduced.pattern.size, len(wanted)))
    columns[wanted, np.arange(len(wanted))] = scale[wanted]
    solved = reduced.factor.solve(columns)[wanted] * scale[wanted, None]
    solved = 0.5 * (solved + solved.T)
    place = np.searchsorted(wanted, np.maximum(rows, 0)) % max(len(wanted), 1)
    out = solved[np.ix_(place, place)] if len(wanted) else np.zeros((len(rows), len(rows)))
    missing = rows < 0
    out[missing], out[:, missing] = 0.0, 0.0
    return np.asarray(out)
