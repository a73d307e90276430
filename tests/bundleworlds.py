"""Small bundle adjustment problems with known truth, of any lens model."""

import numpy as np

from odomap.backend.adjustment.problem import BAL, Adjustment
from odomap.geometry.camera import Camera
from odomap.geometry.lie import se3_exp, se3_inverse

LENSES = {
    "pinhole": np.array([400.0, 410, 320, 240]),
    "radtan": np.array([400.0, 410, 320, 240, -0.1, 0.03, 0.002, -0.001]),
    "rational": np.array(
        [400.0, 410, 320, 240, -0.1, 0.03, 0.002, -0.001, 0.01, 0.02, 0.01, 0.001]
    ),
    "kannala_brandt": np.array([300.0, 310, 320, 240, 0.05, -0.02, 0.004, -0.001]),
    "double_sphere": np.array([300.0, 310, 320, 240, 0.2, 0.55]),
    BAL: np.array([400.0, -0.05, 0.01]),
}


def model_of(name):
    return "pinhole" if name in ("radtan", "rational") else name


def project(name, theta, points):
    """Return pixels by the house's cameras, or by BAL's formula written out."""
    if name == BAL:
        q = -points[:, :2] / points[:, 2:]
        s = np.sum(q * q, axis=1, keepdims=True)
        return theta[0] * (1 + theta[1] * s + theta[2] * s * s) * q
    return Camera(model_of(name), theta[:4], theta[4:], (640, 480)).project(points)


def orbit(count, looks_back=False):
    """Return T_camera_world of views around the origin, looking at it."""
    angle = np.linspace(0.0, 1.5, count)
    z = -np.stack([np.sin(angle), 0.1 * np.cos(3 * angle), -np.cos(angle)], axis=1)
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    R = np.stack([x, np.cross(z, x), z], axis=2)
    Ts = np.tile(np.eye(4), (count, 1, 1))
    Ts[:, :3, 3] = -5.0 * z
    Ts[:, :3, :3] = R * np.array([1.0, -1.0, -1.0]) if looks_back else R
    return se3_inverse(Ts)


def world(name="pinhole", views=6, points=50, sigma_px=0.5, off=0.02, own=False, seed=0, **how):
    """Return a problem off its truth, the true views, points and lens; `own`: a lens per view."""
    rng = np.random.default_rng(seed)
    theta = LENSES[name]
    Ts = orbit(views, name == BAL)
    X = rng.uniform(-1.2, 1.2, (points, 3))
    view, point = (a.ravel() for a in np.meshgrid(range(views), range(points), indexing="ij"))
    kept = (rng.uniform(size=len(view)) < 0.8) | (view < 2)
    view, point = view[kept], point[kept]
    seen = np.einsum("nij,nj->ni", Ts[view, :3, :3], X[point]) + Ts[view, :3, 3]
    pixels = project(name, theta, seen) + rng.normal(0.0, sigma_px, (len(view), 2))
    problem = Adjustment(
        Ts @ se3_exp(off * 0.5 * rng.normal(size=(views, 6))),
        X + off * rng.normal(size=X.shape),
        view,
        point,
        pixels,
        np.tile(theta, (views if own else 1, 1)),
        model_of(name),
        weights=1.0 / max(sigma_px, 1e-3),
        **how,
    )
    return problem, Ts, X, theta
