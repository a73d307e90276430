"""Worlds with known truth."""

from odomap.simulation.world import World, WorldSpec

__all__ = ["World", "WorldSpec"]
