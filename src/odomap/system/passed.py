"""Keyframes passed: where the map knows already what a view shows, it needs no new one.

Whether a frame becomes a keyframe is decided by how many landmarks it shows, compared with those
found just after the last keyframe was made. In a place seen before that misleads. A new keyframe
there makes landmarks of whatever has none, a few frames later many of those are not found again,
so there is another keyframe, and so on round after round, though all that is seen is old.

The map knows a view when old landmarks are found everywhere in it: with a grid over the image,

    |{features in cells without an old landmark}| / |{features}| ≤ 0.3.

Only old ones count: those of a keyframe made a moment ago lie all over the view wherever it is.

How old a landmark is is told by neither time nor the number of keyframes since: a camera may rest,
and one that comes back makes none. It is told by the keyframes that were passed since, those that
frames hung from, one after the other; there and back between the same few counts once.

Cost: O(features) for a frame that would become a keyframe.

Reference: Strasdat, Davison, Montiel, Konolige, "Double window optimisation for constant time
visual SLAM", ICCV 2011 (keyframes are reused where the camera comes back).
"""

from collections import deque

import numpy as np
from numpy.typing import NDArray

__all__ = ["Passed"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Pixels = NDArray[np.float32]

LONG_AGO = 40
"""Passed so many keyframes ago: several windows of local mapping."""
FEW = 5
"""Keyframes between which a camera may go there and back without passing any."""
NEW = 0.3
"""Part of the features that must lie where nothing old was found for something new to be there."""
CELLS = 16
"""Cells of the grid across the image."""


class Passed:
    """The keyframes that were passed, from the newest on back to long ago.

    Args:
        newest_id: the newest keyframe of a map that was there before, which is old as a whole; −1
            if there is none.
    """

    def __init__(self, newest_id: int = -1) -> None:
        self._newest = self._old = newest_id
        self._latest: deque[int] = deque(maxlen=FEW)
        self._newest_at: deque[int] = deque(maxlen=LONG_AGO)

    def add(self, keyframe_id: int) -> None:
        """Take in the keyframe that frames hang from now.

        Args:
            keyframe_id: an id larger than all before is that of a new one.
        """
        self._newest = max(self._newest, keyframe_id)
        if keyframe_id in self._latest:
            return
        self._latest.append(keyframe_id)
        if len(self._newest_at) == LONG_AGO:
            self._old = self._newest_at[0]
        self._newest_at.append(self._newest)

    def is_known(self, anchors: Index, found: Array, features: Pixels, width: int) -> bool:
        """Say whether a view shows a place seen before, and hardly anything else.

        Args:
            anchors: (n,) keyframes that the landmarks found in it are relative to.
            found: (n, 2) pixels where those were found.
            features: (N, 2) pixels of all features of the view.
            width: of the image, pixels.
        """
        if not len(features):
            return False
        size, old = width / CELLS, found[anchors <= self._old]
        return bool(np.mean(~np.isin(_cells(features, size), _cells(old, size))) <= NEW)


def _cells(pixels: Array | Pixels, size: float) -> Index:
    """Return the cells (N,) of a grid that pixels (N, 2) lie in."""
    x, y = (pixels // size).astype(np.int64).T
    return np.asarray(y * (CELLS + 1) + x)
