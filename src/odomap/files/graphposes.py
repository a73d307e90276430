"""Poses as the numbers of a graph file, and back, so that nothing moves on the way.

    SE2   x y θ                         θ in (-π, π]
    SE3   x y z qx qy qz qw
    Sim3  x y z qx qy qz qw s           p_world = s R p + t
    Euler x y z roll pitch yaw          R = Rz(yaw) Ry(pitch) Rx(roll), as TORO has it

A rotation matrix holds the same rotation in more numbers than it has freedoms, so that going to
an angle and back changes its last digit, and again every time. Rotations are therefore laid on a
grid when read: angles have 14 decimals; of a quaternion, made of length 1, the three smaller parts
have 14 decimals and the largest, positive, follows from them. What is off by rounding falls back
on the same grid point: a graph that was read is written and read again bit for bit. No rotation
moves by more than 1e-14 rad. Scales have 13 digits. Batched, O(1) per pose.

Reference: J. Diebel, "Representing attitude: Euler angles, unit quaternions, and rotation
vectors", Stanford University 2006.
"""

import numpy as np

from odomap.backend.graphs.posegraph import Group
from odomap.files.graphlines import Array
from odomap.geometry.lie import quaternion_from_rotation, rotation_from_quaternion, so2_exp, so2_log

__all__ = [
    "euler_from_rotation",
    "full_matrices",
    "numbers_from_poses",
    "poses_from_numbers",
    "rotation_from_euler",
    "upper_triangles",
]

DECIMALS = 14
DIGITS = 13
LARGEST_ANGLE = 3.14159265358979
"""π, down on the grid: rounding up would lead to the other side of the circle."""


def poses_from_numbers(numbers: Array, group: Group) -> Array:
    """Return matrices of the numbers of a file.

    Args:
        numbers: (N, 3), (N, 7) or (N, 8) as above; quaternions of any length but 0, scales > 0.
        group: "SE2", "SE3" or "Sim3".

    Returns:
        (N, 3, 3) or (N, 4, 4).
    """
    d = 2 if group == "SE2" else 3
    Ts = np.zeros((len(numbers), d + 1, d + 1))
    Ts[:, :d, d], Ts[:, d, d] = numbers[:, :d], 1.0
    if group == "SE2":
        Ts[:, :2, :2] = so2_exp(_angle(numbers[:, 2]))
        return Ts
    Ts[:, :3, :3] = rotation_from_quaternion(_quaternion(numbers[:, [6, 3, 4, 5]]))
    if group == "Sim3":
        Ts[:, :3, :3] *= _scale(numbers[:, 7])[:, None, None]
    return Ts


def numbers_from_poses(Ts: Array, group: Group) -> Array:
    """Return the numbers of a file, the inverse of `poses_from_numbers`."""
    if group == "SE2":
        return np.column_stack([Ts[:, :2, 2], _angle(so2_log(Ts[:, :2, :2]))])
    R, columns = Ts[:, :3, :3], [Ts[:, :3, 3]]
    scales = []
    if group == "Sim3":
        s = _scale(np.sqrt(np.sum(R * R, axis=(1, 2)) / 3.0))
        R, scales = R / s[:, None, None], [s[:, None]]
    wxyz = _quaternion(quaternion_from_rotation(R))
    return np.concatenate([*columns, wxyz[:, [1, 2, 3, 0]], *scales], axis=1)


def upper_triangles(information: Array) -> Array:
    """Return the upper triangles (N, k (k + 1) / 2) of symmetric matrices, row by row."""
    rows, columns = np.triu_indices(information.shape[1])
    return np.asarray(0.5 * (information[:, rows, columns] + information[:, columns, rows]))


def full_matrices(upper: Array, k: int) -> Array:
    """Return symmetric matrices (N, k, k) of their upper triangles."""
    rows, columns = np.triu_indices(k)
    out = np.empty((len(upper), k, k))
    out[:, rows, columns] = upper
    out[:, columns, rows] = upper
    return out


def rotation_from_euler(angles: Array) -> Array:
    """Return R = Rz(yaw) Ry(pitch) Rx(roll) of (N, 3) roll, pitch, yaw."""
    (sx, sy, sz), (cx, cy, cz) = np.sin(angles).T, np.cos(angles).T
    return np.moveaxis(
        np.array(
            [
                [cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx],
                [sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx],
                [-sy, cy * sx, cy * cx],
            ]
        ),
        -1,
        0,
    )


def euler_from_rotation(R: Array) -> Array:
    """Return (N, 3) roll, pitch, yaw of rotations; full precision also where pitch is ±90°."""
    yaw = np.arctan2(R[:, 1, 0], R[:, 0, 0])
    s, c = np.sin(yaw), np.cos(yaw)
    # What remains when yaw is taken back is well determined, even where yaw alone is not.
    pitch = np.arctan2(-R[:, 2, 0], c * R[:, 0, 0] + s * R[:, 1, 0])
    roll = np.arctan2(s * R[:, 0, 2] - c * R[:, 1, 2], c * R[:, 1, 1] - s * R[:, 0, 1])
    return np.column_stack([roll, pitch, yaw])


def _angle(theta: Array) -> Array:
    """Return angles in (-π, π], on the grid."""
    outside = np.abs(theta) > np.pi
    if outside.any():
        theta = np.where(outside, np.arctan2(np.sin(theta), np.cos(theta)), theta)
    return np.clip(np.round(theta, DECIMALS), -LARGEST_ANGLE, LARGEST_ANGLE) + 0.0  # no -0.0


def _quaternion(wxyz: Array) -> Array:
    """Return quaternions of length 1, the largest part positive, the others on the grid."""
    if not len(wxyz):
        return wxyz
    unit = wxyz / np.abs(wxyz).max(axis=1, keepdims=True)  # so that no square under- or overflows
    unit = unit / np.sqrt(np.sum(unit * unit, axis=1, keepdims=True))
    rows = np.arange(len(unit))
    # Of parts that are equal but for rounding, the first is taken for the largest, always.
    largest = np.argmax(np.round(np.abs(unit), 6), axis=1)
    grid = np.round(unit * np.where(unit[rows, largest] < 0, -1.0, 1.0)[:, None], DECIMALS) + 0.0
    grid[rows, largest] = 0.0
    grid[rows, largest] = np.sqrt(1.0 - np.sum(grid * grid, axis=1))
    return np.asarray(grid)


def _scale(scales: Array) -> Array:
    return np.array([float(f"{s:.{DIGITS - 1}e}") for s in scales], np.float64)
