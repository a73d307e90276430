"""Registration: the motion between two clouds, how sure it is, and what it does not say.

    import odomap

    found = odomap.register(source, target)
    found.T_target_source, found.information, found.reason

All methods share a loop (`alignment`): pair each source point with the nearest of the target within
reach, move so that pairs come together, until nothing moves. What "together" means makes the method
(`methods`); what is said of the result is the same for all (`degeneracy`).

2D clouds are 3D ones at z = 0 of which only x, y and θ move. The search begins at a first guess:
identity, what a motion model says, or "global", which needs none (`globalalign`).

Reference: F. Pomerleau, F. Colas, R. Siegwart, "A review of point cloud registration algorithms for
mobile robotics", Foundations and Trends in Robotics 4(1), 2015.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from odomap.errors import InputError
from odomap.geometry.pose import SE2, SE3
from odomap.geometry.robust import Loss
from odomap.geometry.so3 import so3_log
from odomap.lidar.alignment import Aligned, Stage
from odomap.lidar.cloud import Cloud, HasPoints, cloud_of
from odomap.lidar.degeneracy import judge
from odomap.lidar.methods import Method, RegistrationConfig, align_by, stages_of
from odomap.lidar.target import FEWEST, Sampled, Target, check_enough, sample, suitable_voxel

__all__ = ["Registration", "RegistrationConfig", "register"]

Array = NDArray[np.float64]

RIVAL = 0.97
"""Share of the most inliers at which another motion is as good."""


@dataclass(frozen=True, eq=False)
class Registration:
    """How a source lies in a target.

    Attributes:
        T_target_source: (4, 4), in the plane too.
        information: (6, 6) inverse covariance of a right update (translation, rotation), or (3, 3)
            of (x, y, θ) in the plane; zero where the clouds say nothing (`degeneracy`).
        num_inliers: source points, after down-sampling, that have a counterpart within reach.
        num_points: source points after down-sampling.
        error: root mean square distance of the inliers from the target's surface, metres.
        converged: whether the steps became small, with enough inliers.
        iterations: steps taken.
        weak_directions: (K, 6) or (K, 3) tangents about the source's mean that are not fixed, each
            of a length that moves the points by 1 m, root mean square.
        reason: what is wrong or not fixed; empty if nothing is.
    """

    T_target_source: Array
    information: Array
    num_inliers: int
    num_points: int
    error: float
    converged: bool
    iterations: int
    weak_directions: Array
    reason: str

    @property
    def is_degenerate(self) -> bool:
        """Whether there are directions in which the clouds do not fix the motion."""
        return len(self.weak_directions) > 0

    @property
    def se2(self) -> Array:
        """(3, 3) the motion's part in the plane.

        Raises:
            InputError: it was not in the plane.
        """
        if len(self.information) != 3:
            raise InputError("registration: is one in space: it has T_target_source alone")
        keep = np.ix_([0, 1, 3], [0, 1, 3])
        return np.array(self.T_target_source[keep])


def register(
    source: ArrayLike | Cloud | HasPoints | Sampled,
    target: ArrayLike | Cloud | HasPoints | Target,
    method: Method | None = None,
    *,
    initial: ArrayLike | SE3 | SE2 | Literal["global"] | None = None,
    max_distance: float | None = None,
    voxel: float | None = None,
    loss: Loss | str | None = None,
    threads: int | None = None,
    config: RegistrationConfig | None = None,
) -> Registration:
    """Find how a source lies in a target.

    Args:
        source: (N, 3) or (N, 2) points, a cloud, or anything with points; NaN rows are dropped; or
            what `sample` made of it before.
        target: as the source; or a `Target` made of it before.
        method: "gicp", "plane", "icp" or "ndt"; default that of the config.
        initial: first guess of T_target_source, (4, 4), or (3, 3) in the plane; or "global", which
            needs none; default identity.
        max_distance: overrides that of the config, as do voxel, loss and threads.
        voxel: side of voxels, metres.
        loss: robust loss, or its name.
        threads: how many share the points.
        config: all the rest.

    Raises:
        InputError: what was given are no clouds, or hardly any points.
        ConfigError: a setting that cannot be.

    Example:
        >>> box = np.random.default_rng(0).uniform(-1, 1, (3000, 3))
        >>> box[np.arange(3000), np.arange(3000) % 3] = 1.0
        >>> found = register(box + [0.02, 0.0, 0.0], box, "plane")
        >>> found.converged, found.T_target_source[:3, 3].round(2) + 0.0
        (True, array([-0.02,  0.  ,  0.  ]))
    """
    config = _settings(config, method, max_distance, voxel, loss, threads)
    sampled, target = _prepared(source, target, config)
    stages = stages_of(config, target, len(sampled))
    if isinstance(initial, str):
        if initial != "global":
            raise InputError(f"initial: '{initial}' is unknown: give 'global', or a motion")
        return _best_of_all(sampled, target, config, stages)
    R, t = _centred(_first_guess(initial, target.is_planar), sampled.origin, target.origin)
    return _concluded(sampled, target, align_by(sampled, target, config, stages, R, t))


def _best_of_all(
    source: Sampled, target: Target, config: RegistrationConfig, stages: list[Stage]
) -> Registration:
    """Align from all candidates that need no guess; the one after which most points meet is it."""
    from odomap.lidar.globalalign import candidates

    pieces, surface = (source.points, source.normals), (target.grid.points, target.normals)
    motions = candidates(pieces, surface, target.spacing, target.is_planar, config.seed)
    motions = motions or [(np.eye(3), source.origin - target.origin)]
    ended = [
        _concluded(source, target, align_by(source, target, config, stages, R, t))
        for R, t in motions
    ]
    ended.sort(key=lambda found: (-found.num_inliers, found.error))
    best = ended[0]
    rivals = [r for r in ended[1:] if r.num_inliers >= RIVAL * best.num_inliers]
    middle = source.origin
    for rival in rivals:
        off = np.linalg.inv(best.T_target_source) @ rival.T_target_source
        apart = float(np.linalg.norm(off[:3, :3] @ middle + off[:3, 3] - middle))
        turned = float(np.linalg.norm(so3_log(off[:3, :3])))
        if apart > 4.0 * target.spacing or turned > 0.1:
            also = f"; {best.reason}" if best.reason else ""
            ambiguous = f"ambiguous: {apart:.2g} m and {np.degrees(turned):.0f}° away as many meet"
            return replace(best, reason=ambiguous + also)
    return best


def _settings(
    config: RegistrationConfig | None,
    method: Method | None,
    max_distance: float | None,
    voxel: float | None,
    loss: Loss | str | None,
    threads: int | None,
) -> RegistrationConfig:
    given = {
        "method": method,
        "max_distance": max_distance,
        "voxel": voxel,
        "loss": Loss(loss) if isinstance(loss, str) else loss,
        "threads": threads,
    }
    changed = {name: value for name, value in given.items() if value is not None}
    return replace(config or RegistrationConfig(), **changed)  # type: ignore[arg-type]


def _prepared(
    source: ArrayLike | Cloud | HasPoints | Sampled,
    target: ArrayLike | Cloud | HasPoints | Target,
    config: RegistrationConfig,
) -> tuple[Sampled, Target]:
    """Return both clouds ready to be aligned, made side by side where there are threads for it."""
    first = source if isinstance(source, Sampled) else cloud_of(source)
    second = target if isinstance(target, Target) else cloud_of(target)
    if first.is_planar != second.is_planar:
        flat, solid = ("source", "target") if first.is_planar else ("target", "source")
        raise InputError(f"register: the {flat} is of the plane, the {solid} is not")
    voxel = config.voxel
    if isinstance(second, Cloud):
        check_enough(len(second), second, "target")
        voxel = suitable_voxel(second) if voxel is None else voxel
    elif voxel is None:
        voxel = second.spacing

    def make_target() -> Target:
        if isinstance(second, Target):
            return second
        return Target.of(second, voxel, config.max_distance, config.neighbours)

    def make_source() -> Sampled:
        if isinstance(first, Sampled):
            return first
        return sample(first, voxel, config.neighbours, "source")

    if config.threads == 1:
        return make_source(), make_target()
    with ThreadPoolExecutor(1) as pool:
        making = pool.submit(make_target)
        return make_source(), making.result()


def _first_guess(initial: ArrayLike | SE3 | SE2 | None, planar: bool) -> Array:
    """Return (4, 4).

    Raises:
        InputError: no motion, or one that leaves the plane.
    """
    if initial is None:
        return np.eye(4)
    matrix = np.asarray(initial.matrix if isinstance(initial, SE2 | SE3) else initial, np.float64)
    if planar and matrix.shape == (3, 3):
        T = np.eye(4)
        T[np.ix_([0, 1, 3], [0, 1, 3])] = SE2(matrix).matrix
        return T
    T = np.array(SE3(matrix).matrix)
    if planar and (abs(T[2, 2] - 1.0) > 1e-6 or abs(T[2, 3]) > 1e-9):
        raise InputError("initial: leaves the plane that the clouds lie in")
    return T


def _centred(T: Array, source: Array, target: Array) -> tuple[Array, Array]:
    """Return R, t between clouds about their means: t' = R c_s + t - c_t."""
    R = T[:3, :3]
    return np.ascontiguousarray(R), R @ source + T[:3, 3] - target


def _concluded(source: Sampled, target: Target, aligned: Aligned) -> Registration:
    """Return what was found, in the frames of the clouds as they were given."""
    R, t = aligned.R, aligned.t
    paired = np.flatnonzero(aligned.rows >= 0)
    rows = aligned.rows[paired]
    p = source.points[paired]
    e = target.grid.points[rows] - p @ R.T - t
    normals, spreads = target.normals[rows], target.spreads[rows]
    own = 0.5 * (source.spreads[paired, 4] + spreads[:, 4])
    certainty = judge(p, e, normals, spreads, own, R, source.origin, source.is_planar)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t - R @ source.origin + target.origin
    reason = certainty.reason
    if len(paired) < FEWEST:
        reason = (
            f"{len(paired)} of {len(source)} points have a counterpart within reach: "
            "a better first guess, or a larger max_distance?"
        )
    elif not aligned.converged:
        also = f"; {reason}" if reason else ""
        reason = f"still moving after {aligned.iterations} steps{also}"
    return Registration(
        T,
        certainty.information,
        len(paired),
        len(source),
        certainty.error,
        aligned.converged and len(paired) >= FEWEST,
        aligned.iterations,
        certainty.weak_directions,
        reason,
    )
