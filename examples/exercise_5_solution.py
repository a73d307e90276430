"""Exercise 5, solved: a loop measured, closed, and a false one refused (docs/lesson/exercise_5.md).

    python examples/exercise_5_solution.py                         # once round a simulated room
    python examples/exercise_5_solution.py RECORDING loop.png      # of a camera with depth

Views are tied to the view before and, where words find an old place, to that; every tie is measured
from points of both views by RANSAC. From odomap come the images, their features, the candidates,
the solver of the graph, and the truth to judge by.
"""

import sys
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

import odomap
from odomap import SE3
from odomap.geometry.lie import se3_exp
from odomap.vision.orb import OrbConfig, extract
from odomap.vision.vocabulary import BagOfWords

DATA = "sim:room?seed=4&frames=60&sensors=mono,depth&speed=6"
PIXEL, DEPTH = 1.0, 0.004  # standard deviations: of a feature, px; of a depth z, times z squared
GATE = 11.3  # squared error of an inlier in variances: 99 % of three numbers stay below
TRIPLES = 300  # samples of RANSAC
LEAST = 40  # inliers of a tie
RECENT = 15  # views before this one that are no old place

Array = np.ndarray


@dataclass
class View:
    """Features of an image whose depth is known.

    Attributes:
        signs: (N, 256) their descriptors, bits as -1 and 1.
        points: (N, 3) in the camera.
        covariances: (N, 3, 3) of the points.
        bag: the words of the image.
    """

    signs: Array
    points: Array
    covariances: Array
    bag: BagOfWords


@dataclass
class Tie:
    """A measured pose of one view in another, and how sure it is: a (6, 6) information."""

    first: int
    second: int
    T_first_second: Array
    information: Array
    num_inliers: int


# ---- views ----


def view_of(frame: odomap.Frame, rig: odomap.Rig, words: odomap.Vocabulary) -> View:
    """Extract features, and place them in space by their depth."""
    camera = rig.cameras[0].camera
    found = extract(frame.images[0], OrbConfig())
    u, v = np.rint(found.keypoints).astype(int).T
    z = frame.depth[v, u].astype(float)
    known = np.isfinite(z) & (z > 0.1)
    rays = np.column_stack([camera.undistort(found.keypoints), np.ones(len(z))])[known]
    z = z[known, None]
    # A pixel to the side moves the point by z / f, a change of depth along its ray.
    across = (PIXEL * 1.2 ** found.level[known][:, None] / camera.fx * z) ** 2
    along = (DEPTH * z**2) ** 2
    covariances = across[:, None] * np.diag([1.0, 1.0, 0.0]) + along[:, None] * (
        rays[:, :, None] * rays[:, None]
    )
    signs = 2.0 * np.unpackbits(found.descriptors[known], axis=1).astype(np.float32) - 1.0
    return View(signs, rays * z, covariances, words.transform(found.descriptors))


def match(one: View, other: View) -> Array:
    """Return (M, 2) pairs of features: nearest both ways, and clearly nearer than the next."""
    distances = (256.0 - one.signs @ other.signs.T) / 2.0
    nearest = distances.argmin(axis=1)
    two = np.partition(distances, 1, axis=1)[:, :2]
    rows = np.arange(len(distances))
    good = (distances.argmin(axis=0)[nearest] == rows) & (two[:, 0] < 0.85 * two[:, 1])
    good &= two[:, 0] <= 64
    return np.column_stack([rows, nearest])[good]


# ---- measuring ----


def horn(p: Array, q: Array) -> Array:
    """Return the (4, 4) motion that brings points p onto q best, by squared distances."""
    p0, q0 = p - p.mean(axis=0), q - q.mean(axis=0)
    U, _, Vt = np.linalg.svd(q0.T @ p0)
    T = np.eye(4)
    T[:3, :3] = U * [1.0, 1.0, np.linalg.det(U @ Vt)] @ Vt  # a rotation, no mirror
    T[:3, 3] = q.mean(axis=0) - T[:3, :3] @ p.mean(axis=0)
    return T


def residuals(T: Array, p: Array, P: Array, q: Array, Q: Array) -> tuple[Array, Array]:
    """Return the (N, 3) errors of points brought onto others, and their (N, 3, 3) information."""
    R = T[:3, :3]
    return p @ R.T + T[:3, 3] - q, np.linalg.inv(R @ P @ R.T + Q)


def squared(r: Array, W: Array) -> Array:
    return np.einsum("na,nab,nb->n", r, W, r)


def measure(one: View, other: View, seed: int) -> tuple[Array, Array, int] | None:
    """Measure the pose of the other view in the first; None if too few points agree."""
    pairs = match(one, other)
    if len(pairs) < LEAST:
        return None
    q, Q = one.points[pairs[:, 0]], one.covariances[pairs[:, 0]]
    p, P = other.points[pairs[:, 1]], other.covariances[pairs[:, 1]]
    rng, inliers, T = np.random.default_rng(seed), np.zeros(len(pairs), bool), np.eye(4)
    size = GATE / 3.0 * np.trace(P + Q, axis1=1, axis2=2)  # rough, and fast
    for _ in range(TRIPLES):
        three = rng.choice(len(pairs), 3, replace=False)
        guess = horn(p[three], q[three])
        agree = np.sum((p @ guess[:3, :3].T + guess[:3, 3] - q) ** 2, axis=1) < size
        if agree.sum() > inliers.sum():
            inliers, T = agree, guess
    for _ in range(10):
        if inliers.sum() < LEAST:
            return None
        r, W = residuals(T, *(x[inliers] for x in (p, P, q, Q)))
        # q of T exp(xi): R (p + v + w x p) + t
        J = T[:3, :3] @ np.concatenate([np.tile(np.eye(3), (len(r), 1, 1)), -cross(p[inliers])], 2)
        H = np.einsum("nab,nac,ncd->bd", J, W, J)
        T = T @ se3_exp(-np.linalg.solve(H, np.einsum("nab,nac,nc->b", J, W, r)))
        chi2 = squared(*residuals(T, p, P, q, Q))
        inliers = chi2 < GATE
    # Errors are what they are, not what was stated: scale by their mean square.
    return T, H / max(1.0, chi2[inliers].mean() / 3.0), int(inliers.sum())


def cross(v: Array) -> Array:
    """Return the (N, 3, 3) matrices with cross(v) w = v x w."""
    x, y, z = v.T
    o = np.zeros_like(x)
    return np.stack([o, -z, y, z, o, -x, -y, x, o], axis=1).reshape(-1, 3, 3)


def tie_views(views: list[View], num_words: int) -> tuple[list[Tie], list[Tie]]:
    """Return the ties of views to the views before, and to old places that words propose."""
    odometry, loops, places = [], [], odomap.Places(num_words)
    for k, view in enumerate(views):
        if k:
            found = measure(views[k - 1], view, seed=k)
            if found is None:
                raise odomap.TrackingFailed(f"view {k}: does not match the view before")
            odometry.append(Tie(k - 1, k, *found))
        if k > RECENT:
            places.add(k - RECENT - 1, views[k - RECENT - 1].bag)
            for old in places.query(view.bag, most=1).keyframe_ids.tolist():
                found = measure(views[old], view, seed=k)
                loops += [] if found is None else [Tie(old, k, *found)]
    return odometry, loops


# ---- the graph ----


def chain(odometry: list[Tie]) -> Array:
    """Return the (K, 4, 4) poses that odometry alone says."""
    Ts = [np.eye(4)]
    for tie in odometry:
        Ts.append(Ts[-1] @ tie.T_first_second)
    return np.array(Ts)


def close(ties: list[Tie], start: Array, robust: str | None = None) -> odomap.Solution:
    """Return the poses that agree best with all ties."""
    graph = odomap.PoseGraph(
        "SE3",
        start,
        [tie.first for tie in ties],
        [tie.second for tie in ties],
        np.array([tie.T_first_second for tie in ties]),
        np.array([tie.information for tie in ties]),
    )
    return odomap.solve(graph, robust=robust)


def draw(paths: dict[str, Array], truth: Array) -> Figure:
    """Draw all paths over the true one, as seen from above, and how far off they are."""
    figure = Figure(figsize=(9.6, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.plot(*truth[:, :2].T, color="0.75", lw=6)
    for name, path in paths.items():
        left.plot(*path[:, :2].T, ".-", lw=1.0, ms=3)
        right.semilogy(100 * np.linalg.norm(path - truth, axis=1), label=name)
    left.set(aspect="equal", xlabel="x, m", ylabel="y, m")
    right.set(xlabel="view", ylabel="off by, cm")
    right.legend(frameon=False, fontsize=8)
    return figure


def answer(recording: str = DATA) -> tuple[dict[str, float], dict[str, Array], Array]:
    """Close the loops of a recording.

    Returns:
        The ATE of each answer in metres, its positions aligned with the true ones, and these.
    """
    source, words = odomap.open(recording), odomap.Vocabulary.load()
    views, stamps = [], []
    for frame in source:
        views.append(view_of(frame, source.rig, words))
        stamps.append(frame.stamp_ns)
    odometry, loops = tie_views(views, words.num_words)
    if not loops:
        raise odomap.TrackingFailed("no place was seen twice: there is no loop to close")
    fewest = min(tie.num_inliers for tie in loops)
    print(f"{len(views)} views, {len(loops)} loops of {fewest} points or more")
    start = chain(odometry)
    false = Tie(len(views) // 8, 5 * len(views) // 8, np.eye(4), loops[-1].information, 99)
    answers = {
        "odometry": start,
        "loops": close(odometry + loops, start).Ts_world_node,
        "and a false one": close([*odometry, *loops, false], start).Ts_world_node,
    }
    gnc = close([*odometry, *loops, false], start, "gnc")
    answers["the same, GNC"] = gnc.Ts_world_node
    mount, truth = source.rig.cameras[0].T_body_camera, source.truth.interpolate(stamps)
    results, paths = {}, {}
    for name, Ts in answers.items():
        poses = [SE3(T) @ mount.inverse() for T in Ts]
        path = odomap.Trajectory.of_poses(stamps, poses)
        error = odomap.ate(path, truth)
        results[name] = error.rmse
        paths[name] = path.transformed(error.T_reference_estimate).positions
        print(f"{name:15}: ATE {100 * error.rmse:.1f} cm")
    out = np.flatnonzero(gnc.is_rejected) - len(odometry)
    found = "the false one is" if len(loops) in out else "the false one is not"
    print(f"GNC leaves out {len(out)} of {len(loops) + 1} loops; {found} among them")
    return results, paths, truth.positions


def main(recording: str = DATA, picture: str = "loop.png") -> dict[str, float]:
    """Close the loops of a recording, and draw what comes of it; return the ATEs."""
    results, paths, truth = answer(recording)
    draw(paths, truth).savefig(picture, dpi=110)
    return results


if __name__ == "__main__":
    main(*sys.argv[1:])
