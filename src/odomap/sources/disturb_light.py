"""Disturbances of light: too much of it, or an exposure that jumps.

A camera whose exposure changes by a factor g shows every byte b as

    b' = min(255, round(g b)),

and what is clipped is gone. Patches and descriptors that compare levels, not differences, lose
what they track when g steps from frame to frame; where one camera of a pair steps alone, the two
images of a point differ and its disparity with them.

Reference: EMVA Standard 1288, "Characterization of image sensors and cameras" (linear
camera model).
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.sensors.frame import Frame
from odomap.sources.source import Source
from odomap.sources.wrappers import Changed

__all__ = ["exposure_jumps", "overexpose"]


def overexpose(source: Source, frames: Iterable[int], gain: float = 8.0) -> Source:
    """Brighten the images of some frames until most is white: the sun, a lamp, a tunnel's end.

    Args:
        source: any source; depth stays, as a depth camera brings its own light.
        frames: ids of the frames.
        gain: factor on the bytes.

    Raises:
        InputError: the gain is not a positive number.
    """
    chosen = frozenset(frames)
    levels = _levels(gain, "overexpose: gain")
    return Changed(
        source, "over-exposed", lambda frame: _lit(frame, levels) if frame.id in chosen else frame
    )


def exposure_jumps(
    source: Source,
    every: int = 5,
    factors: Sequence[float] = (1.0, 2.0, 0.5),
    *,
    cameras: Iterable[int] | None = None,
) -> Source:
    """Step the exposure every few frames: an automatic exposure that hunts, lamps that flicker.

    Args:
        source: any source.
        every: frames from one step to the next, by their ids.
        factors: on the bytes, taken in turn.
        cameras: rows of the rig's cameras that step; default all alike.

    Raises:
        InputError: `every` is not positive, or a factor is not a positive number.
    """
    if every < 1:
        raise InputError(f"exposure_jumps: every {every} must be 1 or more")
    if not factors:
        raise InputError("exposure_jumps: factors: give one or more")
    levels = [_levels(factor, "exposure_jumps: factor") for factor in factors]
    chosen = None if cameras is None else frozenset(cameras)
    return Changed(
        source,
        "exposure jumps",
        lambda frame: _lit(frame, levels[frame.id // every % len(levels)], chosen),
    )


def _levels(gain: float, name: str) -> NDArray[np.uint8]:
    """Return what each of the 256 bytes becomes."""
    if not (np.isfinite(gain) and gain > 0):
        raise InputError(f"{name} {gain} must be a positive number")
    return np.minimum(np.rint(gain * np.arange(256.0)), 255).astype(np.uint8)


def _lit(frame: Frame, levels: NDArray[np.uint8], cameras: frozenset[int] | None = None) -> Frame:
    images = tuple(
        image if image is None or (cameras is not None and k not in cameras) else levels[image]
        for k, image in enumerate(frame.images)
    )
    return replace(frame, images=images)
