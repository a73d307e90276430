"""Configuration: the sections of all stages, gathered, and the presets.

Each section is a frozen dataclass in its stage's own file, with a docstring under every field. This
file only gathers them and names the presets.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from odomap.backend.bundleconfig import BundleConfig
from odomap.errors import CalibrationError, ConfigError, nearest_name
from odomap.lidar.cloudconfig import PointsConfig
from odomap.lidar.featureconfig import CurvatureConfig, FeatureMapConfig, GroundConfig
from odomap.lidar.scanconfig import ScanConfig
from odomap.sensors.rig import Rig
from odomap.system.adjusting import AdjustingConfig
from odomap.system.background import ThreadConfig
from odomap.system.cloudconfig import (
    CloudClosingConfig,
    CloudRecognitionConfig,
    CloudThinningConfig,
    CloudTrackingConfig,
)
from odomap.system.scanconfig import (
    ScanClosingConfig,
    ScanThinningConfig,
    ScanTrackingConfig,
    SubmapConfig,
)
from odomap.system.visualconfig import (
    CandidateConfig,
    ClosingConfig,
    CreateConfig,
    CullConfig,
    FuseConfig,
    LocalMapConfig,
    MappingConfig,
    NoiseConfig,
    PlacesConfig,
    TrackingConfig,
    WindowConfig,
)
from odomap.vision.visionconfig import (
    BootstrapConfig,
    DepthConfig,
    FeatureConfig,
    FlowConfig,
    MatchConfig,
    OrbConfig,
    StereoConfig,
)

if TYPE_CHECKING:
    from odomap.system.association import Association

__all__ = [
    "PRESETS",
    "Config",
    "make_association",
    "odometry_preset",
    "preset",
    "preset_for",
]


LASER: Final = "lidar2d"
LIDAR: Final = "lidar"
"""What `tracking.sensors` says of a 2D laser and of a 3D LiDAR, to which sections of cameras are of
no use."""
NO_LOOPS = ClosingConfig(enabled=False)
"""Where landmarks are followed by optical flow: it is for speed, and describes one level only."""


@dataclass(frozen=True)
class Config:
    """All sections of a run."""

    features: FeatureConfig = field(default_factory=FeatureConfig)
    """How corners are found."""
    flow: FlowConfig = field(default_factory=FlowConfig)
    """How points are followed from image to image."""
    matching: MatchConfig = field(default_factory=MatchConfig)
    """How descriptors are matched."""
    orb: OrbConfig = field(default_factory=OrbConfig)
    """How features are found on all levels of a pyramid, and described."""
    stereo: StereoConfig = field(default_factory=StereoConfig)
    """How disparities are measured."""
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    """How frames are placed and when one becomes a keyframe."""
    window: WindowConfig = field(default_factory=WindowConfig)
    """The window of keyframes adjusted together."""
    bundle: BundleConfig = field(default_factory=BundleConfig)
    """How a bundle is solved."""
    depth: DepthConfig = field(default_factory=DepthConfig)
    """What a depth sensor knows."""
    candidates: CandidateConfig = field(default_factory=CandidateConfig)
    """How corners without depth become landmarks."""
    bootstrap: BootstrapConfig = field(default_factory=BootstrapConfig)
    """When two views of one camera are enough to start."""
    noise: NoiseConfig = field(default_factory=NoiseConfig)
    """How far what is measured may be off."""
    local: LocalMapConfig = field(default_factory=LocalMapConfig)
    """What of the map is searched for in a frame."""
    mapping: MappingConfig = field(default_factory=MappingConfig)
    """Which part of the map is worked on when there is a new keyframe."""
    fusing: FuseConfig = field(default_factory=FuseConfig)
    """When two landmarks are one."""
    creating: CreateConfig = field(default_factory=CreateConfig)
    """Which matches become landmarks."""
    culling: CullConfig = field(default_factory=CullConfig)
    """What goes from the map."""
    places: PlacesConfig = field(default_factory=PlacesConfig)
    """By which words places are recognised."""
    closing: ClosingConfig = field(default_factory=ClosingConfig)
    """When loops are looked for, and closed."""
    adjusting: AdjustingConfig = field(default_factory=AdjustingConfig)
    """How the whole map is adjusted after that."""
    scan: ScanConfig = field(default_factory=ScanConfig)
    """What of a 2D scan is used."""
    scan_tracking: ScanTrackingConfig = field(default_factory=ScanTrackingConfig)
    """How scans are placed and when one becomes a keyframe."""
    submaps: SubmapConfig = field(default_factory=SubmapConfig)
    """How large the grids are that scans are laid onto, and of what."""
    scan_closing: ScanClosingConfig = field(default_factory=ScanClosingConfig)
    """When scans are searched for in earlier submaps, and the path is corrected."""
    scan_thinning: ScanThinningConfig = field(default_factory=ScanThinningConfig)
    """When submaps go that show nothing new."""
    points: PointsConfig = field(default_factory=PointsConfig)
    """How sweeps are laid onto surfaces."""
    curvature: CurvatureConfig = field(default_factory=CurvatureConfig)
    """What of a sweep is an edge, and what a plane, for the front-ends "loam" and "lego"."""
    feature_map: FeatureMapConfig = field(default_factory=FeatureMapConfig)
    """What those are laid onto."""
    ground: GroundConfig = field(default_factory=GroundConfig)
    """What is ground for the front-end "lego", and what stands on it."""
    cloud_tracking: CloudTrackingConfig = field(default_factory=CloudTrackingConfig)
    """How sweeps are placed and when one becomes a keyframe."""
    cloud_recognition: CloudRecognitionConfig = field(default_factory=CloudRecognitionConfig)
    """What a sweep must show to be recognised in a map."""
    cloud_closing: CloudClosingConfig = field(default_factory=CloudClosingConfig)
    """When places seen before are searched for, and the path is corrected."""
    cloud_thinning: CloudThinningConfig = field(default_factory=CloudThinningConfig)
    """When keyframes of a LiDAR go that show nothing new."""
    threads: ThreadConfig = field(default_factory=ThreadConfig)
    """When what is found beside the tracker reaches it."""


def _stereo() -> Config:
    return Config(threads=ThreadConfig(mapping_delay=3))


def _mono() -> Config:
    # A camera that moves forwards sees its landmarks grow and turn: more of their bits change, and
    # few landmarks to spare has the one that makes them from parallax alone. So it has more.
    return Config(
        orb=OrbConfig(count=1500, levels=5),
        matching=MatchConfig(max_hamming=80),
        tracking=TrackingConfig(sensors="mono"),
        bundle=BundleConfig(iterations=8),
    )


def _rgbd() -> Config:
    # Cameras with a depth image are held by hand, blur, and expose row after row: points are where
    # the model of one instant says only to a pixel or so, and depth is that of another instant.
    return Config(
        tracking=TrackingConfig(sensors="rgbd", keyframe_ratio=0.9),
        bundle=BundleConfig(iterations=8),
        noise=NoiseConfig(feature_px=1.0),
        depth=DepthConfig(noise=0.003),
        threads=ThreadConfig(mapping_delay=2),
    )


def _stereo_flow() -> Config:
    return Config(tracking=TrackingConfig(association="flow"), closing=NO_LOOPS)


def _mono_flow() -> Config:
    return Config(
        features=FeatureConfig(count=500),
        tracking=TrackingConfig(sensors="mono", association="flow"),
        candidates=CandidateConfig(follow=True),
        bundle=BundleConfig(iterations=8),
        closing=NO_LOOPS,
    )


def _rgbd_flow() -> Config:
    return Config(
        features=FeatureConfig(threshold=8),  # blurred corners are faint
        tracking=TrackingConfig(sensors="rgbd", association="flow"),
        candidates=CandidateConfig(follow=True),
        noise=NoiseConfig(position_px=1.2),
        closing=NO_LOOPS,
    )


def _lidar2d() -> Config:
    # Nearly every scan of a quick robot is a keyframe, and few of them cost the closer much.
    return Config(
        tracking=TrackingConfig(sensors="lidar2d"),
        closing=NO_LOOPS,
        threads=ThreadConfig(closing_line=4),
    )


def _lidar() -> Config:
    return Config(
        tracking=TrackingConfig(sensors=LIDAR),
        closing=NO_LOOPS,
        threads=ThreadConfig(closing_line=4),
    )


PRESETS: Mapping[str, Callable[[], Config]] = MappingProxyType(
    {
        "stereo": _stereo,
        "mono": _mono,
        "rgbd": _rgbd,
        "stereo-flow": _stereo_flow,
        "mono-flow": _mono_flow,
        "rgbd-flow": _rgbd_flow,
        "lidar2d": _lidar2d,
        "lidar": _lidar,
    }
)
"""Named configurations: of cameras, the same with optical flow, for speed, and of LiDARs."""


def preset(name: str) -> Config:
    """Return a named configuration.

    Args:
        name: one of `PRESETS`.

    Raises:
        ConfigError: if there is no such preset.
    """
    if name not in PRESETS:
        known = ", ".join(PRESETS)
        raise ConfigError(
            f"preset '{name}' is unknown{nearest_name(name, PRESETS)}; there are: {known}"
        )
    return PRESETS[name]()


def preset_for(rig: Rig) -> str:
    """Return the preset for what a rig carries: rgbd, stereo or mono; without a camera lidar2d, or
    lidar.

    Raises:
        CalibrationError: it has neither a camera nor a LiDAR.
    """
    if not rig.cameras and any(mount.angles[2] for mount in rig.lidars):
        return LASER
    if not rig.cameras and rig.lidars:
        return "lidar"
    if not rig.cameras:
        raise CalibrationError("this rig has no camera: odometry needs one")
    if rig.depth is not None:
        return "rgbd"
    return "stereo" if len(rig.cameras) > 1 else "mono"


def odometry_preset(rig: Rig) -> str:
    """Return the preset for odometry with what a rig carries: the same, with optical flow.

    Raises:
        CalibrationError: it has no camera, and nothing else to start from.
        ConfigError: it has a laser or a LiDAR alone.
    """
    usual = preset_for(rig)
    if f"{usual}-flow" not in PRESETS:
        section = {"lidar": "cloud-closing", "lidar2d": "scan-closing"}[usual]
        raise ConfigError(
            "odometry alone is for cameras, and this rig has none: "
            f"--{section}.enabled false looks for no loops"
        )
    return f"{usual}-flow"


def make_association(config: Config, mask: NDArray[np.bool_]) -> "Association":
    """Return the association that a configuration asks for, to make a map with.

    Args:
        config: the configuration.
        mask: (H, W) where the image holds something.
    """
    from odomap.system.association import (  # which lasers need not
        FeatureAssociation,
        FlowAssociation,
    )

    if config.tracking.association == "flow":
        return FlowAssociation(config.features, config.flow, mask, describes=True)
    return FeatureAssociation.of_pyramid(config.orb, config.matching, mask)
