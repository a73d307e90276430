"""Worlds for a 3D LiDAR alone: solids, a path through them, sweeps, no images.

Nothing is painted or lit, so a world is there within a second and a sweep of 16 x 1,800 beams takes
a few milliseconds. Each point is measured at its own time along the path and given in the frame of
that moment, as real sweeps are: a car at 8 m/s moves 0.8 m within one. As everywhere, the seed
decides it to the last byte, and frames are made when they are asked for, in any order.

What each point shows is known (`SweepWorld.sweep_truth`): the surface, its normal, whether it is
ground, whether the beams beside it end on another one, so that labels can be judged.

The body is the LiDAR.

Reference: A. Dosovitskiy et al., "CARLA: an open urban driving simulator", CoRL 2017 (labels from
simulated sweeps).
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.trajectory import Trajectory
from odomap.sensors.frame import Frame
from odomap.sensors.rig import LidarMount, Rig
from odomap.simulation.lidar import LidarNoise
from odomap.simulation.path import Path
from odomap.simulation.scanner import Measured, Scanner, measure
from odomap.simulation.solidcast import GROUND, cast
from odomap.simulation.solidrooms import solid_building, solid_room
from odomap.simulation.solids import ALBEDO, RECTANGLE, Solids
from odomap.simulation.sweepspec import HAND_HELD, NEAREST_M, SweepSpec
from odomap.simulation.sweeptruth import SweepTruth, edges_of
from odomap.simulation.town import field, town, tunnel
from odomap.simulation.world import START_NS

__all__ = ["SweepWorld"]

Array = NDArray[np.float64]

MAKERS: Mapping[str, Callable[[int, int, float], tuple[Solids, Path]]] = MappingProxyType(
    {
        "street": town,
        "room": solid_room,
        "building": solid_building,
        "tunnel": tunnel,
        "field": field,
    }
)
INDOORS = (np.radians(-22.5), np.radians(22.5))
"""View of a rotating LiDAR in rooms, so that floor and ceiling are seen."""


class SweepWorld:
    """Solids seen by a moving LiDAR, with known truth.

    Attributes:
        spec: what decides it, completed, with the number of frames.
        solids: what there is.
        path: exact motion of the LiDAR; time 0 is the first frame's stamp.
        rig: the LiDAR.
        truth: (frames) exact T_world_body at the stamps, which are where sweeps begin.
    """

    def __init__(self, spec: SweepSpec) -> None:
        spec = spec.completed()
        self.solids, self.path = MAKERS[spec.kind](spec.seed, spec.moving_objects, spec.speed)
        count = spec.frames or round(spec.rounds * spec.rate_hz / self.path.rounds_per_s) + 1
        self.spec = replace(spec, frames=count)
        is_rotating = spec.pattern == "rotating"
        mount = LidarMount(
            "top",
            range_m=(NEAREST_M, spec.range_m),
            rate_hz=spec.rate_hz,
            sweep="clockwise" if is_rotating else "none",
            beams=spec.beams if is_rotating else 0,
        )
        self.rig = Rig(lidars=(mount,))
        view = INDOORS if spec.kind in HAND_HELD else (0.0, 0.0)
        self._scanner = Scanner(spec.pattern, spec.beams, spec.columns, 1.0 / spec.rate_hz, view)
        # Those of a rotating LiDAR are the same in every sweep.
        self._directions = self._scanner.directions(0.0) if is_rotating else None
        self._seconds = np.arange(count) / spec.rate_hz
        stamps = START_NS + np.rint(self._seconds * 1e9).astype(np.int64)
        self.truth = Trajectory(stamps, self.path.at(self._seconds).Ts_world_body)

    def __len__(self) -> int:
        return self.spec.frames

    def frame(self, index: int) -> Frame:
        """Take sweep `index`.

        Raises:
            IndexError: there is no such frame.
        """
        measured, *_ = self._measured(index)
        return Frame(
            id=index,
            stamp_ns=int(self.truth.stamps_ns[index]),
            images=(),
            cloud=measured.sweep,
        )

    def sweep_truth(self, index: int, reach: int = 2, bend_deg: float = 30.0) -> SweepTruth:
        """Return what the points of sweep `index` show, in the order of its cloud.

        Args:
            index: of the frame.
            reach: how many beams along the line (of the same beam number) an edge is felt.
            bend_deg: surfaces that bend by less have no edge there.

        Raises:
            IndexError: there is no such frame.
        """
        measured, directions, distance, hit, normals, R_world_lidar = self._measured(index)
        rays = np.einsum("sij,sbj->sbi", R_world_lidar, directions)
        forms = np.append(self.solids.forms, [RECTANGLE, RECTANGLE])  # -2 and -1 are the last
        bend = np.cos(np.radians(bend_deg))
        edge, hidden = edges_of(distance, hit, normals, rays, forms[hit] != RECTANGLE, reach, bend)
        rows = measured.rows
        who = hit.ravel()[rows]
        local = np.einsum("sij,sbi->sbj", R_world_lidar, normals)
        on = np.maximum(who, 0)
        is_ground = who == GROUND
        if len(self.solids):
            kinds = np.where(is_ground, 0, self.solids.kinds[on])
            things = np.where(is_ground, 0, self.solids.things[on])
            is_ground = is_ground | self.solids.is_ground[on]
        else:
            kinds = things = np.zeros(len(who), np.int64)
        return SweepTruth(
            directions.reshape(-1, 3)[rows] * distance.ravel()[rows, None],
            who,
            things,
            kinds,
            local.reshape(-1, 3)[rows],
            is_ground,
            edge.ravel()[rows],
            hidden.ravel()[rows],
        )

    def _measured(
        self, index: int
    ) -> tuple[Measured, Array, Array, NDArray[np.int32], Array, Array]:
        """Return sweep `index`, and of all its beams what they truly met."""
        if not 0 <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)}")
        time, delays = float(self._seconds[index]), self._scanner.delays
        rng = np.random.default_rng([self.spec.seed, index, 67])
        directions = self._directions
        if directions is None:
            directions = self._scanner.directions(time)
        Ts = self.path.at(time + delays).Ts_world_body
        chances = rng.random(directions.shape[:2], np.float32)
        distance, hit, normals = cast(
            self.solids, Ts, delays, directions, chances, time, self.spec.range_m
        )
        of_ground = np.float32(ALBEDO["ground"])
        table = np.append(self.solids.albedos, [of_ground, np.float32(0.0)]).astype(np.float32)
        R_world_lidar = np.ascontiguousarray(Ts[:, :3, :3])
        # The last of the table are of hits -2 and -1: ground, nothing.
        measured = measure(
            directions, delays, R_world_lidar, distance, hit, table[hit], normals, NEAREST_M,
            LidarNoise().scaled(self.spec.noise), rng,
        )  # fmt: skip
        return measured, directions, distance, hit, normals, R_world_lidar
