"""What a sensor beside a pose measured, said of the pose itself.

A g2o file may put a sensor at P = T_node_sensor (PARAMS_SE3OFFSET) and let it measure its place in
the world, or a landmark. A pose graph has no such offsets, and needs none: the same is said by

    T_world_node = T_world_sensor P⁻¹,       I_node = Ad(P⁻¹)ᵀ I_sensor Ad(P⁻¹),
    p_node = P p_sensor,                     I_node = R_P I_sensor R_Pᵀ,

since log(P⁻¹ exp(ξ) P) = Ad(P⁻¹) ξ. Rows whose offset is the identity are not touched.

Reference: J. Solà, J. Deray, D. Atchuthan, "A micro Lie theory for state estimation in robotics",
arXiv:1812.01537, 2018.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from odomap.errors import InputError
from odomap.files.graphlines import Array, Index, Rows
from odomap.files.graphposes import (
    full_matrices,
    numbers_from_poses,
    poses_from_numbers,
    upper_triangles,
)
from odomap.geometry.lie import se3_adjoint, se3_inverse

__all__ = ["priors_at_node", "sights_at_node"]


def priors_at_node(file: Path, offsets: Rows, priors: Rows) -> Rows:
    """Return priors of nodes for those of sensors; the offsets' names are taken off.

    Args:
        file: for messages.
        offsets: PARAMS_SE3OFFSET: name; pose.
        priors: node, offset; pose, upper triangle of the information.

    Raises:
        InputError: an offset is not there.
    """
    numbers = priors.numbers.copy()
    Ps, moved = _offsets(file, offsets, priors)
    if len(moved):
        inverse = se3_inverse(Ps[moved])
        adjoint = se3_adjoint(inverse)
        Ts = poses_from_numbers(numbers[moved, :7], "SE3") @ inverse
        information = np.swapaxes(adjoint, 1, 2) @ full_matrices(numbers[moved, 7:], 6) @ adjoint
        numbers[moved] = np.column_stack(
            [numbers_from_poses(Ts, "SE3"), upper_triangles(information)]
        )
    return replace(priors, ids=priors.ids[:, :-1], numbers=numbers)


def sights_at_node(file: Path, offsets: Rows, sights: Rows) -> Rows:
    """Return sights by nodes for those by sensors; arguments as `priors_at_node`."""
    numbers = sights.numbers.copy()
    Ps, moved = _offsets(file, offsets, sights)
    if len(moved):
        R, t = Ps[moved, :3, :3], Ps[moved, :3, 3]
        points = np.einsum("nij,nj->ni", R, numbers[moved, :3]) + t
        information = R @ full_matrices(numbers[moved, 3:], 3) @ np.swapaxes(R, 1, 2)
        numbers[moved] = np.column_stack([points, upper_triangles(information)])
    return replace(sights, ids=sights.ids[:, :-1], numbers=numbers)


def _offsets(file: Path, offsets: Rows, rows: Rows) -> tuple[Array, Index]:
    """Return T_node_sensor (n, 4, 4) of each row, and which rows it moves."""
    # A file without any offset means the sensor on the pose, which g2o itself calls 0.
    if not len(offsets) or not len(rows):
        return np.tile(np.eye(4), (len(rows), 1, 1)), np.zeros(0, np.int64)
    zero = np.abs(offsets.numbers[:, 3:]).max(axis=1) == 0.0
    if zero.any():
        line = offsets.lines[int(np.argmax(zero))]
        raise InputError(f"{file}:{line}: a quaternion of zeros: is its order x y z w?")
    order = np.argsort(offsets.ids[:, 0], kind="stable")
    names, wanted = offsets.ids[order, 0], rows.ids[:, -1]
    same = np.flatnonzero(np.diff(names) == 0)
    if len(same):
        line = offsets.lines[order[same[0] + 1]]
        raise InputError(f"{file}:{line}: offset {names[same[0]]} is there twice: remove one")
    place = np.minimum(np.searchsorted(names, wanted), len(names) - 1)
    missing = names[place] != wanted
    if missing.any():
        row = int(np.argmax(missing))
        raise InputError(
            f"{file}:{rows.lines[row]}: offset {wanted[row]} is declared nowhere: "
            "is its PARAMS_SE3OFFSET line missing?"
        )
    Ps = poses_from_numbers(offsets.numbers, "SE3")[order][place]
    return Ps, np.flatnonzero((np.eye(4) != Ps).any(axis=(1, 2)))
