"""Rigs: which sensors there are and where they are mounted."""

from dataclasses import dataclass, field

from odomap.geometry.camera import Camera
from odomap.geometry.pose import SE3

__all__ = ["CameraMount", "DepthMount", "ImuMount", "LidarMount", "Rig"]


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


@dataclass(frozen=True)
class DepthMount:
    """A depth image registered to one of the cameras."""

    camera: str
    factor: float = 5000.0
    """Stored value per metre."""
    invalid: tuple[int, ...] = (0,)


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


@dataclass(frozen=True)
class Rig:
    """What is mounted where. Poses a system reports are those of the body."""

    cameras: tuple[CameraMount, ...] = ()
    depth: DepthMount | None = None
    imu: ImuMount | None = None
    lidars: tuple[LidarMount, ...] = ()
    body: str = ""
    """Name of the sensor that is the body frame; default the IMU, else the first sensor."""
