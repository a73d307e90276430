"""Rooms and buildings as solids: what the cameras' worlds are made of, for a LiDAR.

The same hands furnish them (`simulation.room`, `simulation.building`), but nothing is painted, and
what a LiDAR gets back is decided by the material alone. The LiDAR is carried upright in front, with
the sway and the looks around of somebody who walks.

Cost: 0.1 s to furnish.

Reference: as `solids`.
"""

from dataclasses import replace
from types import MappingProxyType

import numpy as np

from odomap.simulation.building import furnished_building
from odomap.simulation.path import Path, hand_held
from odomap.simulation.room import furnished_room, walk_round
from odomap.simulation.scene import BareBuilder
from odomap.simulation.solids import Ground, Solids, SolidsBuilder

__all__ = ["solid_building", "solid_room"]

ALBEDO = MappingProxyType(
    {
        "plaster": 0.7, "wood": 0.45, "tiles": 0.5, "poster": 0.6, "facade": 0.35, "shelf": 0.4,
        "cardboard": 0.5, "fabric": 0.3,
    }
)  # fmt: skip
"""Share of the light that materials throw back."""
FLOOR_M = 1e-6
"""Up to here a surface that looks up is the floor."""


def solid_room(seed: int, moving_objects: int, speed: float) -> tuple[Solids, Path]:
    """Furnish a room and walk round in it with a LiDAR.

    Args:
        seed: which room.
        moving_objects: how many cartons wander through it.
        speed: mean speed of the walk, m/s.

    Returns:
        What is there, and the path of the LiDAR; the floor is z = 0, metres.
    """
    builder, radii = furnished_room(seed, moving_objects, BareBuilder)
    return _solid(builder), replace(walk_round(builder.rng, radii, speed), R_carrier_body=np.eye(3))


def solid_building(seed: int, moving_objects: int, speed: float) -> tuple[Solids, Path]:
    """Furnish corridors and rooms, and walk round; as `solid_room`."""
    builder, way = furnished_building(seed, moving_objects, BareBuilder)
    return _solid(builder), hand_held(way, speed, builder.rng, np.eye(3))


def _solid(bare: BareBuilder) -> Solids:
    """Return what a builder collected."""
    builder = SolidsBuilder(bare.rng, Ground.none())
    for mover in bare.movers:
        builder.mover(mover)
    found = bare.rectangles()
    for frame, face, code, mover in zip(
        found.frames, found.faces, found.codes, found.mover, strict=True
    ):
        # A picture's frame has its third axis downwards: what one stands on looks up, -u × v.
        is_floor = abs(frame[2]) < FLOOR_M and np.cross(frame[3:6], frame[6:9])[2] < -0.99
        kind = "moving" if mover >= 0 else "ground" if is_floor else "building"
        builder.rectangle(
            frame[:3], frame[3:6], frame[6:9], (face[0], face[1]), kind,
            albedo=ALBEDO.get(bare.materials[code[0]], 0.4), mover=int(mover), is_ground=is_floor,
        )  # fmt: skip
    return builder.build()
