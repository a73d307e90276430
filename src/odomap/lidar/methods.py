"""Methods: what each asks of the loop that all share, and their settings.

    icp      points meet points              knows no surfaces; slow, but needs no normals
    plane    points meet the target's tangent planes (lines in 2D)
    gicp     pieces of surface meet          the most exact, from the widest starts; the default
    ndt      points meet normal distributions, one per cell, without pairs

Each looks at ever more points with ever less reach: one in eight within twice the reach, every
other one within the reach, all of them within half of it. What is farther apart by then has no
counterpart, and would turn the cloud by what the other one does not see.

Reference: F. Pomerleau, F. Colas, R. Siegwart, "A review of point cloud registration algorithms for
mobile robotics", Foundations and Trends in Robotics 4(1), 2015.
"""

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from odomap.errors import ConfigError, nearest_name
from odomap.geometry.robust import Loss
from odomap.lidar.alignment import GICP, ICP, NDT, PLANE, Aligned, Stage, align
from odomap.lidar.gicp import sure_normals
from odomap.lidar.ndt import distributions
from odomap.lidar.target import Sampled, Target
from odomap.limits import Count, check_limits

__all__ = ["METHODS", "Method", "RegistrationConfig", "align_by", "stages_of"]

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
    seed: int = 0
    """Of the samples of a search without a first guess."""

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


def align_by(
    source: Sampled,
    target: Target,
    config: RegistrationConfig,
    stages: list[Stage],
    R: Array,
    t: Array,
) -> Aligned:
    """Align from a first guess by the method asked for."""
    if config.method == "ndt":
        return _align_cells(config, source, target, stages, R, t)
    code = {"icp": ICP, "plane": PLANE, "gicp": GICP}[config.method]
    pieces = source.points, source.discs() if code == GICP else source.normals
    normals = sure_normals(target.normals, target.discs) if code == PLANE else target.discs
    rest = R, t, config.loss, config.threads
    return align(code, target.is_planar, stages, pieces, (target.grid, normals), *rest)


def stages_of(config: RegistrationConfig, target: Target, count: int) -> list[Stage]:
    """Return looks at ever more of `count` points with ever less reach."""
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
