"""Registration: the motion between two clouds, how sure it is, and what it does not say.

    import odomap

    found = odomap.register(source, target)
    found.T_target_source, found.information, found.reason

All methods share a loop (`alignment`): pair each source point with the nearest of the target within
reach, move so that pairs come together, until nothing moves. They differ in what "together" means:

    icp      points meet points              knows no surfaces; slow, but needs no normals
    plane    points meet the target's tangent planes (lines in 2D)
    gicp     pieces of surface meet          the most exact, from the widest starts; the default
    ndt      points meet normal distributions, one per cell, without pairs

2D clouds are 3D ones at z = 0 of which only x, y and θ move. The search begins at a first guess:
identity, what a motion model says, or "global", which needs none (`globalalign`).

Reference: F. Pomerleau, F. Colas, R. Siegwart, "A review of point cloud registration algorithms for
mobile robotics", Foundations and Trends in Robotics 4(1), 2015.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from odomap.errors import ConfigError, InputError, nearest_name
from odomap.geometry.pose import SE2, SE3
from odomap.geometry.robust import Loss
from odomap.lidar.alignment import GICP, ICP, NDT, PLANE, Aligned, Stage, align
from odomap.lidar.cloud import Cloud, HasPoints, cloud_of
from odomap.lidar.degeneracy import judge
from odomap.lidar.ndt import distributions
from odomap.lidar.target import FEWEST, Sampled, Target, check_enough, sample, suitable_voxel
from odomap.limits import Count, check_limits

__all__ = ["METHODS", "Method", "Registration", "RegistrationConfig", "register"]

Array = NDArray[np.float64]

Method = Literal["gicp", "plane", "icp", "ndt"]
METHODS = ("icp", "plane", "gicp", "ndt")
CELLS = (8.0, 4.0)
"""Sides of the cells of NDT, in voxels, one after the other."""
COARSE_POINTS = 500
"""Least points of the first, sparse look."""


@dataclass(frozen=True)
class RegistrationConfig:
    """How clouds are laid onto each other."""

    method: Method = "gicp"
    """What is minimised: gicp, plane, icp, ndt."""
    voxel: float | None = None
    """Side of the voxels both are down-sampled to, metres; 0: not at all; None: what suits the
    target, a twentieth of its mean distance from its middle."""
    max_distance: float | None = None
    """Farthest that a pair may be apart, metres; twice that at first and half of it in the end.
    None: four voxels."""
    loss: Loss = field(default_factory=Loss)
    """Robust loss of a pair, in standard deviations that its median tells; quadratic: none."""
    iterations: Count = 60
    """Most steps with all points."""
    tolerance: float | None = None
    """Root mean square motion of the points below which it is over, metres; None: voxel / 1000."""
    neighbours: Count = 10
    """Points that tell a normal where voxels do not."""
    threads: Count = 1
    """How many share the points. The result does not depend on it."""

    def __post_init__(self) -> None:
        check_limits(self)
        if self.method not in METHODS:
            hint = nearest_name(self.method, METHODS)
            raise ConfigError(
                f"method: '{self.method}' is unknown{hint}; known are {', '.join(METHODS)}"
            )
        for name, least in (("voxel", 0.0), ("max_distance", None), ("tolerance", 0.0)):
            value = getattr(self, name)
            if value is None:
                continue
            if not (np.isfinite(value) and (value > 0.0 if least is None else value >= least)):
                raise ConfigError(f"{name}: is {value}, give metres above 0")


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
    initial: ArrayLike | SE3 | SE2 | None = None,
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
        initial: first guess of T_target_source, (4, 4), or (3, 3) in the plane; default identity.
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
    R, t = _centred(_first_guess(initial, target.is_planar), sampled.origin, target.origin)
    stages = _stages(config, target, len(sampled))
    if config.method == "ndt":
        aligned = _align_cells(config, sampled, target, stages, R, t)
    else:
        code = {"icp": ICP, "plane": PLANE, "gicp": GICP}[config.method]
        pieces = sampled.points, sampled.discs() if code == GICP else sampled.normals
        surface = target.grid, target.discs if code == GICP else target.normals
        rest = R, t, config.loss, config.threads
        aligned = align(code, target.is_planar, stages, pieces, surface, *rest)
    return _concluded(sampled, target, aligned)


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


def _stages(config: RegistrationConfig, target: Target, count: int) -> list[Stage]:
    """Return looks at ever more points with ever less reach.

    The whole of them are paired within half the reach alone: pairs farther apart by then have no
    counterpart, and would turn the cloud by what the other one does not see.
    """
    reach = target.reach if config.max_distance is None else config.max_distance
    tolerance = target.spacing / 1000.0 if config.tolerance is None else config.tolerance
    stages = [Stage(1, 0.5 * reach, config.iterations, tolerance)]
    for stride, share in ((2, 1.0), (8, 2.0)):
        if count < stride * COARSE_POINTS:
            stride = 1
        coarse = max(tolerance, 0.01 * share * target.spacing)
        stages.insert(0, Stage(stride, share * reach, config.iterations, coarse))
    return stages


def _align_cells(
    config: RegistrationConfig,
    source: Sampled,
    target: Target,
    stages: list[Stage],
    R: Array,
    t: Array,
) -> Aligned:
    """Align by NDT in ever smaller cells; then pair points, for what is said about the result."""
    pieces, planar = (source.points, source.normals), target.is_planar
    iterations, converged = 0, True
    for side, stage in zip(CELLS, stages[-2:], strict=True):
        cells = distributions(target.grid.points, side * target.spacing, planar)
        found = align(NDT, planar, [stage], pieces, cells, R, t, Loss(), config.threads)
        R, t, converged = found.R, found.t, found.converged
        iterations += found.iterations
    once = [replace(stages[-1], iterations=1)]
    paired = align(PLANE, planar, once, pieces, (target.grid, target.normals), R, t, Loss())
    return Aligned(R, t, paired.rows, iterations, converged)


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
