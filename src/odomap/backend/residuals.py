"""Residuals: how far a landmark's projection is from where it was seen.

A landmark p (world) is seen by camera c of a body at T_world_body. With q = R_wbᵀ (p − t_wb) in the
body and X = R_cb q + t_cb in the camera, an observation gives three weighted residuals,

    r = ( w (X/Z − x),  w (Y/Z − y),  w_d (b/Z − δ) ),

where (x, y) are the measured normalised image coordinates, δ the measured disparity divided by the
focal length, b the stereo baseline, and the weights the focal length over the standard deviation in
pixels. A NaN disparity leaves the third out. For an update T exp(ξ), ξ = (ρ, φ), of the body's pose

    ∂X/∂ρ = −R_cb,   ∂X/∂φ = R_cb [q]ₓ,   ∂X/∂p = R_cb R_wbᵀ.

Reference: Triggs et al., "Bundle Adjustment - A Modern Synthesis", 1999.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel

__all__ = ["huber_weight", "reproject", "reproject_with_jacobians", "warm_up"]

Array = NDArray[np.float64]


@kernel
def reproject(
    R_wb: Array,
    t_wb: Array,
    R_cb: Array,
    t_cb: Array,
    baseline: float,
    p: Array,
    xy: Array,
    disparity: float,
    weights: Array,
    r: Array,
) -> bool:
    """Write r (3,) and say whether the landmark lies in front of the camera."""
    q0 = p[0] - t_wb[0]
    q1 = p[1] - t_wb[1]
    q2 = p[2] - t_wb[2]
    b0 = R_wb[0, 0] * q0 + R_wb[1, 0] * q1 + R_wb[2, 0] * q2
    b1 = R_wb[0, 1] * q0 + R_wb[1, 1] * q1 + R_wb[2, 1] * q2
    b2 = R_wb[0, 2] * q0 + R_wb[1, 2] * q1 + R_wb[2, 2] * q2
    X = R_cb[0, 0] * b0 + R_cb[0, 1] * b1 + R_cb[0, 2] * b2 + t_cb[0]
    Y = R_cb[1, 0] * b0 + R_cb[1, 1] * b1 + R_cb[1, 2] * b2 + t_cb[1]
    Z = R_cb[2, 0] * b0 + R_cb[2, 1] * b1 + R_cb[2, 2] * b2 + t_cb[2]
    if not Z > 1e-3:
        r[0], r[1], r[2] = 0.0, 0.0, 0.0
        return False
    r[0] = weights[0] * (X / Z - xy[0])
    r[1] = weights[0] * (Y / Z - xy[1])
    r[2] = weights[1] * (baseline / Z - disparity) if disparity == disparity else 0.0
    return True


@kernel
def reproject_with_jacobians(
    R_wb: Array,
    t_wb: Array,
    R_cb: Array,
    t_cb: Array,
    baseline: float,
    p: Array,
    xy: Array,
    disparity: float,
    weights: Array,
    r: Array,
    J_pose: Array,
    J_point: Array,
) -> bool:
    """Write r (3,), ∂r/∂ξ (3, 6) and ∂r/∂p (3, 3); False, and zeros, behind the camera."""
    q0 = p[0] - t_wb[0]
    q1 = p[1] - t_wb[1]
    q2 = p[2] - t_wb[2]
    b0 = R_wb[0, 0] * q0 + R_wb[1, 0] * q1 + R_wb[2, 0] * q2
    b1 = R_wb[0, 1] * q0 + R_wb[1, 1] * q1 + R_wb[2, 1] * q2
    b2 = R_wb[0, 2] * q0 + R_wb[1, 2] * q1 + R_wb[2, 2] * q2
    X = R_cb[0, 0] * b0 + R_cb[0, 1] * b1 + R_cb[0, 2] * b2 + t_cb[0]
    Y = R_cb[1, 0] * b0 + R_cb[1, 1] * b1 + R_cb[1, 2] * b2 + t_cb[1]
    Z = R_cb[2, 0] * b0 + R_cb[2, 1] * b1 + R_cb[2, 2] * b2 + t_cb[2]
    if not Z > 1e-3:
        r[0], r[1], r[2] = 0.0, 0.0, 0.0
        J_pose[:, :] = 0.0
        J_point[:, :] = 0.0
        return False
    has_disparity = disparity == disparity
    inverse = 1.0 / Z
    x, y = X * inverse, Y * inverse
    r[0] = weights[0] * (x - xy[0])
    r[1] = weights[0] * (y - xy[1])
    r[2] = weights[1] * (baseline * inverse - disparity) if has_disparity else 0.0
    scale = weights[0] * inverse
    bend = -weights[1] * baseline * inverse * inverse if has_disparity else 0.0
    for k in range(3):
        # Row k of J_point is first ∂r/∂q, a row vector in the body's axes.
        g0 = scale * (R_cb[0, k] - x * R_cb[2, k])
        g1 = scale * (R_cb[1, k] - y * R_cb[2, k])
        g2 = bend * R_cb[2, k]
        J_pose[0, k], J_pose[1, k], J_pose[2, k] = -g0, -g1, -g2
    for i in range(3):
        g0, g1, g2 = -J_pose[i, 0], -J_pose[i, 1], -J_pose[i, 2]
        # g · [q]ₓ = (g × q)ᵀ
        J_pose[i, 3] = g1 * b2 - g2 * b1
        J_pose[i, 4] = g2 * b0 - g0 * b2
        J_pose[i, 5] = g0 * b1 - g1 * b0
        for k in range(3):
            J_point[i, k] = g0 * R_wb[k, 0] + g1 * R_wb[k, 1] + g2 * R_wb[k, 2]
    return True


@kernel
def huber_weight(chi2: float, width: float) -> float:
    """Return ρ'(χ²) of Huber's loss: 1 inside the width, width/χ outside."""
    return 1.0 if chi2 <= width * width else width / np.sqrt(chi2)


@kernel
def huber_cost(chi2: float, width: float) -> float:
    """Return ρ(χ²)/2 of Huber's loss."""
    return 0.5 * chi2 if chi2 <= width * width else width * np.sqrt(chi2) - 0.5 * width * width


def warm_up() -> None:
    """Compile the kernels of this module."""
    eye, zero, r = np.eye(3), np.zeros(3), np.empty(3)
    p, xy, weights = np.array([0.1, 0.2, 2.0]), np.zeros(2), np.ones(2)
    reproject(eye, zero, eye, zero, 0.1, p, xy, 0.05, weights, r)
    reproject_with_jacobians(
        eye, zero, eye, zero, 0.1, p, xy, 0.05, weights, r, np.empty((3, 6)), np.empty((3, 3))
    )
    huber_weight(1.0, 2.0)
    huber_cost(1.0, 2.0)
