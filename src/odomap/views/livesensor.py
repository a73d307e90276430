"""Which sensor a run follows, and what the live view has to know of it.

Here, and nowhere else, cameras, LiDARs and lasers are told apart: what of a map is shown
(landmarks, or the clouds of its keyframes), what of a frame (an image with its tracks, or what
returned), how the sensor is drawn, and where to look at it from. Axes differ as well: of a camera z
is ahead and y down; a LiDAR may be mounted any way, but x of its body is ahead and z up. So each
says how it would be looked along,

    T_world_look = T_world_sensor T_sensor_look:    x right, y down, z ahead.

What is 3D is looked at from behind and above, what is flat from above.
"""

from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.camera import Camera
from odomap.geometry.pose import SE3
from odomap.maps.estimate import Estimate
from odomap.maps.map import Map
from odomap.sensors.frame import Frame
from odomap.sensors.rig import LidarMount, Rig
from odomap.views.livecloud import CloudSample, Returns, ScanReturns, SweepReturns
from odomap.views.livefigure import (
    CameraFigure,
    Figure,
    LidarFigure,
    arrows,
    frusta,
    opening,
)
from odomap.views.livemap import LandmarkSample, Sample
from odomap.views.livepicture import picture

__all__ = ["CameraSensor", "LidarSensor", "Sensor", "tracked_sensor", "usual_sensors"]

Array = NDArray[np.float64]

R_BODY_LOOK = np.array([(0.0, 0.0, 1.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)])
"""Right, down and ahead of a body with x ahead, y to the left and z up."""
ALL_CAMERA, ALL_LIDAR = 100_000, 400_000
"""Points shown of a run that is over: nothing else needs the machine."""
FRUSTUM, ARROW = 0.02, 0.05
"""Size of the mark of a keyframe, as a share of the distance that is seen."""


class Sensor(Protocol):
    """A sensor, as the view knows it."""

    @property
    def name(self) -> str:
        """What it is, for people."""

    @property
    def remembers(self) -> str:
        """What a map has of it, for people."""

    @property
    def T_body_sensor(self) -> SE3:
        """Where it is on the body."""

    @property
    def T_sensor_look(self) -> Array:
        """(4, 4) how it is looked along: x right, y down, z ahead."""

    @property
    def eye(self) -> tuple[float, float, float]:
        """Where it is first looked at from: right, down and ahead, in distances that it sees."""

    @property
    def grain(self) -> float:
        """Size of a point, in distances that it sees."""

    def figure(self, server: Any) -> Figure:
        """Draw it."""

    def marks(self, Ts_world_sensor: Array, reach: float) -> NDArray[np.float32]:
        """Return the lines (N, 2, 3) of a mark at each of the poses (K, 4, 4) of a sensor that
        sees so far."""

    def sample(self, map: Map) -> Sample:
        """Return what is shown of a map that grows."""

    def whole(self, map: Map) -> Sample:
        """Return what is shown of a map that does not."""

    def sight(self, frame: Frame, estimate: Estimate) -> NDArray[Any] | None:
        """Return what it saw in a frame, as its figure wants it; None if nothing."""


@dataclass(frozen=True, eq=False)
class CameraSensor:
    """A camera.

    Attributes:
        camera: its lens, None where nobody says.
        T_body_sensor: where it is on the body.
        index: which image of a frame is its.
    """

    camera: Camera | None = None
    T_body_sensor: SE3 = field(default_factory=SE3.identity)
    index: int = 0
    name, remembers = "camera", "landmarks"
    T_sensor_look = np.eye(4)
    eye, grain = (0.15, -0.35, -0.6), 0.003

    def figure(self, server: Any) -> CameraFigure:
        """Draw a frustum."""
        return CameraFigure(server, self.camera)

    def marks(self, Ts_world_sensor: Array, reach: float) -> NDArray[np.float32]:
        """Return frusta."""
        return frusta(Ts_world_sensor, opening(self.camera), FRUSTUM * reach)

    def sample(self, map: Map) -> LandmarkSample:
        """Return a sample of the landmarks; a map that is gone on with has some."""
        sample = LandmarkSample()
        sample.add(map.landmark_ids)
        return sample

    def whole(self, map: Map) -> LandmarkSample:
        """Return a large sample of the landmarks."""
        sample = LandmarkSample(ALL_CAMERA)
        sample.add(map.landmark_ids)
        return sample

    def sight(self, frame: Frame, estimate: Estimate) -> NDArray[np.uint8] | None:
        """Return the image (h, w, 3) with its tracks."""
        raw = frame.images[self.index] if self.index < len(frame.images) else None
        return None if raw is None else picture(raw, estimate.tracks)


@dataclass(frozen=True, eq=False)
class LidarSensor:
    """A LiDAR, of all around or of a plane.

    Attributes:
        mount: on the body.
        returns: what returns to it.
    """

    mount: LidarMount
    returns: Returns
    remembers, grain = "points", 0.0035

    @property
    def name(self) -> str:
        """What it is, for people."""
        return "LiDAR" if self.returns.has_heights else "laser"

    @property
    def T_body_sensor(self) -> SE3:
        """Where it is on the body."""
        return self.mount.T_body_lidar

    @property
    def T_sensor_look(self) -> Array:
        """(4, 4) how it is looked along: as its body."""
        T = np.eye(4)
        T[:3, :3] = self.mount.T_body_lidar.inverse().matrix[:3, :3] @ R_BODY_LOOK
        return T

    @property
    def eye(self) -> tuple[float, float, float]:
        """Where it is first looked at from: above what is flat, else behind and above."""
        # Straight above nobody could say what is up on the page.
        return (0.0, -1.0, -1.7) if self.returns.has_heights else (0.0, -3.0, -0.03)

    def figure(self, server: Any) -> LidarFigure:
        """Draw axes, and what returns."""
        return LidarFigure(server)

    def marks(self, Ts_world_sensor: Array, reach: float) -> NDArray[np.float32]:
        """Return arrow heads, in the plane of the body."""
        T_sensor_body = np.eye(4)
        T_sensor_body[:3, :3] = self.mount.T_body_lidar.matrix[:3, :3].T
        return arrows(Ts_world_sensor @ T_sensor_body, ARROW * reach)

    def sample(self, map: Map) -> CloudSample:
        """Return a sample of the clouds."""
        return CloudSample(self.returns, self.T_body_sensor.matrix)

    def whole(self, map: Map) -> CloudSample:
        """Return a large sample of the clouds, read at once."""
        return CloudSample(self.returns, self.T_body_sensor.matrix, ALL_LIDAR, ALL_LIDAR, True)

    def sight(self, frame: Frame, estimate: Estimate) -> NDArray[np.float32] | None:
        """Return the points (N, 3) that returned, as seen from the LiDAR."""
        return self.returns.of_frame(frame).astype(np.float32)


def tracked_sensor(rig: Rig, sensors: str) -> Sensor:
    """Return the sensor that is followed.

    Args:
        rig: what there is.
        sensors: what of it is used: stereo, rgbd, mono, lidar or lidar2d.

    Raises:
        CalibrationError: two cameras that are no pair are used as one.
    """
    if sensors in ("lidar", "lidar2d"):
        is_flat = sensors == "lidar2d"
        for lidar in rig.lidars:
            if (lidar.angles[2] > 0) == is_flat:
                return LidarSensor(lidar, ScanReturns(lidar) if is_flat else SweepReturns(lidar))
    if not rig.cameras:
        return CameraSensor()
    if sensors == "stereo":
        mount = rig.stereo_pair()[0]
    elif sensors == "rgbd" and rig.depth is not None:
        mount = rig.camera(rig.depth.camera)
    else:  # one camera is the body: without a scale its path cannot carry the lever arm
        return CameraSensor(rig.cameras[0].camera)
    return CameraSensor(mount.camera, mount.T_body_camera, rig.cameras.index(mount))


def usual_sensors(rig: Rig) -> str:
    """Return what of a rig is usually used."""
    if rig.cameras:
        usual = "stereo" if len(rig.cameras) > 1 else "mono"
        return usual if rig.depth is None else "rgbd"
    is_flat = bool(rig.lidars) and all(mount.angles[2] for mount in rig.lidars)
    return "lidar2d" if is_flat else "lidar"
