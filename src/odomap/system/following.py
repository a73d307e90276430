"""Following: the corners of one view in those after it, before anything is known of the motion.

Without landmarks nothing says where a corner will be. It is looked for where it was heading, then
where it would be had the camera only turned (`vision.turning`). A patch that is lost once is not
found again; a corner known by its descriptor may be missed in one view and matched in the next, so
such are looked for a while longer.

Reference: Klein, Murray, "Parallel Tracking and Mapping for Small AR Workspaces", ISMAR 2007.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.camera import Camera
from odomap.system.association import Association, View
from odomap.vision.turning import Thumbnail, turn_between

__all__ = ["FollowedCorners"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


class FollowedCorners:
    """Corners of a first view, and where they are in the newest.

    Args:
        first: the view.
        corners: (N, 2) pixels in it.
        descriptors: (N, D) how they look.
        camera: the pinhole.
        association: finds them again.
        patience: views in a row in which one may be missed.

    Attributes:
        first, corners: as given.
        found: (n,) which corners were found in the newest view.
        pixels: (n, 2) where.
    """

    def __init__(
        self,
        first: View,
        corners: Array,
        descriptors: NDArray[np.uint8],
        camera: Camera,
        association: Association,
        patience: int,
    ) -> None:
        self.first, self.corners, self._descriptors = first, corners, descriptors
        self._camera, self._association, self._patience = camera, association, patience
        self.found, self.pixels = np.arange(len(corners)), corners
        # Of all corners: where each was last, by how much it moved then, views missed since.
        self._at, self._step = np.array(corners), np.zeros_like(corners)
        self._missed = np.zeros(len(corners), np.int64)
        self._newest = first

    def __len__(self) -> int:
        return len(self.corners)

    def follow(self, view: View) -> None:
        """Find the corners in the next view."""
        wanted = np.flatnonzero(self._missed <= self._patience)
        pixels, found = self._find(view, self._at[wanted] + self._step[wanted], wanted)
        lost = np.flatnonzero(~found)
        turned = self._turned(view, self._at[wanted[lost]]) if lost.size else None
        if turned is not None:
            pixels[lost], found[lost] = self._find(view, turned, wanted[lost])
        self._missed[wanted] += 1
        self.found, self.pixels, self._newest = wanted[found], pixels[found], view
        self._step[wanted] = 0.0
        self._step[self.found] = self.pixels - self._at[self.found]
        self._at[self.found], self._missed[self.found] = self.pixels, 0

    def _find(self, view: View, guess: Array, rows: Index) -> tuple[Array, NDArray[np.bool_]]:
        still = np.tile(np.eye(2), (len(rows), 1, 1))
        known = self.corners[rows], self._descriptors[rows]
        return self._association.find(self.first, *known, view, guess, still)

    def _turned(self, view: View, pixels: Array) -> Array | None:
        """Return where pixels would be if the camera had only turned since the last view."""
        before, now = (Thumbnail.of(v.pyramid[-1], self._camera) for v in (self._newest, view))
        R_before_now = turn_between(before, now)
        if R_before_now is None:
            return None
        turned = self._camera.project(self._camera.unproject(pixels) @ R_before_now)
        return np.where(np.isfinite(turned), turned, pixels)
