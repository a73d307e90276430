"""How sweeps are laid onto each other: settings, apart from what is compiled."""

from dataclasses import dataclass

from odomap.limits import Fraction, NotNegative, Positive, check_limits

__all__ = ["PointsConfig"]


@dataclass(frozen=True)
class PointsConfig:
    """How the front-end "points" lays sweeps onto surfaces."""

    voxel: NotNegative = 0.0
    """Side of a voxel of surfaces, metres; 0 chooses it by how far the first sweep sees."""
    voxel_share: Positive = 0.1
    """Of the median range, where it is chosen."""
    least_voxel: Positive = 0.25
    """Smallest that is chosen, metres."""
    most_voxel: Positive = 1.0
    """Largest that is chosen, metres."""
    added: Positive = 0.25
    """Side of the cells of which one point each is added, in voxels."""
    matched: Positive = 1.5
    """The same of points that are matched, in voxels."""
    sigma: Positive = 0.04
    """Least thickness of surfaces, standard deviation, in voxels."""
    farthest: Positive = 100.0
    """Distance from which on surfaces are forgotten, in voxels."""
    first_off: Positive = 0.5
    """How far the very first guesses may be off, metres."""
    learning: Fraction = 0.1
    """Weight of the last sweep in how far they are off."""
    alike: Positive = 2.0
    """Points that are one witness, as they share the errors of the surfaces they lie on."""
    least_spread: Positive = 0.1
    """Least mean square of distances that is believed, in variances of the thickness."""

    def __post_init__(self) -> None:
        check_limits(self)
