"""Rigs: which sensors there are and where they are mounted.

Every sensor has a mount, T_body_sensor, and poses a system reports are those of the body. From the
mounts of two cameras follows the stereo geometry,

    T_left_right = T_body_left⁻¹ T_body_right,    baseline = |t_left_right|,

and depth is z = f · baseline / disparity: a baseline in millimetres scales the whole world by 1000,
a swapped pair turns it inside out, and a calibration for another image size bends it. None of
these looks wrong to an optimiser, so the rig refuses them: baselines outside 5 mm to 5 m, a right
camera that is not to the right, focal lengths and principal points that no image of that size has.

Reference: R. Hartley, A. Zisserman, "Multiple View Geometry in Computer Vision", 2nd ed.,
Cambridge University Press 2004, chapters 6 and 11.
"""

from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np

from odomap.errors import CalibrationError, nearest_name
from odomap.geometry.camera import Camera
from odomap.geometry.pose import SE3

__all__ = ["CameraMount", "DepthMount", "ImuMount", "LidarMount", "Rig"]

BASELINE_M = (0.005, 5.0)
"""Shortest and longest distance of the cameras of a stereo pair."""
FOCAL_PER_SIZE = (0.1, 30.0)
"""Smallest and largest focal length of a pinhole, in image sizes."""
FISHEYE_FOCAL_PER_SIZE = (0.03, 30.0)
"""The same for other lenses: a fisheye's picture may be a circle in a wide image, and a double
sphere's focal length is that of the lens times 1 + xi."""
MOST_VIEW = 2.0 * np.pi + 0.2
"""Most that a 2D laser sees, radians: some say that their last beam is the first again."""
CENTRE_PER_HALF = (0.62, 1.6)
"""A principal point is near the centre; one that is off by more, in both axes and to the same side,
belongs to an image of another size."""


@dataclass(frozen=True)
class CameraMount:
    """A camera on the rig."""

    name: str
    camera: Camera
    T_body_camera: SE3 = field(default_factory=SE3.identity)
    rate_hz: float = 0.0
    """Nominal frame rate; 0 when unknown."""
    time_offset_s: float = 0.0
    """Add to this camera's stamps to get body time."""

    def __post_init__(self) -> None:
        check_camera(self.name, self.camera)
        if not (np.isfinite(self.rate_hz) and self.rate_hz >= 0):
            raise CalibrationError(
                f"camera '{self.name}': rate_hz {self.rate_hz} must be 0 or more"
            )
        if not np.isfinite(self.time_offset_s):
            raise CalibrationError(f"camera '{self.name}': time_offset_s must be a finite number")


@dataclass(frozen=True)
class DepthMount:
    """A depth image registered to one of the cameras."""

    camera: str
    factor: float = 5000.0
    """Stored value per metre."""
    invalid: tuple[int, ...] = (0,)

    def __post_init__(self) -> None:
        if not (np.isfinite(self.factor) and self.factor > 0):
            raise CalibrationError(
                f"depth: factor {self.factor} must be positive (value per metre)"
            )


@dataclass(frozen=True)
class ImuMount:
    """An inertial measurement unit; continuous-time noise densities as Kalibr defines them."""

    rate_hz: float = 200.0
    gyro_noise: float = 1.7e-4
    """rad/s/√Hz."""
    gyro_walk: float = 1.9e-5
    """rad/s²/√Hz."""
    accel_noise: float = 2.0e-3
    """m/s²/√Hz."""
    accel_walk: float = 3.0e-3
    """m/s³/√Hz."""
    T_body_imu: SE3 = field(default_factory=SE3.identity)

    def __post_init__(self) -> None:
        for name in ("rate_hz", "gyro_noise", "gyro_walk", "accel_noise", "accel_walk"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise CalibrationError(f"imu: {name} {value} must be positive")


@dataclass(frozen=True)
class LidarMount:
    """A 2D or 3D LiDAR on the rig."""

    name: str
    T_body_lidar: SE3 = field(default_factory=SE3.identity)
    range_m: tuple[float, float] = (0.1, 100.0)
    rate_hz: float = 10.0
    sweep: str = "none"
    """"clockwise", "counter_clockwise", or "none" for an instantaneous scan."""
    angles: tuple[float, float, int] = (0.0, 0.0, 0)
    """First angle, last angle (radians) and number of beams of a 2D scan; 0 beams for 3D."""
    beams: int = 0
    """Beams above each other of a 3D LiDAR; 0 where it is not known, or there is no such order."""

    def __post_init__(self) -> None:
        sweeps = ("clockwise", "counter_clockwise", "none")
        if self.sweep not in sweeps:
            known = ", ".join(sweeps)
            raise CalibrationError(
                f"lidar '{self.name}': sweep '{self.sweep}' is none of {known}"
                + nearest_name(self.sweep, sweeps)
            )
        near, far = self.range_m
        if not 0 <= near < far:
            raise CalibrationError(
                f"lidar '{self.name}': range_m [{near}, {far}] must be [nearest, farthest]"
            )
        first, last, beams = self.angles
        if not (np.isfinite([first, last]).all() and beams >= 0):
            raise CalibrationError(
                f"lidar '{self.name}': angles [{first}, {last}, {beams}] must be first, last, and "
                "how many beams"
            )
        if not 0 <= self.beams <= 1024:
            raise CalibrationError(
                f"lidar '{self.name}': beams {self.beams} must be how many are above each other"
            )
        if abs(last - first) > MOST_VIEW:
            raise CalibrationError(
                f"lidar '{self.name}': angles from {first:g} to {last:g} are more than a turn: "
                "give them in radians"
            )


@dataclass(frozen=True)
class Rig:
    """What is mounted where. Poses a system reports are those of the body.

    Raises:
        CalibrationError: two sensors share a name, or the body or the depth image names a sensor
            that is not there.
    """

    cameras: tuple[CameraMount, ...] = ()
    depth: DepthMount | None = None
    imu: ImuMount | None = None
    lidars: tuple[LidarMount, ...] = ()
    body: str = ""
    """Name of the sensor that is the body frame; default the IMU, else the first sensor."""

    def __post_init__(self) -> None:
        names = self.sensors
        repeated = [name for name, count in Counter(names).items() if count > 1]
        if repeated:
            raise CalibrationError(f"two sensors are named '{repeated[0]}': rename one")
        if self.depth is not None:
            self.camera(self.depth.camera)
        if not self.body:
            return
        if self.body not in names:
            raise CalibrationError(
                f"body: there is no sensor '{self.body}' among {', '.join(names) or 'none'}"
                + nearest_name(self.body, names)
            )
        if not _is_identity(self._mounts()[self.body]):
            raise CalibrationError(
                f"body: the mount of '{self.body}' must be the identity, since it is the body; "
                "give the other mounts relative to it"
            )

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of all sensors: the IMU ("imu") first, then cameras, then LiDARs."""
        imu = () if self.imu is None else ("imu",)
        return imu + tuple(m.name for m in self.cameras) + tuple(m.name for m in self.lidars)

    @property
    def body_sensor(self) -> str:
        """Name of the sensor that is the body frame; empty if the body is a frame of its own."""
        if self.body:
            return self.body
        mounts = self._mounts()
        return next((name for name in self.sensors if _is_identity(mounts[name])), "")

    def camera(self, name: str) -> CameraMount:
        """Return the camera of a name.

        Raises:
            CalibrationError: there is none of that name.
        """
        for mount in self.cameras:
            if mount.name == name:
                return mount
        known = [mount.name for mount in self.cameras]
        raise CalibrationError(
            f"there is no camera '{name}' among {', '.join(known) or 'none'}"
            + nearest_name(name, known)
        )

    def stereo_pair(self) -> tuple[CameraMount, CameraMount]:
        """Return the first two cameras, left and right, after checking that they are a stereo pair.

        Returns:
            The left and the right camera: x of the right one in the left one's frame is positive.

        Raises:
            CalibrationError: there is no second camera, the image sizes differ, or the baseline
                is implausible, vertical, or points to the left (a swapped pair).
        """
        if len(self.cameras) < 2:
            raise CalibrationError(
                f"stereo needs two cameras, this rig has {len(self.cameras)}: "
                "is the right camera's folder or calibration missing?"
            )
        left, right = self.cameras[:2]
        check_pair(left, right)
        return left, right

    def without_imu(self) -> "Rig":
        """Return the rig without its IMU; the body stays the frame it is."""
        return replace(self, imu=None, body="" if self.body == "imu" else self.body)

    def _mounts(self) -> dict[str, SE3]:
        mounts = {} if self.imu is None else {"imu": self.imu.T_body_imu}
        mounts.update({mount.name: mount.T_body_camera for mount in self.cameras})
        mounts.update({mount.name: mount.T_body_lidar for mount in self.lidars})
        return mounts


def check_camera(name: str, camera: Camera) -> None:
    """Raise a CalibrationError unless focal length and principal point suit the image size."""
    width, height = camera.width, camera.height
    size = f"{width}x{height} images"
    low, high = FOCAL_PER_SIZE if camera.model == "pinhole" else FISHEYE_FOCAL_PER_SIZE
    for axis, focal, length in (("fx", camera.fx, width), ("fy", camera.fy, height)):
        if not low * length <= focal <= high * length:
            raise CalibrationError(
                f"camera '{name}': {axis} = {focal:g} px cannot be for {size}: "
                "intrinsics are fx, fy, cx, cy in pixels of that image size"
            )
    ratios = np.array([camera.cx / (width / 2), camera.cy / (height / 2)])
    low, high = CENTRE_PER_HALF
    if np.all(ratios < low) or np.all(ratios > high):
        mend = f"Scale intrinsics by {1 / ratios.mean():.3g}" if ratios.mean() > 0.05 else ""
        raise CalibrationError(
            f"camera '{name}': principal point ({camera.cx:g}, {camera.cy:g}) px is far from the "
            f"centre of {size}: "
            + (f"calibrated for another resolution? {mend}" if mend else "give cx, cy in pixels")
        )


def check_pair(left: CameraMount, right: CameraMount) -> None:
    """Raise a CalibrationError unless two cameras can be left and right of a stereo pair."""
    names = f"cameras '{left.name}' and '{right.name}'"
    sizes = (left.camera.width, left.camera.height), (right.camera.width, right.camera.height)
    if sizes[0] != sizes[1]:
        (a, b), (c, d) = sizes
        raise CalibrationError(
            f"{names}: resolutions {a}x{b} and {c}x{d} differ: a stereo pair needs the same"
        )
    offset = (left.T_body_camera.inverse() @ right.T_body_camera).t
    baseline = float(np.linalg.norm(offset))
    if not BASELINE_M[0] <= baseline <= BASELINE_M[1]:
        mend = "is it in millimetres?" if baseline > 1 else "translations are in metres"
        raise CalibrationError(f"{names}: baseline of {baseline:.3g} m is implausible: {mend}")
    if offset[0] < -0.5 * baseline:
        raise CalibrationError(
            f"{names}: the second lies {baseline:.3g} m to the left of the first, so disparities "
            "would be negative: the pair is swapped; list the left camera first"
        )
    if offset[0] < 0.5 * baseline:
        x, y, z = offset
        raise CalibrationError(
            f"{names}: the second lies at ({x:.3g}, {y:.3g}, {z:.3g}) m (right, down, forward) "
            "from the first: only cameras side by side are a stereo pair"
        )


def _is_identity(T: SE3) -> bool:
    return bool(np.allclose(T.matrix, np.eye(4), atol=1e-9))
