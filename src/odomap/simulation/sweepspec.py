"""What decides a world for a 3D LiDAR, apart from the world: reading it compiles nothing.

Defaults are those of real sensors: 10 turns a second, 1,800 columns (0.2 degrees), 32 beams, 100 m.

Reference: J. Tobin et al., "Domain randomization for transferring deep neural networks from
simulation to the real world", IROS 2017 (worlds that are drawn).
"""

from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from odomap.errors import ConfigError, nearest_name

__all__ = ["HAND_HELD", "NEAREST_M", "PATTERNS", "WORLDS", "SweepSpec"]

WORLDS = ("street", "room", "building", "tunnel", "field")
HAND_HELD = ("room", "building")
PATTERNS = ("rotating", "solid_state")
NEAREST_M = 0.4
"""What is nearer does not return."""
COLUMNS = MappingProxyType({"rotating": 1800, "solid_state": 1500})


@dataclass(frozen=True)
class SweepSpec:
    """What decides a world for a 3D LiDAR, to the last byte."""

    kind: str = "street"
    """"street" (a circuit of 500 to 650 m that rises and falls), "room", "building" (corridors and
    rooms, 60 m round), both hand-held, "tunnel" (long and featureless) or "field" (flat ground and
    nothing else)."""
    seed: int = 0
    """Which of the worlds of its kind."""
    frames: int = 0
    """How many sweeps there are; 0 for as many as the rounds take."""
    rounds: float = 0.0
    """How often one goes round, where frames do not say; 0 for 1.15, and in a tunnel for 0.35."""
    rate_hz: float = 10.0
    """Sweeps per second."""
    speed: float = 0.0
    """Mean speed in m/s; 0 for 0.6 in a room, 0.8 in a building and 7.5 outdoors."""
    noise: float = 1.0
    """Factor on all imperfections of the LiDAR; 0 for an ideal one."""
    beams: int = 32
    """Above each other, of which as many leave at once."""
    columns: int = 0
    """Steps of a sweep; 0 for 1800 of a rotating and 1500 of a solid-state LiDAR."""
    pattern: str = "rotating"
    """"rotating", or "solid_state": a rosette of 70 x 77 degrees ahead that never repeats."""
    range_m: float = 100.0
    """Beyond this nothing returns."""
    moving_objects: int = 0
    """How many cars (in a street), trolleys or cartons move; sixty cars are a fifth of the
    points."""
    sensors: tuple[str, ...] = ("lidar3d",)
    """A 3D LiDAR, always."""

    def __post_init__(self) -> None:
        for name, known in (("kind", WORLDS), ("pattern", PATTERNS)):
            value = getattr(self, name)
            if value not in known:
                names = ", ".join(known)
                raise ConfigError(
                    f"{name}: '{value}' is none of {names}{nearest_name(value, known)}"
                )
        if self.sensors != ("lidar3d",):
            raise ConfigError("sensors: a world for a LiDAR has 'lidar3d' alone")
        for name, low, high in (("beams", 1, 256), ("columns", 0, 20_000)):
            if not low <= getattr(self, name) <= high:
                raise ConfigError(f"{name}: {getattr(self, name)} must be from {low} to {high}")
        for name in ("seed", "frames", "moving_objects"):
            if getattr(self, name) < 0:
                raise ConfigError(f"{name}: {getattr(self, name)} must be 0 or more")
        for name in ("rounds", "speed", "noise"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise ConfigError(f"{name}: {value} must be finite and not negative")
        for name in ("rate_hz", "range_m"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > (NEAREST_M if name == "range_m" else 0)):
                raise ConfigError(f"{name}: {value} must be finite and above 0")

    def completed(self) -> "SweepSpec":
        """Return the spec with the values that depend on the kind filled in."""
        walk = 0.6 if self.kind == "room" else 0.8
        return replace(
            self,
            rounds=self.rounds or (0.35 if self.kind == "tunnel" else 1.15),
            speed=self.speed or (walk if self.kind in HAND_HELD else 7.5),
            columns=self.columns or COLUMNS[self.pattern],
        )
