"""Sections of the configuration for a 2D laser, apart from what is compiled."""

from dataclasses import dataclass

from odomap.limits import Count, Fraction, NotNegative, Positive, check_limits

__all__ = ["ScanClosingConfig", "ScanThinningConfig", "ScanTrackingConfig", "SubmapConfig"]


@dataclass(frozen=True)
class SubmapConfig:
    """How large submaps are, and of what."""

    resolution: Positive = 0.05
    """Size of a cell, metres."""
    scans: Count = 60
    """Keyframes in a submap; the next one begins at half of them."""
    hit: Positive = 0.9
    """What a beam says for the cell it came back from, log-odds."""
    miss: Positive = 0.3
    """What it says against those on its way, log-odds."""
    limit: Positive = 4.0
    """Most that is believed of a cell, log-odds."""

    def __post_init__(self) -> None:
        check_limits(self)


@dataclass(frozen=True)
class ScanTrackingConfig:
    """How scans are placed and when one becomes a keyframe."""

    use_odometry: bool = True
    """Whether the wheels' odometry is used, where there is any."""
    slip: Positive = 0.1
    """Standard deviation of a motion by odometry, relative to it."""
    veer: NotNegative = 0.05
    """The same of the heading per metre, radians."""
    jitter: Positive = 0.01
    """Least standard deviation of a motion by odometry, metres."""
    jitter_rad: Positive = 0.01
    """The same of the heading, radians."""
    unsteady: Positive = 0.5
    """Standard deviation of a motion without odometry, relative to one as before."""
    shake: Positive = 0.03
    """Least standard deviation of a motion without odometry, metres."""
    shake_rad: Positive = 0.01
    """The same of the heading, radians."""
    search: NotNegative = 0.15
    """How far around it all poses are tried then, metres."""
    search_rad: NotNegative = 0.12
    """The same of the heading, radians."""
    slip_m: Positive = 0.3
    """How far around it all poses are tried where scan and odometry do not agree, metres."""
    slip_rad: Positive = 0.4
    """The same of the heading, radians."""
    few_on_walls: Fraction = 0.5
    """Share of beams on walls of the submap below which odometry is doubted, and not as many may
    contradict the map: end in the open, or behind walls."""
    min_hits: Count = 20
    """Beams that must come back for a scan to say anything."""
    min_on_walls: Fraction = 0.25
    """Share of them that must lie on walls of the submap for the scan to fit."""
    keyframe_m: Positive = 0.2
    """Way after which a scan becomes a keyframe, metres."""
    keyframe_rad: Positive = 0.1
    """Turn after which it does, radians."""
    checks_mount: bool = True
    """Whether the motion that the laser sees is compared with the wheels' in the beginning."""
    doubtful: Fraction = 0.12
    """Share of the beams that contradict the map, relative to those and those on walls, above
    which, scan after scan, it is searched for a place that fits better."""
    patience: Count = 5
    """Scans in a row that show nothing known after which new ground is mapped by odometry, or else,
    where they contradict the map, the body is lost."""
    lost_reach: Positive = 2.0
    """How far around the last place a lost body is searched for, metres."""
    lost_score: Fraction = 0.5
    """Share of the beams that must meet walls there."""
    lost_submaps: Count = 2
    """Submaps that each scan of a lost body is searched for in."""
    lost_scans: Count = 30
    """Scans of a lost body after which a new piece of the map begins."""
    lost_m: NotNegative = 1.0
    """Way by odometry since then that it takes as well, where there is odometry, metres."""
    known_score: Fraction = 0.6
    """Share of the beams that must meet walls for a scan to be recognised in a map."""
    known_in_free: Fraction = 0.1
    """Share of those that may contradict the map: end in the open, or behind walls."""
    known_on_walls: Fraction = 0.8
    """Share of them that must lie on walls when it has been matched."""
    known_scans: Count = 15
    """Scans for which that must stay so before the body is believed to be there."""
    known_sigma: Positive = 0.2
    """Largest standard deviation of a place that is recognised, metres."""

    def __post_init__(self) -> None:
        check_limits(self)


@dataclass(frozen=True)
class ScanClosingConfig:
    """When loops are looked for, and believed."""

    enabled: bool = True
    """Whether places seen before are searched for."""
    every: Count = 3
    """Keyframes after which one is searched for."""
    most: Count = 2
    """Submaps that it is searched for in."""
    apart: Count = 6
    """Keyframes between two that are tied to the same submap."""
    least_reach: Positive = 3.0
    """Half the side of the smallest window, metres: odometry may have drifted more than it says."""
    least_rad: Positive = 0.3
    """Half the smallest range of headings, radians."""
    farthest: Positive = 7.0
    """Half the side of the largest window, metres."""
    widest_rad: Positive = 0.6
    """Half the largest range of headings, radians."""
    score: Fraction = 0.5
    """Share of the beams that must meet walls of the submap; those beside one count half."""
    in_free: Fraction = 0.1
    """Share of those that may end in the open, relative to those that meet walls or do so."""
    solve_every: Count = 15
    """Keyframes after which the path is solved anew if there are new loops; in large maps more."""
    solve_share: Fraction = 0.02
    """The same, relative to all keyframes."""
    doubt: Positive = 4.0
    """Factor on all standard deviations while it is decided which loops are true: submaps bend."""
    outlying: Positive = 10.0
    """Standard deviations at which a loop counts half."""

    def __post_init__(self) -> None:
        check_limits(self)


@dataclass(frozen=True)
class ScanThinningConfig:
    """When submaps go that show nothing new."""

    enabled: bool = True
    """Whether any go: a map then grows with the space seen, and not with time."""
    covers: Count = 4
    """Older submaps that must show what a scan shows; each place is in two of each passage."""
    near: Positive = 1.0
    """How near one of their keyframes must be, metres."""
    on_walls: Fraction = 0.75
    """Share of the beams that must meet walls of such a submap."""
    in_free: Fraction = 0.05
    """Share of them that may end where it is free."""
    share: Fraction = 0.9
    """Share of a submap's scans that must be shown so for it to go."""

    def __post_init__(self) -> None:
        check_limits(self)
