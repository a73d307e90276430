"""A map laid open as arrays, so that it can be written down and made again.

A table is named by room and column ("states/scales", "landmarks/p_anchor"); a row of `states` and
`tree` is a keyframe id, culled ones and ids never used included. Nothing that decides how a map
goes on is left out: a map made of them gives the same ids to what comes next, and the same bits.
Observations name landmarks by slot here, as in the map itself.

Reference: K. Konolige, J. Bowman, Towards lifelong visual maps, 2009.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from odomap.maps.edges import EdgeTable
from odomap.maps.keyframes import Keyframe

__all__ = ["MapTables"]


@dataclass(frozen=True, eq=False)
class MapTables:
    """All of a map, copied.

    Attributes:
        columns: arrays by "table/column": states (`States`), tree (`Tree`), landmarks
            (`Landmarks.dump`), observations (`Observations.dump`).
        keyframes: the living ones with their payloads, by id.
        edges: measured between keyframes.
        version: of the map.
        epoch: of the map.
        newest: id of the keyframe that the next one hangs from, -1 where there is none.
        next_keyframe: the id that the next keyframe will have.
        next_landmark: the id that the next landmark will have.
    """

    columns: Mapping[str, NDArray[Any]]
    keyframes: tuple[Keyframe, ...]
    edges: EdgeTable
    version: int
    epoch: int
    newest: int
    next_keyframe: int
    next_landmark: int

    def of(self, table: str) -> dict[str, NDArray[Any]]:
        """Return the columns of one table by their own names."""
        return {
            name.removeprefix(f"{table}/"): array
            for name, array in self.columns.items()
            if name.startswith(f"{table}/")
        }
