"""How a body with a laser moved since the last scan, before the scan is looked at.

Wheels say it, wrongly by some share of the way and of the turn, and now and then by more; without
them the body is taken to go on as before, which is no measurement and far less sure,

    Q = diag(σ_xy, σ_xy, σ_θ)²,    σ_xy = σ₀ + s d + 0.2 s |θ|,    σ_θ = σ_θ0 + s |θ| + v d.

Stamps of old logs jump back; what is behind the newest one so far took no time.

Reference: S. Thrun, W. Burgard, D. Fox, "Probabilistic robotics", MIT Press 2005, chapter 5.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.planar import between_planar, to_plane
from odomap.sensors.frame import Frame
from odomap.system.scanconfig import ScanTrackingConfig

__all__ = ["Loss", "Motion", "ScanMotion"]

Array = NDArray[np.float64]


MOVED = 0.02, 0.02
"""Way and turn, metres and radians, after which scans cannot be the same."""


@dataclass(frozen=True, eq=False)
class Motion:
    """How a body should have moved: (3,), with (3, 3), and whether that was measured."""

    x: Array
    noise: Array
    is_measured: bool

    @property
    def has_moved(self) -> bool:
        """Whether wheels say that it did, by more than nothing."""
        way, turn = np.hypot(*self.x[:2]), abs(self.x[2])
        return self.is_measured and bool(way > MOVED[0] or turn > MOVED[1])


@dataclass
class Loss:
    """Scans in a row that do not show what they should, the way meanwhile, metres, and whether the
    last one before them did so without a doubt."""

    scans: int = 0
    way: float = 0.0
    is_sudden: bool = False

    def add(self, motion: Motion, was_clean: bool) -> None:
        """Count a scan."""
        self.is_sudden = was_clean if self.scans == 0 else self.is_sudden
        self.scans += 1
        self.way += float(np.hypot(*motion.x[:2]))

    def forget(self) -> None:
        """Begin anew."""
        self.scans, self.way = 0, 0.0


class ScanMotion:
    """Predicts motion from scan to scan.

    Args:
        config: how unsure it is.

    Attributes:
        x_odom_body: (3,) where the wheels say that the body is; None where they say nothing.
    """

    def __init__(self, config: ScanTrackingConfig) -> None:
        self._config = config
        self.x_odom_body: Array | None = None
        self._step, self._step_s, self._stamp_ns = np.zeros(3), 0.0, 0

    def read(self, frame: Frame) -> Array | None:
        """Return where (3,) the wheels say that the body is, if they say it and are asked."""
        if frame.odometry is None or not self._config.use_odometry:
            return None
        return to_plane(frame.odometry)

    def begin(self, frame: Frame) -> None:
        """Begin with a frame."""
        self._stamp_ns, self.x_odom_body = frame.stamp_ns, self.read(frame)

    def until(self, frame: Frame) -> Motion:
        """Return the motion since the frame before."""
        config, before = self._config, self.x_odom_body
        seconds = max((frame.stamp_ns - self._stamp_ns) * 1e-9, 0.0)
        self._stamp_ns = max(frame.stamp_ns, self._stamp_ns)
        self.x_odom_body = self.read(frame)
        is_measured = before is not None and self.x_odom_body is not None
        if before is not None and self.x_odom_body is not None:
            x, share = between_planar(before, self.x_odom_body), config.slip
            least = config.jitter, config.jitter_rad
        else:
            least = config.shake, config.shake_rad
            usual = self._step_s if self._step_s > 0.0 else seconds
            x = self._step * (min(seconds / usual, 3.0) if usual > 0.0 else 1.0)
            share = config.unsteady
        way, turn = float(np.hypot(*x[:2])), abs(float(x[2]))
        sigma = least[0] + share * way + 0.2 * config.slip * turn
        sigma_rad = least[1] + share * turn + config.veer * way
        return Motion(x, np.diag([sigma, sigma, sigma_rad]) ** 2, is_measured)

    def note(self, step: Array, seconds: float) -> None:
        """Keep how the body moved (3,), for a prediction without odometry."""
        self._step, self._step_s = step, seconds

    def stop(self) -> None:
        """Take the body to stand still, as nobody knows how it moves."""
        self._step = np.zeros(3)
