"""Clouds: what a LiDAR saw, as points with what is known of each.

Points are kept as (N, 3) float64 whatever came in; a scan of the plane is a cloud at z = 0 that
knows it is one. Rows that are not numbers, which drivers put where nothing came back, are dropped
and counted. Nothing else is judged here: what is too near, too far or moving is for those who know
the sensor.

Reference: R. B. Rusu, S. Cousins, "3D is here: Point Cloud Library (PCL)", ICRA 2011.
"""

from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from odomap.errors import InputError

__all__ = ["Cloud", "HasPoints", "cloud_of"]

Array = NDArray[np.float64]


@runtime_checkable
class HasPoints(Protocol):
    """Anything with points, such as a surface read from a PLY file."""

    @property
    def points(self) -> NDArray[np.floating]:
        """(N, 2) or (N, 3), metres."""
        ...


@dataclass(frozen=True, eq=False, repr=False)
class Cloud:
    """Points in the frame of their sensor, or of a map.

    Attributes:
        points: (N, 3) metres, finite, read-only.
        times: (N,) seconds relative to the cloud's stamp, or None.
        normals: (N, 3) unit vectors, zero where there is none, or None.
        covariances: (N, 3, 3) of the points around each, m², or None.
        is_planar: whether it is a scan of the plane z = 0.
        num_dropped: rows that were no numbers.

    Raises:
        InputError: arrays that do not fit together, or are not finite; `Cloud.of` drops such rows.
    """

    points: Array
    times: Array | None = None
    normals: Array | None = None
    covariances: Array | None = None
    is_planar: bool = False
    num_dropped: int = 0

    def __post_init__(self) -> None:
        n = len(self.points)
        shapes = {"points": (n, 3), "times": (n,), "normals": (n, 3), "covariances": (n, 3, 3)}
        for name, shape in shapes.items():
            given = getattr(self, name)
            if given is None:
                continue
            array = np.array(given, dtype=np.float64, order="C")
            if array.shape != shape:
                raise InputError(f"cloud: {name} have shape {array.shape}, give {shape}")
            if not np.isfinite(array).all():
                raise InputError(f"cloud: {name} have NaN or infinite entries: use Cloud.of")
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    @classmethod
    def of(cls, points: ArrayLike, times: ArrayLike | None = None) -> "Cloud":
        """Make a cloud of points; rows with NaN or infinity are dropped and counted.

        Args:
            points: (N, 2) or (N, 3), metres.
            times: (N,) seconds, if known.

        Raises:
            InputError: not such an array.

        Example:
            >>> Cloud.of([[1.0, 2.0], [float("nan"), 0.0]])
            Cloud(1 points of the plane, 1 dropped)
        """
        try:
            array = np.asarray(points, dtype=np.float64)
            stamps = None if times is None else np.asarray(times, dtype=np.float64)
        except (TypeError, ValueError):
            raise InputError("cloud: not an array of numbers, give (N, 2) or (N, 3)") from None
        if array.ndim != 2 or array.shape[1] not in (2, 3):
            raise InputError(f"cloud: points have shape {array.shape}, give (N, 2) or (N, 3)")
        if stamps is not None and stamps.shape != array.shape[:1]:
            raise InputError(f"cloud: times have shape {stamps.shape}, give {array.shape[:1]}")
        is_planar = array.shape[1] == 2
        if is_planar:
            array = np.column_stack([array, np.zeros(len(array))])
        num_dropped = 0
        if not (np.isfinite(array).all() and (stamps is None or np.isfinite(stamps).all())):
            good = np.isfinite(array).all(axis=1)
            if stamps is not None:
                good &= np.isfinite(stamps)
                stamps = stamps[good]
            num_dropped = int(len(array) - good.sum())
            array = array[good]
        return cls(array, stamps, is_planar=is_planar, num_dropped=num_dropped)

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        plane = " of the plane" if self.is_planar else ""
        dropped = f", {self.num_dropped} dropped" if self.num_dropped else ""
        return f"Cloud({len(self)} points{plane}{dropped})"

    def moved(self, T_a_cloud: ArrayLike) -> "Cloud":
        """Return the cloud in another frame: points T p, normals R n, covariances R C Rᵀ."""
        T = np.asarray(T_a_cloud, dtype=np.float64)
        if T.shape != (4, 4) or not np.isfinite(T).all():
            raise InputError(f"cloud: a motion has shape {T.shape}, give (4, 4) finite numbers")
        R = T[:3, :3]
        return replace(
            self,
            points=self.points @ R.T + T[:3, 3],
            normals=None if self.normals is None else self.normals @ R.T,
            covariances=None if self.covariances is None else R @ self.covariances @ R.T,
        )


def cloud_of(points: "ArrayLike | Cloud | HasPoints") -> Cloud:
    """Return what was given as a cloud: a cloud, an array, or anything that has points."""
    if isinstance(points, Cloud):
        return points
    if isinstance(points, HasPoints):
        return Cloud.of(points.points)
    return Cloud.of(points)
