"""Sections of the configuration for what sees, apart from what is compiled.

A laser takes them in its configuration like everybody, and need not load how images are read."""

from dataclasses import dataclass
from typing import Annotated, Literal

from odomap.errors import ConfigError
from odomap.limits import Correlation, Count, Fraction, Limits, NotNegative, Positive, check_limits

__all__ = [
    "BootstrapConfig",
    "DepthConfig",
    "Detector",
    "FeatureConfig",
    "FlowConfig",
    "MatchConfig",
    "OrbConfig",
    "StereoConfig",
]


@dataclass(frozen=True)
class BootstrapConfig:
    """When two views of one camera are enough to start."""

    min_parallax_px: NotNegative = 1.5
    """Median displacement that no rotation explains; several times the noise of a point."""
    min_points: Annotated[int, Limits(least=8)] = 60
    """Points that must be triangulated, and matches needed to try."""
    max_error_px: Positive = 1.5
    """Largest distance of a match from its epipolar line, or of a point from where it was seen."""
    max_ambiguity: Fraction = 0.85
    """Another motion must explain less than this share of the points of the best."""

    def __post_init__(self) -> None:
        check_limits(self)


@dataclass(frozen=True)
class DepthConfig:
    """What a depth sensor knows."""

    noise: Positive = 0.002
    """Standard deviation of inverse depth, 1/m: 2 mm at 1 m, 3 cm at 4 m."""
    calibration: NotNegative = 0.001
    """How far all inverse depths may be off together, 1/m."""
    nearest: Positive = 0.2
    """Depth below this is not believed, metres."""
    farthest: Positive = 8.0
    """Depth beyond this is not believed, metres."""
    edge: NotNegative = 0.06
    """Pixels around a point whose depth differs by more than this fraction lie on two objects."""

    def __post_init__(self) -> None:
        check_limits(self)
        if self.nearest >= self.farthest:
            raise ConfigError(f"nearest: {self.nearest} must be below farthest, {self.farthest}")


Detector = Literal["fast", "harris", "orb", "sift"]


@dataclass(frozen=True)
class FeatureConfig:
    """How corners are found."""

    detector: Detector = "fast"
    """Corner detector: fast, harris, orb or sift."""
    count: Count = 300
    """Features wanted per keyframe."""
    threshold: Annotated[int, Limits(least=1, most=255)] = 12
    """FAST contrast threshold, grey levels; halved once where too few corners pass."""
    border_px: Annotated[int, Limits(least=0)] = 12
    """Margin at the image border in which no feature is taken."""

    def __post_init__(self) -> None:
        check_limits(self)


@dataclass(frozen=True)
class FlowConfig:
    """How points are followed from image to image."""

    half_window_px: Count = 6
    """Half the patch side: 6 gives 13x13 pixels."""
    levels: Count = 3
    """Pyramid levels; each doubles the motion that can be followed."""
    iterations: Count = 12
    """Most Gauss-Newton steps per level."""
    min_correlation: Correlation = 0.75
    """Smallest normalised correlation of a patch with its template."""
    max_backward_px: NotNegative = 0.7
    """Largest distance between a point and where tracking it back ends; 0 leaves the check out."""

    def __post_init__(self) -> None:
        check_limits(self)


@dataclass(frozen=True)
class MatchConfig:
    """How descriptors are matched."""

    radius_px: Positive = 24.0
    """Search radius around the expected position."""
    ratio: Fraction = 0.85
    """The best distance must be below this fraction of the second best."""
    max_hamming: Annotated[int, Limits(least=0, most=256)] = 64
    """Largest distance of binary descriptors, bits of 256."""
    max_euclidean: NotNegative = 250.0
    """Largest distance of SIFT descriptors."""

    def __post_init__(self) -> None:
        check_limits(self)


@dataclass(frozen=True)
class OrbConfig:
    """How ORB features are found."""

    count: Count = 1000
    """Features wanted per image."""
    levels: Annotated[int, Limits(least=1, most=16)] = 8
    """Levels of the image pyramid."""
    scale: Annotated[float, Limits(least=1.05, most=2)] = 1.2
    """Size of a level relative to the one above it."""
    threshold: Annotated[int, Limits(least=1, most=254)] = 20
    """FAST contrast threshold, grey levels."""
    least_threshold: Annotated[int, Limits(least=1, most=254)] = 7
    """Threshold in cells where no corner passes the other."""

    def __post_init__(self) -> None:
        check_limits(self)
        if self.least_threshold > self.threshold:
            raise ConfigError(
                f"least_threshold: {self.least_threshold} must be at most threshold, "
                f"{self.threshold}"
            )


@dataclass(frozen=True)
class StereoConfig:
    """How disparities are measured."""

    method: Literal["sparse", "sgbm"] = "sparse"
    """sparse: sub-pixel matches of the features; sgbm: a dense map, looked up at the features."""
    max_disparity_px: Count = 128
    """Largest disparity searched; nearer points get no depth."""
    half_search_px: Count = 4
    """Half the side of the window in the search along the row."""
    half_refine_px: Count = 4
    """Half the side of the patch in the sub-pixel step."""
    uniqueness: Fraction = 0.75
    """The best score must be below this fraction of the best score elsewhere on the row."""
    min_correlation: Correlation = 0.8
    """Smallest normalised correlation of the two patches."""
    max_vertical_px: NotNegative = 0.5
    """Largest distance of a match from its row."""
    noise_px: Positive = 0.8
    """Standard deviation of a disparity."""

    def __post_init__(self) -> None:
        check_limits(self)
