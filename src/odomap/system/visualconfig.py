"""Sections of the configuration for SLAM with cameras, apart from what is compiled.

A laser takes them in its configuration like everybody, and need not load how they are used."""

from dataclasses import dataclass
from typing import Annotated, Literal

from odomap.limits import Count, Fraction, Limits, NotNegative, Positive, check_limits

__all__ = [
    "CandidateConfig",
    "ClosingConfig",
    "CreateConfig",
    "CullConfig",
    "FuseConfig",
    "LocalMapConfig",
    "MappingConfig",
    "NoiseConfig",
    "PlacesConfig",
    "TrackingConfig",
    "WindowConfig",
]


@dataclass(frozen=True)
class TrackingConfig:
    """How frames are placed and when one becomes a keyframe."""

    sensors: Literal["mono", "stereo", "rgbd", "lidar2d", "lidar"] = "stereo"
    """mono: one camera, scale is free; stereo: a pair; rgbd: one camera with a depth image;
    lidar2d: a laser, which no other section of cameras is of use to."""
    association: Literal["features", "flow"] = "features"
    """features: found in every frame and known by their descriptors; SLAM finds them on all levels
    of a pyramid (`orb`), odometry with the detector of `features`. flow: patches followed from the
    last keyframe by optical flow, for speed."""
    min_inliers: Annotated[int, Limits(least=4)] = 15
    """Observations that must agree with a pose for it to count as tracked."""
    min_coverage: Fraction = 0.08
    """Part of the image that they must be spread over, or half of what it was at the start."""
    keyframe_ratio: Fraction = 0.85
    """A keyframe is made when inliers fall below this fraction of those just after the last one."""
    keyframe_motion: NotNegative = 0.04
    """A keyframe is made when points have moved by this fraction of the image width (median)."""
    keyframe_interval: Count = 20
    """A keyframe is made after this many frames in any case."""
    patience: Annotated[int, Limits(least=0)] = 5
    """Frames that may be lost before odometry starts anew."""
    max_prediction_s: NotNegative = 0.3
    """Velocity is trusted for this long; after a longer gap it is not extrapolated further."""

    def __post_init__(self) -> None:
        check_limits(self)


@dataclass(frozen=True)
class CandidateConfig:
    """How corners without depth become landmarks."""

    follow: bool = False
    """Whether they are followed; if not, only corners with a measured depth are of use."""
    min_parallax_deg: Annotated[float, Limits(above=0, most=180)] = 1.0
    """Angle between two rays from which on they are triangulated."""
    max_error_px: Positive = 1.5
    """Largest distance of the point's projections from where it was seen (root mean square)."""
    views: Count = 5
    """Keyframes over which one is followed; after that it starts afresh."""

    def __post_init__(self) -> None:
        check_limits(self)


@dataclass(frozen=True)
class CreateConfig:
    """Which matches become landmarks."""

    neighbours: Count = 10
    """Covisible keyframes in which keypoints are looked for."""
    min_baseline: NotNegative = 0.01
    """Distance from a neighbour relative to the median depth there, for a single camera."""
    min_parallax_deg: Annotated[float, Limits(above=0, most=180)] = 1.15
    """Angle between two rays, or what a measured depth is worth, from which depth is known."""
    scale_tolerance: Annotated[float, Limits(least=1)] = 1.5
    """Factor, besides that of one level, by which sizes in the image may contradict distances."""

    def __post_init__(self) -> None:
        check_limits(self)


Age = Annotated[int, Limits(least=0)]
"""How many keyframes ago."""


@dataclass(frozen=True)
class CullConfig:
    """What goes from the map."""

    redundant: Fraction = 0.7
    """Part of a keyframe's landmarks that others must see as well for it to go."""
    observers: Count = 3
    """Other keyframes that must see a landmark as well."""
    keyframes: Count = 2
    """Keyframes that may go at a time."""
    min_found: Fraction = 0.1
    """Part of the frames that expected a landmark in which it must be found."""
    min_age: Age = 2
    """Keyframes after its making from which on a landmark must have its observers."""
    max_age: Age = 3
    """Keyframes after its making until which a landmark is on probation."""
    min_observers: Count = 3
    """Keyframes that must see a landmark of a single camera."""
    min_observers_ranged: Count = 2
    """Keyframes that must see a landmark whose depth was measured."""

    def __post_init__(self) -> None:
        check_limits(self)


@dataclass(frozen=True)
class FuseConfig:
    """Where landmarks are looked for again."""

    radius_px: Positive = 3.0
    """Search radius around the expected position, in pixels of the expected level."""
    max_angle_deg: Annotated[float, Limits(above=0, most=180)] = 60.0
    """Angle from the mean direction of its observers beyond which a landmark looks different."""

    def __post_init__(self) -> None:
        check_limits(self)


@dataclass(frozen=True)
class LocalMapConfig:
    """What is searched for in a frame, and how."""

    keyframes: Count = 20
    """Keyframes whose landmarks are looked for, of those that share any with the last frame."""
    near: Count = 5
    """Further keyframes that look at the same place from nearby."""
    near_distance: NotNegative = 0.3
    """How near those are, as a fraction of the median distance of landmarks."""
    near_angle_deg: NotNegative = 30.0
    """How much their directions of view may differ."""
    first_radius_px: Positive = 12.0
    """Search radius around what motion predicts, on the finest level."""
    radius_px: Positive = 4.0
    """Search radius once the pose is known well, on the finest level."""

    def __post_init__(self) -> None:
        check_limits(self)


@dataclass(frozen=True)
class MappingConfig:
    """Which part of the map is worked on when there is a new keyframe."""

    size: Count = 10
    """Keyframes adjusted: the new one and those that share most landmarks with it."""
    fixed: Count = 10
    """Further keyframes that see the same landmarks, and hold them in place."""
    min_shared: Count = 15
    """Landmarks that a keyframe must share with the new one to be adjusted with it."""
    gate: Positive = 3.5
    """Residual, in standard deviations, beyond which an observation is dropped."""

    def __post_init__(self) -> None:
        check_limits(self)


@dataclass(frozen=True)
class ClosingConfig:
    """When loops are looked for, and closed."""

    enabled: bool = True
    """Whether places seen before are recognised and the path is corrected there."""
    recent: Count = 10
    """Newest keyframes that are no places seen before."""
    rest: Count = 10
    """Keyframes after a loop was closed in which no other is."""
    most: Count = 2
    """Places that geometry is asked about at a keyframe."""
    min_shared: Count = 15
    """Landmarks that two keyframes must share to be tied by them: no loop is needed."""
    strong_shared: Count = 100
    """Landmarks that they must share to hold each other in place when the path is corrected."""

    def __post_init__(self) -> None:
        check_limits(self)


@dataclass(frozen=True)
class WindowConfig:
    """The window of keyframes adjusted together."""

    size: Count = 7
    """Keyframes adjusted."""
    fixed: Count = 2
    """Older keyframes that hold them in place."""
    gate: Positive = 3.5
    """Residual, in standard deviations, beyond which an observation is dropped."""

    def __post_init__(self) -> None:
        check_limits(self)


@dataclass(frozen=True)
class PlacesConfig:
    """By which words places are recognised."""

    vocabulary: str = ""
    """File of a vocabulary, as `odomap vocabulary train` writes it; none: that which comes with
    odomap. A map holds no words: one made with another vocabulary gets them anew."""


@dataclass(frozen=True)
class NoiseConfig:
    """How far what is measured may be off."""

    position_px: Positive = 0.4
    """Standard deviation of the position of a point followed by optical flow."""
    feature_px: Positive = 0.45
    """Standard deviation of the position of a feature found on the finest level of the pyramid."""
    overlap: Positive = 4.0
    """Factor on variances for errors that observations share: patches overlap, tracks go on."""
    calibration_px: NotNegative = 0.15
    """Standard deviation of the calibration: of disparities (offset, slopes), and of the camera's
    direction on the body."""

    def __post_init__(self) -> None:
        check_limits(self)
