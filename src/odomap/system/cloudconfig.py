"""Settings of SLAM with a 3D LiDAR, in one place and without what they set.

Reading them compiles nothing, so that the command line can show them at once. What they are for is
told where they are used: `cloudtracking`, `cloudclosing`, `cloudrecognition`, `cloudthinning`.
"""

from dataclasses import dataclass

from odomap.errors import ConfigError, nearest_name
from odomap.limits import Count, Fraction, NotNegative, Positive, check_limits

__all__ = [
    "CloudClosingConfig",
    "CloudRecognitionConfig",
    "CloudThinningConfig",
    "CloudTrackingConfig",
]

FRONT_ENDS = ("points", "loam", "lego")


@dataclass(frozen=True)
class CloudTrackingConfig:
    """How sweeps are placed and when one becomes a keyframe."""

    front_end: str = "points"
    """What sweeps are matched by: "points" (surfaces), "loam" (edges and planes) or "lego" (ground
    first, then edges)."""
    farthest: Positive = 100.0
    """Points beyond are not used, metres."""
    min_points: Count = 100
    """Points that must return for a sweep to say anything."""
    min_share: Fraction = 0.12
    """Share of the points that must lie on what is known: 0.16 do on a field, of 16 beams."""
    rounds: Count = 2
    """How often a sweep is laid down, each time deskewed by the motion found before."""
    fastest: Positive = 60.0
    """Speed above which a body does not move, m/s."""
    acceleration: Positive = 5.0
    """Standard deviation of what changes a velocity, m/s²."""
    angular: Positive = 3.0
    """The same of a rotation, rad/s²."""
    unknown: Positive = 10.0
    """Standard deviation of a velocity of which nothing is known, m/s."""
    unknown_rad: Positive = 1.0
    """The same of a rotation, rad/s."""
    unsteady: Positive = 0.08
    """Standard deviation of how a velocity changes from sweep to sweep, until it is seen, m/s."""
    unsteady_rad: Positive = 0.015
    """The same of a rotation, rad/s."""
    unseen: Positive = 2.0
    """Standard deviation of a velocity that nobody saw for a while, m/s."""
    unseen_rad: Positive = 0.5
    """The same of a rotation, rad/s."""
    renewal: NotNegative = 1.0
    """Share of a sweep's error that stays in the map, squared, where a front-end does not say."""
    drift: NotNegative = 0.001
    """What a metre of the way adds to errors whatever points say, as no model of a LiDAR is exact:
    standard deviation over the square root of the way, m/√m. Of a LiDAR that is badly calibrated
    it is more."""
    drift_rad: NotNegative = 3e-5
    """The same of a rotation, rad/√m."""
    seeks_after: Count = 3
    """Sweeps in a row that are placed nowhere, after which the whole map is searched for them."""
    around: Positive = 50.0
    """How far around a body that was recognised the map is matched with, metres."""
    left: Positive = 10.0
    """How far a body that is only placed goes until that is made anew, metres."""
    patience: Count = 10
    """Sweeps in a row that show something and are placed nowhere, after which a piece of the map
    is begun."""
    keyframe_m: Positive = 2.0
    """Distance from the last keyframe at which a sweep becomes one, metres."""
    keyframe_rad: Positive = 0.5
    """The same of the rotation, radians."""
    keyframe_voxel: Positive = 0.3
    """Side of the cells of which a keyframe keeps one point each, metres."""

    def __post_init__(self) -> None:
        check_limits(self)
        if self.front_end not in FRONT_ENDS:
            known = ", ".join(FRONT_ENDS)
            near = nearest_name(self.front_end, FRONT_ENDS)
            raise ConfigError(f"front_end: '{self.front_end}' is none of {known}{near}")


@dataclass(frozen=True)
class CloudClosingConfig:
    """When loops are looked for, and believed."""

    enabled: bool = True
    """Whether places seen before are searched for."""
    rings: Count = 20
    """Rings around the sensor that a place is described by."""
    sectors: Count = 36
    """Sectors of a turn that it is described by."""
    reach: Positive = 60.0
    """How far it is described, metres."""
    beside: NotNegative = 4.0
    """How far to either side of where a place was seen it is recognised, metres."""
    alike: Fraction = 0.4
    """Largest distance of the descriptions of two places that may be one."""
    most: Count = 2
    """Places that a keyframe is laid onto."""
    least_way: Positive = 25.0
    """Way from a place after which one may come back to it, metres."""
    apart: NotNegative = 6.0
    """Way between two keyframes that are tied to earlier ones, metres."""
    least_reach: Positive = 10.0
    """How far from where the path says a place may be at least, metres."""
    drift: Fraction = 0.03
    """The same, of the way since then: odometry may have drifted more than it says."""
    near: Positive = 6.0
    """How near a place must be, as far as the path knows, to be tried whatever it looks like,
    metres."""
    neighbours: NotNegative = 10.0
    """Keyframes so far along the path before and after a place are laid together there, metres."""
    voxel: Positive = 0.6
    """Side of the voxels in which clouds are laid onto each other, metres."""
    max_distance: Positive = 2.0
    """Farthest that points of the two may be apart then, metres."""
    overlap: Fraction = 0.6
    """Share of a cloud that must meet what is known."""
    agree: Fraction = 0.05
    """Share of what stands up in one sweep that the other must have seen, too."""
    misfit: Positive = 0.3
    """Largest root mean square distance of its points from the surface there, in voxels."""
    against: Fraction = 0.08
    """Share of that which the other may have looked through, relative to both."""
    sigma: Positive = 1.0
    """Largest standard deviation of where a place is seen from there, metres."""
    solve_every: Count = 8
    """Keyframes after which the path is solved anew if there are new loops; in large maps more."""
    solve_share: Fraction = 0.02
    """The same, relative to all keyframes."""
    solve_off: Positive = 0.5
    """How far off the path a new loop is for it to be solved at once, metres."""
    slack: NotNegative = 0.003
    """How much more than they say steps of odometry may err while it is decided which loops are
    true, m/√m: a real LiDAR errs by what it knows nothing of."""
    slack_rad: NotNegative = 5e-4
    """The same of a rotation, rad/√m."""
    doubt: Positive = 4.0
    """Factor on all standard deviations while it is decided which loops are true."""
    outlying: Positive = 10.0
    """Standard deviations at which a loop counts half."""

    def __post_init__(self) -> None:
        check_limits(self)


@dataclass(frozen=True)
class CloudRecognitionConfig:
    """When a sweep is recognised in a map, of which nothing else says where it was taken."""

    alike: Fraction = 0.5
    """Largest distance of how it looks and how a place does."""
    most: Count = 6
    """Places that it is laid onto."""
    overlap: Fraction = 0.7
    """Share of it that must meet what is known."""
    misfit: Positive = 0.26
    """Largest root mean square distance of its points from the surface there, in voxels."""
    against: Fraction = 0.05
    """Share of what stands up in one that the other may have looked through."""
    sigma: Positive = 0.5
    """Largest standard deviation of where it is, metres."""

    def __post_init__(self) -> None:
        check_limits(self)


@dataclass(frozen=True)
class CloudThinningConfig:
    """When keyframes go that show nothing new."""

    enabled: bool = True
    """Whether any go: a map then grows with the space seen, and not with time."""
    near: Positive = 6.0
    """How near older keyframes must be that show what one shows, metres."""
    covers: Count = 2
    """How many of them must be so near."""
    voxel: Positive = 0.8
    """Side of the voxels in which clouds are compared, metres."""
    within: Positive = 30.0
    """How far a cloud is compared: beyond, points are few, and far apart; metres."""
    share: Fraction = 0.95
    """Share of a cloud's voxels that older ones must show for its keyframe to go."""
    settled: Count = 20
    """Newest keyframes that stay: the path through them is not settled yet."""

    def __post_init__(self) -> None:
        check_limits(self)
