"""Frames with their tracks drawn on them: what the tracker saw, and what it believed.

Each tracked point has a short trail from where it was in the frame it was tracked from. Points the
pose agrees with are green dots, the others orange crosses: shape and colour both tell.
"""

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from odomap.maps.estimate import Tracks

__all__ = ["frame_figure"]

INLIER = "#35e0a1"
OUTLIER = "#ff7a1a"
SHADOW = "#000000"
DPI = 100
POINTS = 1500
WIDEST_PX = 960


def frame_figure(image: NDArray[np.uint8], tracks: Tracks | None) -> Figure:
    """Draw tracks on an image.

    Args:
        image: (H, W) or (H, W, 3) uint8.
        tracks: points of this image, or None to show it bare.

    Returns:
        A figure whose pixels are those of the image, at most 960 wide.
    """
    height, width = image.shape[:2]
    zoom = min(1.0, WIDEST_PX / width)
    figure = Figure(figsize=(width * zoom / DPI, height * zoom / DPI), dpi=DPI)
    ax = figure.add_axes((0, 0, 1, 1))
    ax.set_axis_off()
    ax.imshow(image, cmap="gray", vmin=0, vmax=255, aspect="auto", interpolation="antialiased")
    if tracks is not None and len(tracks.keypoints):
        for wanted, colour, marker in ((True, INLIER, "o"), (False, OUTLIER, "x")):
            chosen = np.nonzero(tracks.inlier == wanted)[0][:POINTS]
            now, before = tracks.keypoints[chosen], tracks.previous[chosen]
            trails = [p for p in np.stack([before, now], axis=1) if np.isfinite(p).all()]
            # A dark line under a bright one is readable on walls and on shadows.
            ax.add_collection(LineCollection(trails, colors=SHADOW, linewidths=3.0, alpha=0.45))
            label = "inlier" if wanted else "outlier"
            ax.add_collection(LineCollection(trails, colors=colour, linewidths=1.6, label=label))
            size = {"ms": 4.0 if wanted else 5.5, "mew": 0.5 if wanted else 1.6}
            edge = SHADOW if wanted else colour
            ax.plot(now[:, 0], now[:, 1], marker, ls="", color=colour, mec=edge, **size)  # type: ignore[arg-type]
    ax.set_xlim(-0.5, width - 0.5)
    ax.set_ylim(height - 0.5, -0.5)
    return figure
