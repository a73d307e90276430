"""The trail: the newest frames are placed again when the map has come to rest.

A frame hangs from a keyframe as it was found when it came, and moves along with it. What the map
said wrongly just then stays: right after a loop both sides of it are in the map, some centimetres
apart until mapping and adjustment have brought them together, and a frame placed by landmarks of
both is off from either. A keyframe is adjusted with the rest. The frames before the next one hang
as they are, which hardly shows in the middle of a path; but the last of them is its end, and where
the body is now. So of those since the last keyframe is kept what they show, and when a run ends
they are placed again, in the map as it has become, with what is around where they were found rather
than where they were expected:

    T_keyframe_frame ← argmin over T of Σ ρ(|x - π(T⁻¹ p)|²),    p as known now.

Cost: the features of some frames, without their images; a search each at the end of a run.

Reference: Mur-Artal, Montiel, Tardós, "ORB-SLAM: a versatile and accurate monocular SLAM system",
T-RO 2015, section V-D (the same search, in the map as it was).
"""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from odomap.system.association import View

__all__ = ["LENGTH", "Trail", "Trailing"]

Index = NDArray[np.int64]

LENGTH = 20
"""Frames that are kept: more come without a keyframe only where the map is known well."""


@dataclass(frozen=True, eq=False)
class Trailing:
    """A frame that no keyframe came after.

    Attributes:
        place: its place among the frames of the path.
        view: its features, without the image but for the coarsest level of its pyramid.
        landmark_ids: (n,) what it showed of the map.
        rested: epoch of the map in which it was placed at rest; -1 if in none yet.
    """

    place: int
    view: View
    landmark_ids: Index
    rested: int = -1


class Trail:
    """The frames since the last keyframe, the newest of them if they are many."""

    def __init__(self) -> None:
        self._frames: deque[Trailing] = deque(maxlen=LENGTH)

    def __len__(self) -> int:
        return len(self._frames)

    def add(self, place: int, view: View, landmark_ids: Index) -> None:
        """Keep a frame that was placed."""
        light = replace(view, pyramid=view.pyramid[-1:])
        self._frames.append(Trailing(place, light, landmark_ids))

    def forget(self) -> None:
        """Begin anew: a keyframe was made."""
        self._frames.clear()

    def not_at_rest(self, epoch: int) -> Iterator[Trailing]:
        """Yield the frames that were not placed at rest in the map as it is; each is given once.

        Args:
            epoch: of the map as it is now.
        """
        for n, frame in enumerate(self._frames):
            if frame.rested != epoch:
                self._frames[n] = replace(frame, rested=epoch)
                yield frame
