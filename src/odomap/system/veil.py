"""Veils: something new stands before what is known, so nothing is to be learnt from it.

A board carried past, a person, a lorry: it hides a part of the known scene, and its own features
are many. Made landmarks, they soon outnumber those of the scene, and the camera is believed to go
along with it. What tells it from a view of something new is that the known has not left the view:
its landmarks are expected in the image but not found, and in their place are features that are
nearer. In a world at rest a thing hides what is behind it as well, but it was known before, too.

The image is parted into cells. Around a cell, in 3 x 3 of them, a scene is hidden if of enough
expected landmarks hardly one is found. A feature there with depth z veils it if

    NEARER · z < z of every landmark expected around.

Where a good part of all features do, no keyframe is made: frames are placed by what is known
alone, or not at all. What hid the known is remembered by its descriptors, and as long as an image
shows many of them they are left out of the search, and one that is lost does not start anew.

Cost: linear in landmarks and features, and a measurement of depth for suspicious ones, when a
keyframe is due; a comparison of descriptors per frame while something is remembered.

Reference: Tan, Liu, Dong, Zhang, Bao, "Robust Monocular SLAM in Dynamic Environments", ISMAR 2013
(landmarks that a change of the scene has hidden).
"""

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from odomap.geometry.lie import se3_inverse
from odomap.maps.map import Map
from odomap.sensors.frame import Frame
from odomap.system.association import View
from odomap.system.eye import Eye
from odomap.system.locating import Located
from odomap.system.ranging import Ranger
from odomap.vision.features import Corners

__all__ = ["VEILED", "Veil"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

VEILED = "something stands before what is known"
"""Why no keyframe is made."""
CELLS = 20
"""Cells across the width of an image."""
FEWEST = 5
"""Landmarks that must be expected around a cell for it to be known."""
FOUND = 0.1
"""Part of them that may be found in a hidden scene: descriptors agree by chance."""
NEARER = 1.2
"""How many times further than what hides it a landmark must be."""
SHARE = 0.1
"""Part of all features that must veil something known; in a world at rest it is some percent."""
SAMPLE = 60
"""Suspicious features whose depth is measured first."""
ALIKE = 40
"""Bits, of 256, by which descriptors of one point differ at most from one image to the next."""
STILL = 0.3
"""Part of what hid the map that is seen as long as it is still there."""

_NOTHING = np.empty((0, 32), np.uint8)


class Veil:
    """Notices what stands before the known, and remembers what it looks like.

    Args:
        map: what is known.
        eye: the camera.

    Attributes:
        is_shown: whether the view that was lifted last shows it.
    """

    def __init__(self, map: Map, eye: Eye) -> None:
        self._map, self._eye = map, eye
        self._descriptors = _NOTHING
        self.is_shown = False

    def hides(
        self, frame: Frame, view: View, landmark_ids: Index, located: Located, ranger: Ranger | None
    ) -> bool:
        """Say whether much of a view stands before landmarks that should be seen.

        Args:
            frame: as it came.
            view: its features.
            landmark_ids: (N,) what it was placed against.
            located: where it is, and which of those were expected and found.
            ranger: measures depth; without it nothing can be said.
        """
        if ranger is None or not len(view.corners.keypoints):
            return False
        self._descriptors = _NOTHING
        behind = self._hidden(view, landmark_ids, located)
        rows = np.flatnonzero(np.isfinite(behind))
        if len(rows) <= SHARE * len(behind):
            return False

        def nearer(some: Index) -> Index:
            pixels = view.corners.keypoints[some].astype(np.float64)
            inverse_depth = ranger.measure(frame, view, pixels, np.empty(0))
            return some[inverse_depth * behind[some] > NEARER]

        # Nearly always a few tell that there is nothing.
        few = rows[:: max(len(rows) // SAMPLE, 1)]
        if len(nearer(few)) * len(rows) <= SHARE * len(behind) * len(few):
            return False
        self._descriptors = view.descriptors[nearer(rows)]
        return True

    def lifted(self, view: View) -> View:
        """Return a view without what hid the known; if that is gone, it is forgotten."""
        wanted = self._descriptors
        if not len(wanted):
            return view
        index, alike = _nearest(view.descriptors, wanted)
        self.is_shown = len(np.unique(index[alike])) > STILL * len(wanted)
        if not self.is_shown:
            self._descriptors = _NOTHING
            return view
        at, corners = ~alike, view.corners
        seen = Corners(corners.keypoints[at], corners.strength[at], corners.level[at])
        return replace(view, corners=seen, descriptors=view.descriptors[at])

    def _hidden(self, view: View, landmark_ids: Index, located: Located) -> Array:
        """Return how far the nearest of the landmarks is that are hidden around each feature.

        It is NaN where none are, since the scene is seen there, or not known.
        """
        found = located.rows[located.inliers]
        rows = np.union1d(located.expected_rows, found)
        T = se3_inverse(located.T_world_body @ self._eye.T_body_camera)
        points = self._map.points_world(landmark_ids[rows]) @ T[:3, :3].T + T[:3, 3]
        ahead = points[:, 2] > 0
        points, is_found, c = points[ahead], np.isin(rows, found)[ahead], self._eye.camera
        at, shape = self._cells(points[:, :2] / points[:, 2:] * (c.fx, c.fy) + (c.cx, c.cy))
        nearest = np.full(shape[0] * shape[1], np.inf)
        np.minimum.at(nearest, at, points[:, 2])
        expected = _around(np.bincount(at, minlength=len(nearest)).reshape(shape), np.add)
        seen = _around(np.bincount(at[is_found], minlength=len(nearest)).reshape(shape), np.add)
        depth = _around(nearest.reshape(shape), np.minimum)
        depth[(expected < FEWEST) | (seen > FOUND * expected)] = np.nan
        cell, _ = self._cells(view.corners.keypoints.astype(np.float64))
        return np.asarray(depth.ravel()[cell])

    def _cells(self, pixels: Array) -> tuple[Index, tuple[int, int]]:
        """Return the cells (n,) of pixels, row by row within a frame of empty ones."""
        width, height = self._eye.camera.resolution
        side = width / CELLS
        rows = int(np.ceil(height / side))
        # One more cell on each side takes what lies outside, and the neighbours of the outermost.
        x = np.clip(np.floor(pixels[:, 0] / side), -1, CELLS).astype(np.int64) + 1
        y = np.clip(np.floor(pixels[:, 1] / side), -1, rows).astype(np.int64) + 1
        return y * (CELLS + 2) + x, (rows + 2, CELLS + 2)


def _around(cells: NDArray[np.generic], gather: np.ufunc) -> Array:
    """Gather what is in the 3 x 3 cells around each; those of the frame get their own."""
    out = cells.astype(np.float64)
    rows = gather(gather(cells[:-2], cells[1:-1]), cells[2:])
    out[1:-1, 1:-1] = gather(gather(rows[:, :-2], rows[:, 1:-1]), rows[:, 2:])
    return out


def _nearest(descriptors: NDArray[np.uint8], wanted: NDArray[np.uint8]) -> tuple[Index, Mask]:
    """Return (n,) which of others each descriptor is nearest to, and whether it may be the same."""
    index, alike = np.zeros(len(descriptors), np.int64), np.zeros(len(descriptors), np.bool_)
    for match in cv2.BFMatcher(cv2.NORM_HAMMING).match(descriptors, wanted):
        index[match.queryIdx], alike[match.queryIdx] = match.trainIdx, match.distance <= ALIKE
    return index, alike
