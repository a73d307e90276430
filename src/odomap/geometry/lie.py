"""The Lie groups of poses under one roof: SO(2), SE(2), SO(3), SE(3), Sim(3).

The problem: poses do not add. Each group has a flat tangent in which errors, steps and covariances
live, and exp and log that lead there and back. This page gathers the chapters, all NumPy, all
batched over leading dimensions:

    so3   rotations, quaternions, `hat`, `vee`      tangent φ = (rotation), rad
    se2   the plane                                 tangent (x, y, θ)
    se3   rigid motions                             tangent (translation, rotation)
    sim3  rigid motions with scale                  tangent (translation, rotation, log scale)

Updates are on the right, T exp(ξ); J_l and J_r satisfy exp(ξ + δ) ≈ exp(J_l δ) exp(ξ)
≈ exp(ξ) exp(J_r δ), with J_r(ξ) = J_l(-ξ) and J_l(ξ) = Ad(exp ξ) J_r(ξ).

Reference: J. Solà, J. Deray, D. Atchuthan, "A micro Lie theory for state estimation in robotics",
arXiv:1812.01537, 2018.
"""

from odomap.geometry.se2 import (
    se2_adjoint,
    se2_exp,
    se2_inverse,
    se2_left_jacobian,
    se2_left_jacobian_inverse,
    se2_log,
    se2_right_jacobian,
    se2_right_jacobian_inverse,
    so2_exp,
    so2_log,
)
from odomap.geometry.se3 import (
    se3_adjoint,
    se3_exp,
    se3_inverse,
    se3_left_jacobian,
    se3_left_jacobian_inverse,
    se3_log,
    se3_right_jacobian,
    se3_right_jacobian_inverse,
)
from odomap.geometry.sim3 import (
    sim3_adjoint,
    sim3_exp,
    sim3_inverse,
    sim3_left_jacobian,
    sim3_left_jacobian_inverse,
    sim3_log,
    sim3_right_jacobian,
    sim3_right_jacobian_inverse,
)
from odomap.geometry.so3 import (
    hat,
    orthonormalize,
    quaternion_from_rotation,
    rotation_from_quaternion,
    so3_exp,
    so3_left_jacobian,
    so3_left_jacobian_inverse,
    so3_log,
    so3_right_jacobian,
    so3_right_jacobian_inverse,
    vee,
)

__all__ = [
    "hat",
    "orthonormalize",
    "quaternion_from_rotation",
    "rotation_from_quaternion",
    "se2_adjoint",
    "se2_exp",
    "se2_inverse",
    "se2_left_jacobian",
    "se2_left_jacobian_inverse",
    "se2_log",
    "se2_right_jacobian",
    "se2_right_jacobian_inverse",
    "se3_adjoint",
    "se3_exp",
    "se3_inverse",
    "se3_left_jacobian",
    "se3_left_jacobian_inverse",
    "se3_log",
    "se3_right_jacobian",
    "se3_right_jacobian_inverse",
    "sim3_adjoint",
    "sim3_exp",
    "sim3_inverse",
    "sim3_left_jacobian",
    "sim3_left_jacobian_inverse",
    "sim3_log",
    "sim3_right_jacobian",
    "sim3_right_jacobian_inverse",
    "so2_exp",
    "so2_log",
    "so3_exp",
    "so3_left_jacobian",
    "so3_left_jacobian_inverse",
    "so3_log",
    "so3_right_jacobian",
    "so3_right_jacobian_inverse",
    "vee",
]
