"""Occupancy grids as files: a picture and a YAML beside it, as ROS keeps its maps.

    resolution: 0.05              image: hall.pgm           row 0 of the picture is the greatest y
    origin: [-3.2, -1.4, 0.0]     mode: trinary             p = (255 - pixel) / 255
    occupied_thresh: 0.65         free_thresh: 0.196        p > 0.65 occupied, p < 0.196 free

The origin is the corner of the lower left pixel with the least x and y. In mode trinary three
values are written, 0 occupied, 254 free and 205 unknown, which is 0.196: a free_thresh of 0.25, as
nav2 wrote for years, would make what was never seen free, so 205 is read as unknown whatever stands
there. In mode raw a pixel is 100 p, and above 100 unknown. In mode scale, read only, p counts from
one threshold to the other, and what is transparent is unknown. With negate white is occupied.

From a picture comes evidence again: l = log(p / (1 - p)) within its limits, which is as much as can
be believed where a threshold is passed. So scans are found in a grid that was saved.

Reference: "map_server", https://wiki.ros.org/map_server, 2008 (the format).
"""

from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from odomap.errors import CalibrationError, InputError, OutputError
from odomap.files.atomic import atomic_binary, atomic_text
from odomap.files.fields import Fields, read_yaml
from odomap.files.greypictures import GreyPicture, pgm_bytes, read_grey
from odomap.lidar.grid import MOST_CELLS, TINY, Cells, Evidence, OccupancyGrid

__all__ = ["GRID_SUFFIXES", "load_grid", "save_grid"]

Array = NDArray[np.float64]
Grey = NDArray[np.uint8]

GRID_SUFFIXES = (".yaml", ".yml")
OCCUPIED, FREE, UNKNOWN = 0, 254, 205
"""Pixels of mode trinary."""
OCCUPIED_ABOVE, FREE_BELOW = 0.65, 0.196
"""Thresholds that are written."""
SAVED_FREE_BELOW = 1.0 - OCCUPIED_ABOVE
"""p below which a cell is saved as free: as much must speak against it as for an occupied one."""
MODES = ("trinary", "scale", "raw")
LARGEST_CELL = 100.0
"""Metres: more is no resolution."""


def save_grid(path: str | Path, grid: OccupancyGrid, *, mode: str = "trinary") -> tuple[Path, Path]:
    """Save what is known of a grid as YAML, and beside it the picture as PGM.

    Args:
        path: ends in `.yaml`; the picture is named like it, with `.pgm`.
        grid: what is known.
        mode: "trinary" for occupied, free and unknown; "raw" for probabilities to a hundredth.

    Returns:
        Both files.

    Raises:
        InputError: the name ends otherwise, the mode is none, or nothing is known in the grid.
        OutputError: the operating system refuses.

    Example:
        >>> save_grid("hall.yaml", grid)  # doctest: +SKIP
    """
    file = Path(path)
    if file.suffix.lower() not in GRID_SUFFIXES:
        raise InputError(f"{file}: give a name that ends in .yaml")
    if mode not in ("trinary", "raw"):
        raise InputError(f"mode '{mode}': grids are saved as trinary or raw")
    known = grid.cropped()
    if not known.log_odds.size:
        raise InputError(f"{file}: nothing is known in the grid: there is nothing to save")
    image = file.with_suffix(".pgm")
    content = {
        "image": image.name,
        "mode": mode,
        "resolution": float(known.resolution),
        "origin": [float(known.origin[0]), float(known.origin[1]), 0.0],
        "negate": 0,
        "occupied_thresh": OCCUPIED_ABOVE,
        "free_thresh": FREE_BELOW,
    }
    if not file.parent.is_dir():
        raise OutputError(f"{file}: cannot be written: the folder does not exist: create it first")
    # The picture gets its name first: if it cannot, the YAML does not get its own.
    with atomic_text(file) as text, atomic_binary(image) as binary:
        text.write(yaml.safe_dump(content, sort_keys=False, default_flow_style=None))
        binary.write(pgm_bytes(_pixels(known, mode)))
    return file, image


def _pixels(grid: OccupancyGrid, mode: str) -> Grey:
    """Return the picture of a grid, the greatest y first."""
    p, is_known = 1.0 / (1.0 + np.exp(-grid.log_odds)), grid.is_known
    if mode == "raw":
        pixels = np.where(is_known, np.round(100.0 * p), 255.0)
    else:
        pixels = np.full(p.shape, UNKNOWN)
        pixels[is_known & (p > OCCUPIED_ABOVE)] = OCCUPIED
        pixels[is_known & (p < SAVED_FREE_BELOW)] = FREE
    return np.ascontiguousarray(pixels[::-1], np.uint8)


def load_grid(path: str | Path, evidence: Evidence | None = None) -> OccupancyGrid:
    """Load a grid that was saved here, or by any map_server.

    Args:
        path: the YAML file.
        evidence: what further beams say; its limit is what is believed of the cells.

    Returns:
        The grid. One whose origin is turned is turned back, each cell as the nearest one there.

    Raises:
        InputError: a file is missing, broken or too large, or a field is missing or cannot be.

    Example:
        >>> load_grid("hall.yaml").probability(np.zeros((1, 2)))  # doctest: +SKIP
    """
    file = Path(path)
    if file.is_file() and file.suffix.lower() not in GRID_SUFFIXES:
        raise InputError(f"{file}: give the .yaml of a grid, which names its picture")
    fields = read_yaml(file)
    resolution, origin = _place(fields)
    evidence = Evidence() if evidence is None else evidence
    read = _reading(fields)
    picture = read_grey(file.parent / fields.text("image"), MOST_CELLS)
    log_odds = read.log_odds(picture, evidence.limit)
    turn = float(origin[2]) if len(origin) > 2 else 0.0
    if turn:
        return _turned(log_odds, origin, resolution, evidence)
    return OccupancyGrid.of(log_odds, origin[:2], resolution, evidence)


def _place(fields: Fields) -> tuple[float, Array]:
    """Return the size of a cell, and x, y and angle of the corner of the first."""
    resolution = fields.number("resolution")
    if not 0.0 < resolution <= LARGEST_CELL:
        raise fields.error("resolution", f"is {resolution:g} m: metres of a cell are wanted")
    origin = fields.numbers("origin", (2, 3))
    if np.abs(origin[:2]).max() > 1e9:
        raise fields.error("origin", "is farther away than any map: metres are wanted")
    return resolution, origin


class _Reading:
    """What the pixels of a picture say.

    Args:
        mode: one of `MODES`.
        negate: whether white is occupied.
        thresholds: p below which a cell is free, and above which it is occupied.
    """

    def __init__(self, mode: str, negate: bool, thresholds: tuple[float, float]) -> None:
        self.mode, self.negate, self.thresholds = mode, negate, thresholds

    def log_odds(self, picture: GreyPicture, limit: float) -> Cells:
        """Return evidence (H, W), the least y first; 0 where nothing is known."""
        pixels = np.arange(256)
        dark = pixels if self.negate else 255 - pixels
        if self.mode == "raw":
            raw = 255 - dark
            p, is_known = raw / 100.0, raw <= 100
        else:
            p, is_known = self._occupied(dark / 255.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            l = np.where(is_known, np.clip(np.log(p / (1.0 - p)), -limit, limit), 0.0)  # noqa: E741
        values = np.where(is_known & (l == 0.0), TINY, l).astype(np.float32)
        log_odds = values[picture.grey]
        if picture.is_seen is not None and self.mode != "raw":
            log_odds[~picture.is_seen] = 0.0
        return np.ascontiguousarray(log_odds[::-1])

    def _occupied(self, p: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Return p after the thresholds, and where it is known."""
        free, occupied = self.thresholds
        between = np.clip(0.99 * (p - free) / (occupied - free), 0.01, 0.99)
        after = np.where(p > occupied, 1.0, np.where(p < free, 0.0, between))
        if self.mode == "scale":
            return after, np.full(p.shape, True)
        unknown = UNKNOWN if not self.negate else 255 - UNKNOWN
        return after, ((p > occupied) | (p < free)) & (np.arange(256) != unknown)


def _reading(fields: Fields) -> _Reading:
    mode = fields.text("mode", "trinary")
    if mode not in MODES:
        raise fields.error("mode", f"is '{mode}', none of {', '.join(MODES)}")
    negate = fields.get("negate")
    if negate not in (0, 1):
        raise fields.error("negate", f"must be 0 or 1, not '{negate}'")
    free, occupied = fields.number("free_thresh"), fields.number("occupied_thresh")
    if not 0.0 <= free < occupied <= 1.0:
        raise CalibrationError(
            f"{fields.where}: free_thresh {free:g} and occupied_thresh {occupied:g} must be "
            "0 to 1, the first below the second"
        )
    return _Reading(mode, bool(negate), (free, occupied))


def _turned(log_odds: Cells, origin: Array, resolution: float, evidence: Evidence) -> OccupancyGrid:
    """Return a grid along x and y of one that is turned about its corner."""
    height, width = log_odds.shape
    c, s = np.cos(origin[2]), np.sin(origin[2])
    R = np.array([[c, -s], [s, c]])
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]]) @ R.T
    low, high = np.floor(corners.min(axis=0) + 1e-9), np.ceil(corners.max(axis=0) - 1e-9)
    columns, rows = (high - low).astype(int)
    if int(columns) * int(rows) > MOST_CELLS:
        raise InputError(f"a turned grid of {columns} x {rows} cells is too large")
    turned = np.zeros((rows, columns), np.float32)
    x = low[0] + np.arange(columns) + 0.5
    for row in range(rows):
        y = low[1] + row + 0.5
        u, v = (np.floor(c * x + s * y).astype(int), np.floor(c * y - s * x).astype(int))
        is_in = (u >= 0) & (v >= 0) & (u < width) & (v < height)
        turned[row, is_in] = log_odds[v[is_in], u[is_in]]
    return OccupancyGrid.of(turned, origin[:2] + resolution * low, resolution, evidence)
