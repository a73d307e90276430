"""How edges, planes and ground are found and matched: sections of the configuration."""

from dataclasses import dataclass, field

from odomap.limits import Count, Fraction, NotNegative, Positive, check_limits

__all__ = ["CurvatureConfig", "FeatureMapConfig", "GroundConfig", "LegoConfig", "LoamConfig"]


@dataclass(frozen=True)
class CurvatureConfig:
    """What of a scan line is an edge, and what a plane."""

    baseline: Positive = 0.25
    """How far to either side of a point its line is looked at, metres."""
    fewest: Count = 5
    """Points on either side at least."""
    most: Count = 30
    """And at most."""
    noise: Positive = 0.02
    """Standard deviation of a range, metres: what bends less is not bent."""
    sharp: Fraction = 0.25
    """Curvature from which on a point is an edge."""
    flat: Fraction = 0.06
    """Curvature up to which it lies in a plane."""
    grazing: Fraction = 0.12
    """Sine of the angle between beam and line below which the line says nothing."""
    gap: Positive = 0.15
    """How far neighbours may be apart on one surface however near, metres."""
    missing: Positive = 4.0
    """Steps of the beam without a return, from which on nobody knows what lies between."""
    thin: NotNegative = 0.3
    """Width up to which what stands alone is an edge, such as a post, metres."""
    sectors: Count = 6
    """Parts of a line, from each of which as many features are taken."""
    edges: Count = 6
    """Most edges of a part."""
    planes: Count = 16
    """Most planes of a part."""
    least_planes: Count = 2000
    """Planes that are taken in all where lines are few, if there are as many."""

    def __post_init__(self) -> None:
        check_limits(self)


@dataclass(frozen=True)
class FeatureMapConfig:
    """What edges and planes are laid onto."""

    voxel: NotNegative = 0.0
    """Side of the voxels in which planes are summed up, metres; 0 chooses it by how far the first
    sweep sees."""
    voxel_share: Positive = 0.07
    """Of the median range, where it is chosen."""
    least_voxel: Positive = 0.3
    """Smallest that is chosen, metres."""
    most_voxel: Positive = 0.8
    """Largest that is chosen, metres."""
    edge_share: Positive = 0.75
    """Side of the voxels in which edges are summed up, in those of planes."""
    radius: Positive = 100.0
    """What is farther from the sensor is forgotten, metres."""
    most: Count = 400
    """Points summed up in a voxel at most."""
    thickness: Positive = 0.12
    """Standard deviation of the points across a plane or an edge, from which on it is none, m."""
    reach: Positive = 2.0
    """How far from the middle of what it lies on a feature may be at first, in voxels."""
    iterations: Count = 12
    """Steps at most."""

    def __post_init__(self) -> None:
        check_limits(self)


@dataclass(frozen=True)
class GroundConfig:
    """What is ground, and what stands on it."""

    slope: Positive = 0.18
    """Most that the ground may slope from one ring to the next, radians."""
    same: Positive = 0.17
    """Angle of the beam with the line between neighbours, from which on they are of one thing."""
    smallest: Count = 30
    """Points of a thing that is kept."""
    narrow: Count = 5
    """Points of one that is kept if it is seen by three rings or more."""

    def __post_init__(self) -> None:
        check_limits(self)


@dataclass(frozen=True)
class LoamConfig:
    """LOAM's edges and planes."""

    curvature: CurvatureConfig = field(default_factory=CurvatureConfig)
    """What is an edge or a plane."""
    map: FeatureMapConfig = field(default_factory=FeatureMapConfig)
    """What they are laid onto."""


@dataclass(frozen=True)
class LegoConfig(LoamConfig):
    """LeGO-LOAM's ground, things, edges and planes."""

    ground: GroundConfig = field(default_factory=GroundConfig)
    """What is ground, and what stands on it."""
