"""Recordings kept in memory: rendered once, and run by many tests."""

from odomap.sources.open import open as open_source


class Rendered:
    """A source whose frames are made once."""

    def __init__(self, name):
        source = open_source(name)
        self.name, self.rig, self.truth, self.skipped = source.name, source.rig, source.truth, []
        self._frames = list(source)

    def __len__(self):
        return len(self._frames)

    def __iter__(self):
        return iter(self._frames)
