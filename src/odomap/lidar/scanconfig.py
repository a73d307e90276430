"""What of a 2D scan is used: a section of the configuration, apart from what is compiled."""

from dataclasses import dataclass

from odomap.limits import NotNegative, Positive, check_limits

__all__ = ["ScanConfig"]


@dataclass(frozen=True)
class ScanConfig:
    """What of a scan is used."""

    farthest: Positive = 20.0
    """Ranges beyond are not used, metres."""
    free: NotNegative = 0.0
    """How far the way is free where nothing came back, metres; 0 says nothing of it, since glass
    and black walls do not come back either."""
    spacing: Positive = 0.035
    """Distance of points on the surface between neighbouring beams, metres."""
    gap: Positive = 0.5
    """Distance of neighbouring points from which on they are not of one surface, metres."""
    ratio: Positive = 10.0
    """The same, in distances of the beams there: how flat a surface may be seen."""
    grain: Positive = 0.05
    """Distance of beams from which on a point of no surface counts less, metres."""
    baseline: Positive = 0.25
    """How far to either side of a point a surface is looked at for its normal, metres."""
    bend: Positive = 0.5
    """What it may turn there, radians: more is a corner."""

    def __post_init__(self) -> None:
        check_limits(self)
