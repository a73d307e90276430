"""The simulated world as a source: frames are rendered as they are asked for.

A world is given by a `WorldSpec`, by a name such as ``sim:room?seed=3&frames=100``, or by a file
`world.yaml` (or the folder that holds it):

    odomap_world: 1
    kind: street
    seed: 3
    frames: 200

With `sensors=laser` it is a floor plan driven through by a robot with a 2D laser and wheels, and no
images: ``sim:building?sensors=laser&seed=3&rounds=2`` (see `simulation.laserworld`). With
`sensors=lidar3d` alone it holds sweeps of a 3D LiDAR, and no images either:
``sim:street?sensors=lidar3d&beams=64&pattern=solid_state`` (see `simulation.sweepworld`).
"""

import dataclasses
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_type_hints
from urllib.parse import parse_qsl

import numpy as np
from numpy.typing import NDArray

from odomap.errors import ConfigError, InputError, OdomapError, nearest_name
from odomap.geometry.trajectory import Trajectory
from odomap.sensors.frame import Frame
from odomap.simulation.laserworld import LaserSpec, LaserWorld
from odomap.simulation.sweepspec import SweepSpec
from odomap.simulation.world import World, WorldSpec
from odomap.sources.source import Skipped

if TYPE_CHECKING:
    from odomap.simulation.sweepworld import SweepWorld

__all__ = ["SimulatedSource", "is_simulated", "read_spec"]

PREFIX = "sim:"
VERSION_FIELD = "odomap_world"

Spec = WorldSpec | LaserSpec | SweepSpec


def is_simulated(data: str | Path) -> bool:
    """Tell whether a name or path means a simulated world."""
    if str(data).startswith(PREFIX):
        return True
    path = Path(data)
    if path.is_dir():
        path = path / "world.yaml"
    return path.name.endswith("world.yaml") and path.is_file()


def read_spec(data: str | Path) -> Spec:
    """Read what decides a world from a name or a file; one for a LiDAR where sensors says so.

    Args:
        data: ``sim:KIND?field=value&...``, a `world.yaml`, or a folder that holds one.

    Raises:
        InputError: the file is missing or not YAML.
        ConfigError: a field is unknown or its value cannot be.
    """
    text = str(data)
    if text.startswith(PREFIX):
        kind, _, query = text[len(PREFIX) :].partition("?")
        given: dict[str, Any] = dict(parse_qsl(query, keep_blank_values=True))
        return _spec(text, {"kind": kind or "room", **given})
    path = Path(data)
    if path.is_dir():
        path = path / "world.yaml"
    return _spec(str(path), _read_yaml(path))


def _read_yaml(path: Path) -> dict[str, Any]:
    import yaml

    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{path}: not a YAML file: {reason}") from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: empty or not a list of `field: value`: add '{VERSION_FIELD}: 1'")
    version = content.pop(VERSION_FIELD, None)
    if version is None:
        near = nearest_name(VERSION_FIELD, [str(key) for key in content])
        raise ConfigError(
            f"{path}: field '{VERSION_FIELD}' is missing{near}: add '{VERSION_FIELD}: 1'"
        )
    if version != 1:
        raise ConfigError(f"{path}: {VERSION_FIELD}: version {version} is not known, only 1 is")
    return {str(key): value for key, value in content.items()}


def _spec(where: str, given: Mapping[str, Any]) -> Spec:
    sensors = given.get("sensors", ())
    asked = sensors.split(",") if _is_text(sensors) else sensors
    asked = tuple(asked) if isinstance(asked, Iterable) else ()
    kind: type[Spec] = WorldSpec
    if "laser" in asked:
        kind = LaserSpec
    elif asked == ("lidar3d",):
        kind = SweepSpec
    known = {f.name: f.default for f in dataclasses.fields(kind)}
    values: dict[str, Any] = {}
    for name, value in given.items():
        if name not in known:
            raise ConfigError(
                f"{where}: there is no field '{name}'{nearest_name(name, known)}; "
                f"known: {', '.join(known)}"
            )
        values[name] = _value(where, name, value, get_type_hints(kind)[name])
    try:
        return kind(**values)
    except OdomapError as error:
        raise ConfigError(f"{where}: {error}") from error


def _value(where: str, name: str, value: Any, kind: Any) -> Any:
    """Convert text or a YAML value to the type of its field."""
    try:
        if kind is int:
            if isinstance(value, bool) or (isinstance(value, float) and value != int(value)):
                raise ValueError
            return int(value)
        if kind is float:
            if isinstance(value, bool):
                raise ValueError
            return float(value)
        if kind is str:
            return str(value)
        items = (
            value.replace("x", ",").split(",")
            if name == "resolution" and _is_text(value)
            else value
        )
        items = items.split(",") if _is_text(items) else list(items)
        if name == "resolution":
            width, height = (int(item) for item in items)
            return width, height
        return tuple(str(item).strip() for item in items if str(item).strip())
    except (TypeError, ValueError) as error:
        wanted = {
            "resolution": "two whole numbers, [width, height]",
            "sensors": "a list of names",
        }.get(name, {int: "a whole number", float: "a number"}.get(kind, "a text"))
        raise ConfigError(f"{where}: {name}: '{value}' is not {wanted}") from error


def _is_text(value: object) -> bool:
    return isinstance(value, str)


class SimulatedSource:
    """Frames of a simulated world, rendered one at a time.

    Args:
        world: what decides it, a name, or a path to its `world.yaml`.

    Attributes:
        world: what is measured; one for a laser has the true plan and the true ranges, too, one for
            a 3D LiDAR knows what every point shows.
        odometry: (N, 4, 4) what the wheels say, of a world for a laser; else None.

    Example:
        >>> source = SimulatedSource("sim:room?seed=1&frames=2&resolution=64x48")
        >>> [frame.id for frame in source]
        [0, 1]
    """

    def __init__(self, world: Spec | str | Path) -> None:
        spec = read_spec(world) if isinstance(world, str | Path) else world
        self.world = _world_of(spec)
        self.odometry: NDArray[np.float64] | None = None
        sensors = ""
        if isinstance(self.world, LaserWorld):
            self.odometry, sensors = self.world.odometry, "sensors=laser&"
        elif isinstance(spec, SweepSpec):
            sensors = "sensors=lidar3d&"
        self.name = f"sim:{spec.kind}?{sensors}seed={spec.seed}&frames={len(self.world)}"
        self.rig = self.world.rig
        self.truth: Trajectory | None = self.world.truth
        self.stamps_ns: NDArray[np.int64] = self.world.truth.stamps_ns
        self.skipped: list[Skipped] = []

    def __len__(self) -> int:
        return len(self.world)

    def frame(self, index: int) -> Frame:
        """Render one frame, from 0 to len - 1."""
        return self.world.frame(index)

    def __iter__(self) -> Iterator[Frame]:
        self.skipped = []
        for index in range(len(self.world)):
            yield self.world.frame(index)


def _world_of(spec: Spec) -> "World | LaserWorld | SweepWorld":
    if isinstance(spec, LaserSpec):
        return LaserWorld(spec)
    if isinstance(spec, SweepSpec):
        # Imported where needed: who looks at pictures shall not wait until its kernels compile.
        from odomap.simulation.sweepworld import SweepWorld

        return SweepWorld(spec)
    return World(spec)
