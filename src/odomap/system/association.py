"""Association: where the landmarks of a reference keyframe are in a new image.

Two ways with one face. `FlowAssociation` aligns the patches around the reference's keypoints in
the new image; it finds nearly all of them, to a twentieth of a pixel, as long as the view changes
little. `FeatureAssociation` detects features in every image and compares descriptors near the
expected places; it costs detection and description, and survives larger changes.

Reference: Baker, Matthews, "Lucas-Kanade 20 Years On", IJCV 2004; Mur-Artal, Montiel, Tardós,
"ORB-SLAM", T-RO 2015, section V.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from odomap.system.visualconfig import TrackingConfig
from odomap.vision.features import Corners, FeatureConfig, describe, detect
from odomap.vision.flow import FlowConfig, pyramid, track
from odomap.vision.matching import MatchConfig, match_guided
from odomap.vision.orb import OrbConfig, describe_at, extract

__all__ = [
    "Association",
    "FeatureAssociation",
    "FlowAssociation",
    "Reference",
    "TrackingConfig",
    "View",
]

Image = NDArray[np.uint8]

REACH = 0.08
"""How far descriptors are looked for where nothing predicts a motion, as part of the width."""
_AS_ONE = np.array([1.0, 1j])
"""Makes one number of a pixel, which can be looked up."""


@dataclass(frozen=True)
class View:
    """One rectified image, made ready for association.

    Attributes:
        frame_id, stamp_ns: of its frame.
        pyramid: the image and its halvings, finest first.
        corners, descriptors: of the image; empty where association does without.
    """

    frame_id: int
    stamp_ns: int
    pyramid: tuple[Image, ...]
    corners: Corners
    descriptors: NDArray[np.uint8]

    @property
    def image(self) -> Image:
        """The image in full resolution."""
        return self.pyramid[0]


@dataclass(frozen=True, eq=False)
class Candidates:
    """Points of a keyframe without a place yet, since they were seen from one side only.

    Attributes:
        keypoints: (C, 2) float64 where, rectified pixels.
        descriptors: (C, D) uint8, D = 0 where association does without.
        first_at: (C, 2) where each was seen first.
        keyframes: (C, V) ids of keyframes that have seen each, from the first one on; −1 for none.
        rows: (C, V) at which of their keypoints.
    """

    keypoints: NDArray[np.float64]
    descriptors: NDArray[np.uint8]
    first_at: NDArray[np.float64]
    keyframes: NDArray[np.int64]
    rows: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.keypoints)

    def at(self, index: NDArray[np.int64]) -> "Candidates":
        """Return some of them."""
        return Candidates(
            self.keypoints[index],
            self.descriptors[index],
            self.first_at[index],
            self.keyframes[index],
            self.rows[index],
        )

    def afresh(self, which: NDArray[np.bool_]) -> "Candidates":
        """Return them with the history of some (C,) forgotten."""
        gone = which[:, None]
        return replace(
            self,
            keyframes=np.where(gone, -1, self.keyframes),
            rows=np.where(gone, -1, self.rows),
        )


@dataclass(frozen=True, eq=False)
class Reference:
    """A keyframe as the tracker sees it.

    Attributes:
        keyframe_id: id in the map.
        view: its image.
        landmark_ids: (N,) landmarks seen in it.
        keypoints: (N, 2) float64 where, rectified pixels.
        descriptors: (N, D) uint8, D = 0 where association does without.
        is_ranged: (N,) bool, whether a landmark's depth was measured rather than triangulated.
        relative: (N,) standard deviation of a landmark's depth as a fraction of it.
        first_keyframe: (N,) keyframe each was first seen in.
        first_keypoint: (N, 2) where in its image.
        candidates: what else is followed from it.
    """

    keyframe_id: int
    view: View
    landmark_ids: NDArray[np.int64]
    keypoints: NDArray[np.float64]
    descriptors: NDArray[np.uint8]
    is_ranged: NDArray[np.bool_]
    relative: NDArray[np.float64]
    first_keyframe: NDArray[np.int64]
    first_keypoint: NDArray[np.float64]
    candidates: Candidates


class Association(Protocol):
    """Finds landmarks in images.

    Attributes:
        count: features wanted per keyframe.
        follows: whether points are followed, rather than found again by what they look like.
    """

    @property
    def count(self) -> int: ...  # noqa: D102 (see the class)

    @property
    def follows(self) -> bool: ...  # noqa: D102

    def view(self, frame_id: int, stamp_ns: int, image: Image) -> View:
        """Make a rectified image ready."""
        ...

    def find(
        self,
        known: View,
        keypoints: NDArray[np.float64],
        descriptors: NDArray[np.uint8],
        view: View,
        guess: NDArray[np.float64],
        warp: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Find keypoints of a known view in another.

        Args:
            known: the view they are known in.
            keypoints: (n, 2) where.
            descriptors: (n, D) how they look.
            view: where they are looked for.
            guess: (n, 2) where each is expected.
            warp: (n, 2, 2) how its patch is expected to deform (`facing_warp`).

        Returns:
            (n, 2) pixels, and (n,) whether each was found.
        """
        ...

    def extend(
        self, view: View, occupied: NDArray[np.float64], count: int
    ) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
        """Return up to `count` new keypoints (n, 2) away from others, with descriptors."""
        ...

    def descriptors_at(self, view: View, keypoints: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Return the descriptors (n, D) to store with keypoints tracked into a view."""
        ...

    def levels_at(self, view: View, keypoints: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Return the pyramid levels (n,) of keypoints of a view."""
        ...


@dataclass(frozen=True)
class FlowAssociation:
    """Follows patches; see the module."""

    features: FeatureConfig
    flow: FlowConfig
    mask: NDArray[np.bool_]
    describes: bool = False
    follows: ClassVar[bool] = True

    @property
    def count(self) -> int:
        """Features wanted per keyframe."""
        return self.features.count

    def view(self, frame_id: int, stamp_ns: int, image: Image) -> View:
        """Build the pyramid."""
        none = Corners(np.empty((0, 2), np.float32), np.empty(0), np.empty(0, np.uint8))
        return View(
            frame_id, stamp_ns, pyramid(image, self.flow.levels), none, np.empty((0, 0), np.uint8)
        )

    def find(
        self,
        known: View,
        keypoints: NDArray[np.float64],
        descriptors: NDArray[np.uint8],
        view: View,
        guess: NDArray[np.float64],
        warp: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Align the patches around the keypoints."""
        flow = track(known.pyramid, view.pyramid, keypoints, guess, self.flow, warp)
        return flow.points, flow.found

    def extend(
        self, view: View, occupied: NDArray[np.float64], count: int
    ) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
        """Detect corners."""
        corners = detect(view.image, self.features, count, occupied.astype(np.float32), self.mask)
        points = corners.keypoints.astype(np.float64)
        return points, self.descriptors_at(view, points)

    def descriptors_at(self, view: View, keypoints: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Describe keypoints for the map; to follow them patches are compared, not descriptors."""
        if not self.describes:
            return np.empty((len(keypoints), 0), np.uint8)
        described, kept = describe_at(view.image, keypoints.astype(np.float32))
        descriptors = np.zeros((len(keypoints), 32), np.uint8)  # at the rim there is no patch
        descriptors[kept] = described
        return descriptors

    def levels_at(self, view: View, keypoints: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Return zeros: points are followed on the finest level."""
        return np.zeros(len(keypoints), np.uint8)


@dataclass(frozen=True)
class FeatureAssociation:
    """Finds features and matches them; see the module.

    Attributes:
        features: finds and describes those of an image.
        count: how many are wanted per keyframe.
        matching: how descriptors are compared.
        reach: how far they are looked for at least, as a part of the image's width.
    """

    features: Callable[[Image], tuple[Corners, NDArray[np.uint8]]]
    count: int
    matching: MatchConfig
    reach: float = 0.0
    follows: ClassVar[bool] = False

    @staticmethod
    def of_detector(
        config: FeatureConfig, matching: MatchConfig, mask: NDArray[np.bool_]
    ) -> "FeatureAssociation":
        """Return one that detects corners on one level, more than a keyframe needs."""

        def features(image: Image) -> tuple[Corners, NDArray[np.uint8]]:
            corners = detect(image, config, 2 * config.count, None, mask)
            descriptors, kept = describe(image, corners, config.detector)
            at = corners.keypoints[kept], corners.strength[kept], corners.level[kept]
            return Corners(*at), descriptors

        return FeatureAssociation(features, config.count, matching)

    @staticmethod
    def of_pyramid(
        config: OrbConfig, matching: MatchConfig, mask: NDArray[np.bool_]
    ) -> "FeatureAssociation":
        """Return one that finds features on all levels of a pyramid."""

        def features(image: Image) -> tuple[Corners, NDArray[np.uint8]]:
            found = extract(image, config, mask)
            return Corners(found.keypoints, found.strength, found.level), found.descriptors

        return FeatureAssociation(features, config.count, matching, REACH)

    def view(self, frame_id: int, stamp_ns: int, image: Image) -> View:
        """Find and describe features."""
        return View(frame_id, stamp_ns, (image,), *self.features(image))

    def find(
        self,
        known: View,
        keypoints: NDArray[np.float64],
        descriptors: NDArray[np.uint8],
        view: View,
        guess: NDArray[np.float64],
        warp: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Match the descriptors near the guesses."""
        reach = max(self.matching.radius_px, self.reach * view.image.shape[1])
        matches = match_guided(
            descriptors,
            guess,
            view.descriptors,
            view.corners.keypoints,
            replace(self.matching, radius_px=reach),
        )
        found = matches >= 0
        pixels = np.array(guess)
        pixels[found] = view.corners.keypoints[matches[found]]
        return pixels, found

    def extend(
        self, view: View, occupied: NDArray[np.float64], count: int
    ) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
        """Take the strongest features that no landmark has claimed."""
        free = np.ones(len(view.corners.keypoints), np.bool_)
        free[self._rows(view, occupied)] = False
        index = np.flatnonzero(free)[:count]
        return view.corners.keypoints[index].astype(np.float64), view.descriptors[index]

    def descriptors_at(self, view: View, keypoints: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Look up the features that landmarks were matched to."""
        return view.descriptors[self._rows(view, keypoints)]

    def levels_at(self, view: View, keypoints: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Look up the features that landmarks were matched to."""
        return view.corners.level[self._rows(view, keypoints)]

    def _rows(self, view: View, keypoints: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return which features (n,) keypoints are, which come from this view unchanged."""
        known = view.corners.keypoints @ _AS_ONE
        order = np.argsort(known, kind="stable")
        wanted = keypoints.astype(np.float32) @ _AS_ONE
        return np.asarray(order[np.searchsorted(known[order], wanted)])
