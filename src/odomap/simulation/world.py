"""Worlds: a scene, a path through it, and a rig whose sensors are read frame by frame.

A world is decided by its `WorldSpec`, seed included: `World.make(kind="room", seed=3).frame(17)`
has the same bytes whenever and in whatever order it is asked for. Nothing is kept from frame to
frame, so that a recording of any length needs the memory of one.

The body is the IMU where there is one, else the first camera, else the LiDAR.
"""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from odomap.errors import ConfigError, nearest_name
from odomap.geometry.camera import Camera
from odomap.geometry.pose import SE3
from odomap.geometry.trajectory import Trajectory
from odomap.sensors.frame import Frame, ImuSamples
from odomap.sensors.rig import CameraMount, DepthMount, ImuMount, LidarMount, Rig
from odomap.sensors.sweep import Sweep
from odomap.simulation.building import building, corridor
from odomap.simulation.exposure import ImageNoise, expose, measure_depth
from odomap.simulation.imu import imu_samples
from odomap.simulation.lidar import RINGS, LidarNoise, scan, sweep
from odomap.simulation.path import Path
from odomap.simulation.render import render
from odomap.simulation.room import R_CARRIER_IMU, room
from odomap.simulation.scene import Scene
from odomap.simulation.street import street

__all__ = ["SENSORS", "START_NS", "World", "WorldSpec"]

Array = NDArray[np.float64]

START_NS = 1_700_000_000_000_000_000
"""Stamp of the first frame: an epoch of our days, so that float seconds are caught losing time."""
SENSORS = ("stereo", "mono", "depth", "imu", "lidar2d", "lidar3d")
MAKERS: Mapping[str, Callable[[int, int, float], tuple[Scene, Path]]] = MappingProxyType(
    {"room": room, "building": building, "corridor": corridor, "street": street}
)
HAND_HELD = ("room", "building", "corridor")
LENSES: Mapping[str, tuple[str, float, tuple[float, ...]]] = MappingProxyType(
    {
        "radtan": ("pinhole", 1.0, (-0.28, 0.07, 2e-4, -1e-4)),
        "kannala_brandt": ("kannala_brandt", 0.48, (3.5e-3, 7e-4, -2e-3, 2e-4)),
        "double_sphere": ("double_sphere", 0.385, (-0.2, 0.59)),
    }
)
"""Camera model, focal length relative to the pinhole's, and distortion: those of EuRoC's lenses, of
TUM-VI's, and of a double sphere much like TUM-VI's."""
R_CARRIER_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True)
class WorldSpec:
    """What decides a world, to the last byte."""

    kind: str = "room"
    """"room", "building" (corridors and rooms, 60 m round), "corridor" (of identical doors), all
    hand-held, or "street" (on wheels)."""
    seed: int = 0
    """Which of the worlds of its kind."""
    frames: int = 150
    """How many there are."""
    rate_hz: float = 0.0
    """Frames per second; 0 for 20, and 10 in a street."""
    resolution: tuple[int, int] = (0, 0)
    """Width and height in pixels; 0 for 640x400, and 800x304 in a street."""
    speed: float = 0.0
    """Mean speed in m/s; 0 for 0.6 in a room, 0.8 in a building and 7.5 in a street."""
    noise: float = 1.0
    """Factor on all imperfections of all sensors; 0 for ideal ones."""
    calibration_px: float = 0.1
    """How wrong the rig's calibration is at most: principal point, focal length (at the image's
    rim) and rotation of each camera, in pixels, times `noise`. Real rigs are off by 0.1 or so; no
    amount of images averages that out."""
    moving_objects: int = 0
    """How many things move through the scene."""
    sensors: tuple[str, ...] = ("stereo", "imu")
    """Which of stereo, mono, depth, imu, lidar2d, lidar3d the rig carries."""
    lens: str = "pinhole"
    """What the cameras look through: "pinhole", "radtan" (a wide lens that bends lines),
    "kannala_brandt" or "double_sphere" (fisheyes of 190° across). All but the first take about ten
    times as long to render."""

    def __post_init__(self) -> None:
        if self.kind not in MAKERS:
            known = ", ".join(MAKERS)
            raise ConfigError(
                f"kind: '{self.kind}' is none of {known}{nearest_name(self.kind, MAKERS)}"
            )
        lenses = ("pinhole", *LENSES)
        if self.lens not in lenses:
            known = ", ".join(lenses)
            raise ConfigError(
                f"lens: '{self.lens}' is none of {known}{nearest_name(self.lens, lenses)}"
            )
        for sensor in self.sensors:
            if sensor not in SENSORS:
                known = ", ".join(SENSORS)
                raise ConfigError(
                    f"sensors: '{sensor}' is none of {known}{nearest_name(sensor, SENSORS)}"
                )
        if not self.sensors:
            raise ConfigError("sensors: a world needs at least one")
        if {"lidar2d", "lidar3d"} <= set(self.sensors):
            raise ConfigError("sensors: choose one of lidar2d and lidar3d")
        if "depth" in self.sensors and not {"stereo", "mono"} & set(self.sensors):
            raise ConfigError("sensors: 'depth' is registered to a camera: add 'mono' or 'stereo'")
        for name, low in (("frames", 1), ("seed", 0), ("moving_objects", 0)):
            if getattr(self, name) < low:
                raise ConfigError(f"{name}: {getattr(self, name)} must be {low} or more")
        for name in ("rate_hz", "speed", "noise", "calibration_px"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise ConfigError(f"{name}: {value} must be finite and not negative")
        if self.resolution != (0, 0) and not all(32 <= n <= 4096 for n in self.resolution):
            raise ConfigError(f"resolution: {self.resolution} must be from 32 to 4096 pixels")

    def completed(self) -> "WorldSpec":
        """Return the spec with the values that depend on the kind filled in."""
        is_held = self.kind in HAND_HELD
        walk = 0.6 if self.kind == "room" else 0.8
        return replace(
            self,
            rate_hz=self.rate_hz or (20.0 if is_held else 10.0),
            speed=self.speed or (walk if is_held else 7.5),
            resolution=self.resolution
            if self.resolution != (0, 0)
            else ((640, 400) if is_held else (800, 304)),
        )


class World:
    """A rendered world with known truth.

    Attributes:
        spec: what decides it, completed.
        rig: the sensors.
        scene: what there is.
        truth: (frames) exact T_world_body.
    """

    def __init__(self, spec: WorldSpec) -> None:
        self.spec = spec.completed()
        make = MAKERS[self.spec.kind]
        self.scene: Scene
        self._path: Path
        self.scene, self._path = make(self.spec.seed, self.spec.moving_objects, self.spec.speed)
        carried = _carried(self.spec)
        first = next(iter(carried.sensors))
        T_imu_body = _mount_pose(carried, first)
        self._carried = carried
        self._T_imu_body = T_imu_body.matrix
        self._true_cameras = [
            _miscalibrated(mount, self.spec, number) for number, mount in enumerate(carried.cameras)
        ]
        self.rig = _relative_to(carried, T_imu_body.inverse(), first)
        seconds = np.arange(self.spec.frames) / self.spec.rate_hz
        self._stamps = START_NS + np.rint(seconds * 1e9).astype(np.int64)
        self.truth = Trajectory(self._stamps, self._at(self._stamps))
        self._imu = self._all_imu() if carried.imu else None

    @classmethod
    def make(cls, **fields: object) -> "World":
        """Make a world from the fields of `WorldSpec`.

        Example:
            >>> world = World.make(kind="room", seed=1, frames=2, resolution=(64, 48))
            >>> world.frame(1).images[0].shape
            (48, 64)
        """
        known = [f.name for f in dataclasses.fields(WorldSpec)]
        for name in fields:
            if name not in known:
                raise ConfigError(f"{name}: there is no such field{nearest_name(name, known)}")
        return cls(WorldSpec(**fields))  # type: ignore[arg-type]

    def __len__(self) -> int:
        return self.spec.frames

    @property
    def path(self) -> Path:
        """Exact motion of the IMU's place (time 0 at the first frame), with or without an IMU."""
        return self._path

    def frame(self, index: int) -> Frame:
        """Measure frame `index` with all sensors of the rig.

        Raises:
            IndexError: there is no such frame.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)}")
        images, depth = self._images(index)
        return Frame(
            id=index,
            stamp_ns=int(self._stamps[index]),
            images=images,
            depth=depth,
            scan=self._scan(index) if "lidar2d" in self.spec.sensors else None,
            cloud=self._cloud(index) if "lidar3d" in self.spec.sensors else None,
            imu=self._imu_of(index),
        )

    def _seconds(self, index: int) -> float:
        return float(self._stamps[index] - START_NS) * 1e-9

    def _at(self, stamps: NDArray[np.int64]) -> Array:
        motion = self._path.at(np.asarray(stamps - START_NS, np.float64) * 1e-9)
        return motion.Ts_world_body @ self._T_imu_body

    def _images(
        self, index: int
    ) -> tuple[tuple[NDArray[np.uint8], ...], NDArray[np.float32] | None]:
        noise = ImageNoise().scaled(self.spec.noise)
        time, seed = self._seconds(index), self.spec.seed
        times = time + noise.shutter_s * np.array([0.0, 0.5])
        Ts_world_imu = self._path.at(times).Ts_world_body
        images, depth = [], None
        for number, mount in enumerate(self._true_cameras):
            Ts = Ts_world_imu @ mount.T_body_camera.matrix
            picture = render(self.scene, mount.camera, Ts, times)
            key = (seed, index, number)
            images.append(
                expose(picture, noise, mount.camera.intrinsics, key, noise.gain(seed, time, number))
            )
            if number == 0 and "depth" in self.spec.sensors:
                depth = measure_depth(picture.depth, self.spec.noise, (seed, index))
        return tuple(images), depth

    def _lidar(self, index: int) -> tuple[LidarMount, float, LidarNoise, np.random.Generator]:
        noise = LidarNoise().scaled(self.spec.noise)
        rng = np.random.default_rng([self.spec.seed, index, 17])
        return self._carried.lidars[0], self._seconds(index), noise, rng

    def _scan(self, index: int) -> Array:
        mount, time, noise, rng = self._lidar(index)
        return scan(self.scene, self._path, mount, time, noise, rng)

    def _cloud(self, index: int) -> Sweep:
        mount, time, noise, rng = self._lidar(index)
        return sweep(self.scene, self._path, mount, time, noise, rng)

    def _all_imu(self) -> ImuSamples:
        """Measure the whole recording, from one frame before the first."""
        mount = self._carried.imu
        assert mount is not None
        first = -int(np.ceil(mount.rate_hz / self.spec.rate_hz))
        last = int(np.ceil((self._seconds(len(self) - 1)) * mount.rate_hz)) + 1
        ticks = np.arange(first, last + 1) / mount.rate_hz
        stamps = START_NS + np.rint(ticks * 1e9).astype(np.int64)
        return imu_samples(self._path, stamps, mount, self.spec.seed, START_NS)

    def _imu_of(self, index: int) -> ImuSamples | None:
        if self._imu is None:
            return None
        stamp = self._stamps[index]
        period = round(1e9 / self.spec.rate_hz)
        before = self._stamps[index - 1] if index else stamp - period
        first, end = np.searchsorted(self._imu.stamps_ns, [before, stamp], side="right")
        part = slice(int(first), int(end))
        return ImuSamples(self._imu.stamps_ns[part], self._imu.gyro[part], self._imu.accel[part])


def _carried(spec: WorldSpec) -> Rig:
    """Return the rig with all mounts relative to the place of the IMU."""
    is_held = spec.kind in HAND_HELD
    width, height = spec.resolution
    focal = 0.625 * width if is_held else 0.6 * width
    model, magnified, distortion = LENSES.get(spec.lens, ("pinhole", 1.0, ()))
    focal *= magnified
    camera = Camera(
        model,
        np.array([focal, focal, width / 2 - 0.5 + 3.3, height / 2 - 0.5 - 2.1]),
        np.array(distortion),
        (width, height),
    )
    R_imu_carrier = R_CARRIER_IMU.T if is_held else np.eye(3)
    tilt = [0.0, 0.0, 0.0, -0.11, -0.013, 0.009] if is_held else [0, 0, 0, -0.008, 0.011, 0.004]
    lever = [-0.024, -0.061, 0.012] if is_held else [0.81, 0.29, 0.48]
    T_imu_left = SE3.from_parts(R_imu_carrier @ R_CARRIER_CAMERA, np.array(lever)) @ SE3.exp(
        np.array(tilt, float)
    )
    baseline = SE3.from_parts(np.eye(3), np.array([0.11 if is_held else 0.54, 0.0, 0.0]))
    cameras: list[CameraMount] = []
    if {"stereo", "mono"} & set(spec.sensors):
        cameras.append(CameraMount("left", camera, T_imu_left, spec.rate_hz))
    if "stereo" in spec.sensors:
        cameras.append(CameraMount("right", camera, T_imu_left @ baseline, spec.rate_hz))
    return Rig(
        cameras=tuple(cameras),
        depth=DepthMount("left") if "depth" in spec.sensors else None,
        imu=_imu_mount(spec) if "imu" in spec.sensors else None,
        lidars=_lidar_mounts(spec, R_imu_carrier),
    )


def _miscalibrated(mount: CameraMount, spec: WorldSpec, number: int) -> CameraMount:
    """Return what the camera really is where the rig describes it wrongly."""
    if spec.calibration_px * spec.noise == 0:
        return mount
    camera = mount.camera
    rng = np.random.default_rng([spec.seed, number, 19])
    off = spec.calibration_px * spec.noise * rng.uniform(-1, 1, 6)
    focal = camera.fx + off[0] * 2 * camera.fx / camera.width
    true = replace(
        camera, intrinsics=np.array([focal, focal, camera.cx + off[1], camera.cy + off[2]])
    )
    turn = SE3.exp(np.concatenate([np.zeros(3), off[3:] / camera.fx]))
    return replace(mount, camera=true, T_body_camera=mount.T_body_camera @ turn)


def _imu_mount(spec: WorldSpec) -> ImuMount:
    factor = max(spec.noise, 1e-9)
    default = ImuMount()
    return replace(
        default,
        gyro_noise=default.gyro_noise * factor,
        gyro_walk=default.gyro_walk * factor,
        accel_noise=default.accel_noise * factor,
        accel_walk=default.accel_walk * factor,
    )


def _lidar_mounts(spec: WorldSpec, R_imu_carrier: Array) -> tuple[LidarMount, ...]:
    above = R_imu_carrier @ (
        np.array([0.02, 0.0, 0.1]) if spec.kind in HAND_HELD else [0.0, 0.0, 0.6]
    )
    T_imu_lidar = SE3.from_parts(R_imu_carrier, above)
    if "lidar2d" in spec.sensors:
        half = 0.75 * np.pi
        return (
            LidarMount(
                "laser", T_imu_lidar, (0.05, 30.0), spec.rate_hz, "none", (-half, half, 541)
            ),
        )
    if "lidar3d" in spec.sensors:
        return (
            LidarMount("top", T_imu_lidar, (0.4, 100.0), spec.rate_hz, "clockwise", beams=RINGS),
        )
    return ()


def _mount_pose(rig: Rig, name: str) -> SE3:
    if name == "imu":
        return SE3.identity()
    for mount in rig.cameras:
        if mount.name == name:
            return mount.T_body_camera
    return rig.lidars[0].T_body_lidar


def _relative_to(rig: Rig, T_body_imu: SE3, body: str) -> Rig:
    """Move all mounts from the IMU's place to the body."""
    return replace(
        rig,
        cameras=tuple(
            replace(m, T_body_camera=_clean(T_body_imu @ m.T_body_camera)) for m in rig.cameras
        ),
        lidars=tuple(
            replace(m, T_body_lidar=_clean(T_body_imu @ m.T_body_lidar)) for m in rig.lidars
        ),
        body=body,
    )


def _clean(T: SE3) -> SE3:
    """Return the exact identity in place of one up to rounding."""
    return SE3.identity() if np.allclose(T.matrix, np.eye(4), atol=1e-12) else T
