"""Depth images: from 16-bit files to metres, and what can be wrong with them.

A depth camera writes one number per pixel, and z = number / factor metres; numbers in `invalid`
(0) are pixels it could not measure. Factors in use are 1000 (millimetres) and 5000 (TUM), which
nothing in a file tells apart. The scene does: such sensors measure from 0.2 to 12 m, and
what is held or carried through rooms sees something within 2.5 m. A factor under which the 1st and
99th percentile of the depths of a few images leave that range is doubted, and the usual one that
fits is named; a median below 5 cm or above 60 m cannot be true.

Colour and depth are triggered apart: frames take the depth whose stamp is nearest, within half a
frame period. Its offset is kept, since one that is the same in all pairs is a clock that lags.

Reference: J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from odomap.errors import CalibrationError, InputError
from odomap.sensors.rig import DepthMount
from odomap.sources.calibration import size_text
from odomap.sources.images import BadImage, decode, spread

__all__ = ["DepthFiles", "check_factor", "probe_depth", "read_depth", "to_metres"]

SAMPLES = 6
"""Images looked at to find out whether the factor can be true."""
FACTORS = (1000.0, 5000.0)
"""Values per metre that depth cameras and data sets use."""
PLAUSIBLE_M = (0.2, 12.0)
"""Nearest and farthest depth (1st and 99th percentile) of common sensors."""
NEAREST_M = 2.5
"""Something of a recording is nearer than that."""
POSSIBLE_M = (0.05, 60.0)
"""A median depth outside of this cannot be true."""


@dataclass(frozen=True)
class DepthFiles:
    """The depth images of a recording, registered to one of its cameras.

    Attributes:
        folder: where they are.
        names: (N,) one file name per frame; None where there is none near enough in time.
        offsets_ns: (N,) int64 stamp of the depth minus that of the frame; 0 where there is none.
        mount: the factor, and what counts as invalid.
        resolution: width and height, pixels.
    """

    folder: Path
    names: Sequence[str | None]
    offsets_ns: NDArray[np.int64]
    mount: DepthMount
    resolution: tuple[int, int]

    @property
    def paired(self) -> NDArray[np.int64]:
        """Offsets of the frames that have depth."""
        return self.offsets_ns[[name is not None for name in self.names]]


def read_depth(path: Path, mount: DepthMount, resolution: tuple[int, int]) -> NDArray[np.float32]:
    """Read a depth image.

    Args:
        path: the file.
        mount: the factor, and what counts as invalid.
        resolution: width and height it must have, pixels.

    Returns:
        (H, W) float32 metres, 0 where unknown.

    Raises:
        BadImage: it is missing, truncated, no depth image, or of another size.
    """
    raw = _decode(path)
    size = (raw.shape[1], raw.shape[0])
    if size != resolution:
        raise BadImage(f"depth is {size_text(size)}, expected {size_text(resolution)}")
    return to_metres(raw, mount)


def to_metres(raw: NDArray[np.uint16], mount: DepthMount) -> NDArray[np.float32]:
    """Convert stored values to metres: (H, W) float32, 0 where unknown."""
    depth = raw.astype(np.float32)
    depth /= np.float32(mount.factor)
    for value in mount.invalid:
        if value:
            depth[raw == value] = 0.0
    return depth


def _decode(path: Path) -> NDArray[np.uint16]:
    raw = decode(path)
    if raw.ndim == 3:
        raise BadImage(
            f"has {raw.shape[2]} channels: depth is stored as one channel of 16 bits "
            "(a coloured picture of depth cannot be used)"
        )
    if raw.dtype != np.uint16:
        raise BadImage(
            "has 8 bits: depth is stored with 16; was it converted, or saved as JPEG? "
            "Export it again as 16-bit PNG"
        )
    return np.asarray(raw, np.uint16)


def probe_depth(
    paths: Sequence[Path], mount: DepthMount, resolution: tuple[int, int], where: str
) -> str:
    """Check a few depth images spread over a recording: kind, size, factor.

    Args:
        paths: all of its depth images.
        mount: the factor, and what counts as invalid.
        resolution: size of the images of the camera that depth is registered to.
        where: what says the factor, for messages.

    Returns:
        A note for the user; empty if all is plausible.

    Raises:
        InputError: none can be used: names the first of them and why.
        CalibrationError: depth has another size than colour, or the factor cannot be true.
    """
    samples: list[NDArray[np.uint16]] = []
    odd: list[tuple[Path, tuple[int, int]]] = []
    reason = "no images"
    for index in spread(len(paths), SAMPLES):
        try:
            raw = _decode(paths[index])
        except BadImage as error:
            reason = f"{paths[index]}: {error}" if reason == "no images" else reason
            continue
        size = (raw.shape[1], raw.shape[0])
        if size != resolution:
            odd.append((paths[index], size))
            continue
        samples.append(raw[~np.isin(raw, (0, *mount.invalid))])
        if len(samples) + len(odd) == SAMPLES:
            break
    if len(odd) > len(samples):
        path, size = odd[0]
        raise CalibrationError(
            f"{path}: depth is {size_text(size)}, but colour is {size_text(resolution)}: depth "
            "must be registered to the colour camera; export it aligned to colour, or resize "
            "colour and its calibration"
        )
    if not samples:
        raise InputError(f"{reason}; no depth image can be used")
    return check_factor(np.concatenate(samples), mount.factor, where)


def check_factor(values: NDArray[np.uint16], factor: float, where: str) -> str:
    """Tell whether depths can be true under a factor.

    Args:
        values: (N,) valid stored values of a few images.
        factor: stored value per metre.
        where: what says the factor, for messages.

    Returns:
        A note for the user; empty if all is plausible.

    Raises:
        CalibrationError: the median depth is below 5 cm or above 60 m.
    """
    if len(values) == 0:
        return "the depth images looked at are empty: nothing is measured in them"
    near, median, far = (float(v) for v in np.percentile(values, (1, 50, 99)))
    usual = [f for f in FACTORS if f != factor and _fits(near / f, far / f)]
    hint = "it is the stored value per metre"
    if usual:
        near_m, far_m = near / usual[0], far / usual[0]
        hint = f"is it {usual[0]:g} (then {near_m:.2g} to {far_m:.2g} m)?"
    found = f"depths are {near / factor:.3g} to {far / factor:.3g} m with factor {factor:g}"
    if not POSSIBLE_M[0] <= median / factor <= POSSIBLE_M[1]:
        raise CalibrationError(f"{where}: depth: {found}, which cannot be: {hint}")
    return "" if _fits(near / factor, far / factor) else f"{found}: {hint}"


def _fits(near: float, far: float) -> bool:
    return PLAUSIBLE_M[0] <= near <= NEAREST_M and far <= PLAUSIBLE_M[1]
