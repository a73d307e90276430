"""odomap: SLAM in Python for cameras, LiDAR and IMU.

    import odomap

    source = odomap.open("MH_01_easy")         # a recording's folder, or "sim:room?seed=3"
    system = odomap.Slam(source.rig)
    for frame in source:
        estimate = system.track(frame)         # .T_world_body, .status, .reason, .covariance
    odomap.write_tum("poses.tum", system.finish().trajectory)

Or in one line, with all outputs in a folder: ``odomap.run("MH_01_easy", "runs/mh01")``.

Names are loaded on first use, so that importing the package costs milliseconds and pulls in
neither numba nor OpenCV. This module is the face: nothing inside the package imports it.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from odomap.version import __version__

if TYPE_CHECKING:
    from odomap.backend.adjustment.adjust import (
        Adjustment,
        AdjustmentConfig,
        AdjustmentSolution,
        adjust,
    )
    from odomap.backend.adjustment.covariance import view_covariance
    from odomap.backend.descent import SolverConfig
    from odomap.backend.graphs.certificate import Certificate, certify
    from odomap.backend.graphs.chordal import chordal_cost
    from odomap.backend.graphs.covariances import covariances, joint_covariance, relative_covariance
    from odomap.backend.graphs.gnc import GncConfig
    from odomap.backend.graphs.incremental import IncrementalPoseGraph
    from odomap.backend.graphs.posegraph import PoseGraph, Priors, Sights
    from odomap.backend.graphs.solve import Solution, solve
    from odomap.calibrate import calibrate
    from odomap.errors import (
        CalibrationError,
        ConfigError,
        InputError,
        MissingExtra,
        OdomapError,
        OutputError,
        TrackingFailed,
    )
    from odomap.evaluation.metrics import ate, rpe
    from odomap.export import export
    from odomap.files.bal import read_bal, write_bal
    from odomap.files.calibrations import read_calibration
    from odomap.files.clouds import read_ply, write_ply
    from odomap.files.colmap import write_colmap
    from odomap.files.g2o import read_g2o, write_g2o
    from odomap.files.graphs import read_graph, write_graph
    from odomap.files.grids import load_grid, save_grid
    from odomap.files.mapfile import MapFile, load_map, save_map
    from odomap.files.rig import read_rig, write_rig
    from odomap.files.trajectories import read_tum, write_tum
    from odomap.files.vocabulary import Vocabulary
    from odomap.geometry.camera import Camera
    from odomap.geometry.pose import SE2, SE3, SO3, Sim3
    from odomap.geometry.robust import Loss
    from odomap.geometry.trajectory import Trajectory
    from odomap.lidar.cloud import Cloud
    from odomap.lidar.grid import OccupancyGrid
    from odomap.lidar.registration import Registration, register
    from odomap.localize import continue_map, localize
    from odomap.maps.atlas import Atlas
    from odomap.maps.estimate import Estimate, Status
    from odomap.maps.map import Map
    from odomap.maps.occupancy import occupancy_grid
    from odomap.merge import Merged, merge_maps
    from odomap.run import run
    from odomap.sensors.frame import Frame
    from odomap.sensors.rig import Rig
    from odomap.simulation.world import World
    from odomap.sources.open import open
    from odomap.sources.source import Source
    from odomap.system.config import Config, preset
    from odomap.system.odometry import MonocularVO, RgbdVO, StereoVO
    from odomap.system.slam import Slam
    from odomap.system.system import Result
    from odomap.viewing import View
    from odomap.vision.places import Places

__all__ = [
    "SE2",
    "SE3",
    "SO3",
    "Adjustment",
    "AdjustmentConfig",
    "AdjustmentSolution",
    "Atlas",
    "CalibrationError",
    "Camera",
    "Certificate",
    "Cloud",
    "Config",
    "ConfigError",
    "Estimate",
    "Frame",
    "GncConfig",
    "IncrementalPoseGraph",
    "InputError",
    "Loss",
    "Map",
    "MapFile",
    "Merged",
    "MissingExtra",
    "MonocularVO",
    "OccupancyGrid",
    "OdomapError",
    "OutputError",
    "Places",
    "PoseGraph",
    "Priors",
    "Registration",
    "Result",
    "RgbdVO",
    "Rig",
    "Sights",
    "Sim3",
    "Slam",
    "Solution",
    "SolverConfig",
    "Source",
    "Status",
    "StereoVO",
    "TrackingFailed",
    "Trajectory",
    "View",
    "Vocabulary",
    "World",
    "__version__",
    "adjust",
    "ate",
    "calibrate",
    "certify",
    "chordal_cost",
    "continue_map",
    "covariances",
    "export",
    "joint_covariance",
    "load_grid",
    "load_map",
    "localize",
    "merge_maps",
    "occupancy_grid",
    "open",
    "preset",
    "read_bal",
    "read_calibration",
    "read_g2o",
    "read_graph",
    "read_ply",
    "read_rig",
    "read_tum",
    "register",
    "relative_covariance",
    "rpe",
    "run",
    "save_grid",
    "save_map",
    "solve",
    "view_covariance",
    "write_bal",
    "write_colmap",
    "write_g2o",
    "write_graph",
    "write_ply",
    "write_rig",
    "write_tum",
]

_HOMES = {
    "Adjustment": "backend.adjustment.adjust",
    "AdjustmentConfig": "backend.adjustment.adjust",
    "AdjustmentSolution": "backend.adjustment.adjust",
    "Atlas": "maps.atlas",
    "CalibrationError": "errors",
    "Camera": "geometry.camera",
    "Certificate": "backend.graphs.certificate",
    "Cloud": "lidar.cloud",
    "Config": "system.config",
    "ConfigError": "errors",
    "Estimate": "maps.estimate",
    "Frame": "sensors.frame",
    "GncConfig": "backend.graphs.gnc",
    "IncrementalPoseGraph": "backend.graphs.incremental",
    "InputError": "errors",
    "Loss": "geometry.robust",
    "Map": "maps.map",
    "MapFile": "files.mapfile",
    "Merged": "merge",
    "MissingExtra": "errors",
    "MonocularVO": "system.odometry",
    "OccupancyGrid": "lidar.grid",
    "OdomapError": "errors",
    "OutputError": "errors",
    "Places": "vision.places",
    "PoseGraph": "backend.graphs.posegraph",
    "Priors": "backend.graphs.posegraph",
    "Registration": "lidar.registration",
    "Result": "system.system",
    "RgbdVO": "system.odometry",
    "Rig": "sensors.rig",
    "SE2": "geometry.pose",
    "SE3": "geometry.pose",
    "SO3": "geometry.pose",
    "Sights": "backend.graphs.posegraph",
    "Sim3": "geometry.pose",
    "Slam": "system.slam",
    "Solution": "backend.graphs.solve",
    "SolverConfig": "backend.descent",
    "Source": "sources.source",
    "Status": "maps.estimate",
    "StereoVO": "system.odometry",
    "TrackingFailed": "errors",
    "Trajectory": "geometry.trajectory",
    "View": "viewing",
    "Vocabulary": "files.vocabulary",
    "World": "simulation.world",
    "adjust": "backend.adjustment.adjust",
    "ate": "evaluation.metrics",
    "calibrate": "calibrate",
    "certify": "backend.graphs.certificate",
    "chordal_cost": "backend.graphs.chordal",
    "continue_map": "localize",
    "covariances": "backend.graphs.covariances",
    "export": "export",
    "joint_covariance": "backend.graphs.covariances",
    "load_grid": "files.grids",
    "load_map": "files.mapfile",
    "localize": "localize",
    "merge_maps": "merge",
    "occupancy_grid": "maps.occupancy",
    "open": "sources.open",
    "preset": "system.config",
    "read_bal": "files.bal",
    "read_calibration": "files.calibrations",
    "read_g2o": "files.g2o",
    "read_graph": "files.graphs",
    "read_ply": "files.clouds",
    "read_rig": "files.rig",
    "read_tum": "files.trajectories",
    "register": "lidar.registration",
    "relative_covariance": "backend.graphs.covariances",
    "rpe": "evaluation.metrics",
    "run": "run",
    "save_grid": "files.grids",
    "save_map": "files.mapfile",
    "solve": "backend.graphs.solve",
    "view_covariance": "backend.adjustment.covariance",
    "write_bal": "files.bal",
    "write_colmap": "files.colmap",
    "write_g2o": "files.g2o",
    "write_graph": "files.graphs",
    "write_ply": "files.clouds",
    "write_rig": "files.rig",
    "write_tum": "files.trajectories",
}


def __getattr__(name: str) -> object:
    """Load a public name from its room the first time it is asked for (PEP 562)."""
    home = _HOMES.get(name)
    if home is None:
        raise AttributeError(f"module 'odomap' has no attribute {name!r}")
    value: object = getattr(import_module(f"odomap.{home}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """List the public names, loaded or not."""
    return sorted(__all__)
