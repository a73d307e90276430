"""What stages hand in, made by hand: for tests of who runs them, and when."""

from dataclasses import dataclass

from odomap.maps.map import Map
from odomap.maps.snapshot import Update
from odomap.system.stages import Loop


@dataclass(frozen=True, eq=False)
class Solved:
    """A change made of solutions: `Update`s to apply in order.

    Attributes:
        updates: what solvers found.
        loops: loop candidates that were decided on.
    """

    updates: tuple[Update, ...]
    loops: tuple[Loop, ...] = ()

    def write(self, map: Map) -> None:
        """Apply the updates."""
        for update in self.updates:
            map.apply(update)
