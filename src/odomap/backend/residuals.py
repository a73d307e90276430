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

__all__ = ["huber_weight", "linearize", "reproject", "warm_up"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


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


@kernel(reorder=True)
def linearize(
    R_wb: Array,
    t_wb: Array,
    R_cb: Array,
    t_cb: Array,
    baseline: Array,
    points: Array,
    start: Index,
    pose: Index,
    camera: Index,
    xy: Array,
    disparity: Array,
    weights: Array,
    r: Array,
    J_pose: Array,
    J_point: Array,
) -> None:
    """Write r (N, 3), ∂r/∂ξ (N, 3, 6), ∂r/∂p (N, 3, 3) of all observations; zeros behind a camera.

    Those of point m are start[m] to start[m + 1]. In one loop over scalars, without a call: that is
    five times as fast as small arrays.
    """
    for m in range(len(points)):
        p0, p1, p2 = points[m, 0], points[m, 1], points[m, 2]
        for o in range(start[m], start[m + 1]):
            i, k = pose[o], camera[o]
            R00, R01, R02 = R_wb[i, 0, 0], R_wb[i, 0, 1], R_wb[i, 0, 2]
            R10, R11, R12 = R_wb[i, 1, 0], R_wb[i, 1, 1], R_wb[i, 1, 2]
            R20, R21, R22 = R_wb[i, 2, 0], R_wb[i, 2, 1], R_wb[i, 2, 2]
            M00, M01, M02 = R_cb[k, 0, 0], R_cb[k, 0, 1], R_cb[k, 0, 2]
            M10, M11, M12 = R_cb[k, 1, 0], R_cb[k, 1, 1], R_cb[k, 1, 2]
            M20, M21, M22 = R_cb[k, 2, 0], R_cb[k, 2, 1], R_cb[k, 2, 2]
            q0, q1, q2 = p0 - t_wb[i, 0], p1 - t_wb[i, 1], p2 - t_wb[i, 2]
            b0 = R00 * q0 + R10 * q1 + R20 * q2
            b1 = R01 * q0 + R11 * q1 + R21 * q2
            b2 = R02 * q0 + R12 * q1 + R22 * q2
            X = M00 * b0 + M01 * b1 + M02 * b2 + t_cb[k, 0]
            Y = M10 * b0 + M11 * b1 + M12 * b2 + t_cb[k, 1]
            Z = M20 * b0 + M21 * b1 + M22 * b2 + t_cb[k, 2]
            # Behind the camera all is weighted by zero.
            in_front = 1.0 if Z > 1e-3 else 0.0
            inverse = in_front / (Z if Z > 1e-3 else 1.0)
            weight, deep = in_front * weights[o, 0], 0.0
            x, y = X * inverse, Y * inverse
            r[o, 0], r[o, 1], r[o, 2] = weight * (x - xy[o, 0]), weight * (y - xy[o, 1]), 0.0
            if disparity[o] == disparity[o]:
                deep = in_front * weights[o, 1]
                r[o, 2] = deep * (baseline[k] * inverse - disparity[o])
            scale, bend = weight * inverse, -deep * baseline[k] * inverse * inverse
            for a in range(3):
                # A row of J_point is first ∂r/∂q, a row vector in the body's axes.
                if a == 0:
                    g0, g1, g2 = (
                        scale * (M00 - x * M20),
                        scale * (M01 - x * M21),
                        scale * (M02 - x * M22),
                    )
                elif a == 1:
                    g0, g1, g2 = (
                        scale * (M10 - y * M20),
                        scale * (M11 - y * M21),
                        scale * (M12 - y * M22),
                    )
                else:
                    g0, g1, g2 = bend * M20, bend * M21, bend * M22
                J_pose[o, a, 0], J_pose[o, a, 1], J_pose[o, a, 2] = -g0, -g1, -g2
                # g · [q]ₓ = (g × q)ᵀ
                J_pose[o, a, 3] = g1 * b2 - g2 * b1
                J_pose[o, a, 4] = g2 * b0 - g0 * b2
                J_pose[o, a, 5] = g0 * b1 - g1 * b0
                J_point[o, a, 0] = g0 * R00 + g1 * R01 + g2 * R02
                J_point[o, a, 1] = g0 * R10 + g1 * R11 + g2 * R12
                J_point[o, a, 2] = g0 * R20 + g1 * R21 + g2 * R22


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
    rows, found = (
        np.zeros(1, np.int64),
        (np.empty((1, 3)), np.empty((1, 3, 6)), np.empty((1, 3, 3))),
    )
    frames = eye[None], zero[None], eye[None], zero[None], np.ones(1), p[None], np.array([0, 1])
    linearize(*frames, rows, rows, xy[None], np.ones(1), weights[None], *found)
    huber_weight(1.0, 2.0)
    huber_cost(1.0, 2.0)
