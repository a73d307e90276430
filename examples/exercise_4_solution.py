"""Exercise 4, solved: an occupancy grid, from scratch (docs/lesson/exercise_4.md).

    python examples/exercise_4_solution.py                          # a simulated hall
    python examples/exercise_4_solution.py RECORDING grid.yaml grid.png

Rays through cells, log-odds, unknown, free and occupied, saved as PGM and YAML and read back. From
odomap come the scans with their true poses, the plan to compare with, and a second reader.
"""

import sys
from pathlib import Path

import numpy as np
import yaml
from matplotlib.figure import Figure

import odomap
from odomap.simulation.floorplan import Plan

DATA = "sim:hall?sensors=laser&seed=4&rate_hz=2&beams=361&range_m=8&moving_objects=3"
RESOLUTION = 0.05  # m
L_HIT, L_MISS, LIMIT = 0.9, 0.3, 4.0  # log-odds
OCCUPIED_ABOVE, FREE_BELOW = 0.65, 0.35  # probabilities
BLACK, GREY, WHITE = 0, 205, 254  # occupied, unknown, free in a file

Array = np.ndarray


# ---- rays ----


def cells_on(starts: Array, ends: Array) -> Array:
    """Return the (M, 2) cells that rays pass, without the last of each; all in cells.

    All rays walk together, from border to border: of the next border along x and the next along y
    the nearer one is crossed.
    """
    cell, last = np.floor(starts).astype(int), np.floor(ends).astype(int)
    d = ends - starts
    towards = np.where(d > 0, 1, -1)
    with np.errstate(divide="ignore", invalid="ignore"):
        per_cell = 1.0 / np.abs(d)
        border = np.abs(cell + (d > 0) - starts) * per_cell
    border[d == 0] = np.inf
    left = np.abs(last - cell)  # borders still to cross
    passed = []
    while (going := left.any(axis=1)).any():
        cell, border, left = cell[going], border[going], left[going]
        towards, per_cell = towards[going], per_cell[going]
        passed.append(cell.copy())
        border_left = np.where(left > 0, border, np.inf)
        row, axis = np.arange(len(cell)), border_left.argmin(axis=1)
        cell[row, axis] += towards[row, axis]
        border[row, axis] += per_cell[row, axis]
        left[row, axis] -= 1
    return np.concatenate(passed) if passed else np.zeros((0, 2), int)


# ---- the grid ----


class Grid:
    """Log-odds of cells, (H, W), row by row along y; cell (0, 0) has its corner at the origin."""

    def __init__(self, low: Array, high: Array, resolution: float = RESOLUTION) -> None:
        self.resolution, self.origin = resolution, np.array(low, float)
        columns, rows = np.ceil((high - low) / resolution).astype(int)
        self.log_odds, self.is_known = np.zeros((rows, columns)), np.zeros((rows, columns), bool)

    def insert(self, eye: Array, hits: Array, free: Array) -> None:
        """Add a scan: where it was taken, its hits, and the ends of beams that met nothing."""
        ends = (np.concatenate([hits, free]) - self.origin) / self.resolution
        start = np.broadcast_to((eye - self.origin) / self.resolution, ends.shape)
        is_passed, is_hit = (np.zeros(self.log_odds.shape, bool) for _ in range(2))
        x, y = cells_on(start, ends).T
        is_passed[y, x] = True
        x, y = np.floor(ends[: len(hits)]).astype(int).T
        is_hit[y, x] = True
        # One scan speaks once of a cell, and a hit outweighs the beams that pass it.
        is_passed &= ~is_hit
        change = L_HIT * is_hit - L_MISS * is_passed
        self.log_odds = np.clip(self.log_odds + change, -LIMIT, LIMIT)
        self.is_known |= is_hit | is_passed

    @property
    def probability(self) -> Array:
        """(H, W) that a cell is occupied; 0.5 where nothing is known."""
        return 1.0 / (1.0 + np.exp(-self.log_odds))

    def pixels(self) -> Array:
        """Return (H, W) uint8 as in a file: black, grey and white, the greatest y first."""
        grey = np.full(self.log_odds.shape, GREY, np.uint8)
        grey[self.is_known & (self.probability > OCCUPIED_ABOVE)] = BLACK
        grey[self.is_known & (self.probability < FREE_BELOW)] = WHITE
        return grey[::-1]


# ---- files ----


def save(grid: Grid, file: Path) -> None:
    """Write a grid as YAML, and its picture beside it."""
    pixels, image = grid.pixels(), file.with_suffix(".pgm")
    height, width = pixels.shape
    image.write_bytes(f"P5\n{width} {height}\n255\n".encode() + pixels.tobytes())
    content = {
        "image": image.name,
        "mode": "trinary",
        "resolution": grid.resolution,
        "origin": [*grid.origin.tolist(), 0.0],
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,
    }
    file.write_text(yaml.safe_dump(content, sort_keys=False, default_flow_style=None))


def load(file: Path) -> tuple[Array, Array, float]:
    """Return pixels (H, W), the greatest y first, the origin (2,), and the size of a cell."""
    content = yaml.safe_load(file.read_text())
    data = (file.parent / content["image"]).read_bytes()
    magic, size, depth, pixels = data.split(b"\n", 3)  # as `save` writes it
    if magic != b"P5" or depth != b"255":
        raise odomap.InputError(f"{content['image']}: not a PGM as this program writes it")
    width, height = (int(n) for n in size.split())
    picture = np.frombuffer(pixels, np.uint8).reshape(height, width)
    return picture, np.array(content["origin"][:2]), content["resolution"]


# ---- a recording ----


def scans_of(recording: str) -> tuple[list[tuple[Array, Array, Array]], odomap.Source]:
    """Return for each scan where it was taken, its hits, and the ends of beams that met nothing."""
    source, scans = odomap.open(recording), []
    mount = source.rig.lidars[0]
    angles, farthest = np.linspace(*mount.angles), mount.range_m[1]
    for frame, T_world_body in zip(source, source.truth.Ts_world_body):
        T = T_world_body @ mount.T_body_lidar.matrix
        heading = np.arctan2(T[1, 0], T[0, 0]) + angles
        rays = np.column_stack([np.cos(heading), np.sin(heading)])
        hit, far = np.isfinite(frame.scan), np.isposinf(frame.scan)  # and NaN says nothing at all
        hits = T[:2, 3] + frame.scan[hit, None] * rays[hit]
        scans.append((T[:2, 3], hits, T[:2, 3] + farthest * rays[far]))
    return scans, source


def compare(grid: Grid, plan: Plan, seen: Array) -> dict[str, float]:
    """Compare a grid with the true walls.

    Args:
        plan: with `distances` of points from the nearest wall.
        seen: (N, 2) points of walls that beams met.
    """
    rows, columns = np.indices(grid.log_odds.shape)
    centres = grid.origin + (np.stack([columns, rows], axis=-1) + 0.5) * grid.resolution
    wall = grid.is_known & (grid.probability > OCCUPIED_ABOVE)
    free = grid.is_known & (grid.probability < FREE_BELOW)
    x, y = np.floor((seen - grid.origin) / grid.resolution).astype(int).T
    near = wall.copy()  # or beside a cell that is
    for axis in (0, 1):
        near |= np.roll(near, 1, axis) | np.roll(near, -1, axis)
    return {
        "occupied": int(wall.sum()),
        "true": float(np.mean(plan.distances(centres[wall]) < grid.resolution)),
        "found": float(near[y, x].mean()),
        "free_m2": float(free.sum() * grid.resolution**2),
        "free_false": float(np.mean(plan.distances(centres[free]) < 0.25 * grid.resolution)),
    }


def answer(recording: str = DATA) -> tuple[Grid, odomap.Source, dict[str, float]]:
    """Make a grid of a recording with true poses, and judge it where its plan is known."""
    scans, source = scans_of(recording)
    points = np.concatenate([np.concatenate([eye[None], hits, free]) for eye, hits, free in scans])
    grid = Grid(points.min(axis=0) - 0.5, points.max(axis=0) + 0.5)
    for scan in scans:
        grid.insert(*scan)
    seen = np.concatenate([source.world.hits(k) for k in range(len(source))])
    return grid, source, compare(grid, source.world.plan, seen)


def draw(grid: Grid, walls: Array) -> Figure:
    """Draw what is believed, and what is in the file, with the true walls."""
    figure = Figure(figsize=(9.6, 3.6), layout="constrained")
    high = grid.origin + grid.resolution * np.array(grid.log_odds.shape[::-1])
    extent = (grid.origin[0], high[0], grid.origin[1], high[1])
    left, right = figure.subplots(1, 2, sharex=True, sharey=True)
    shown = left.imshow(grid.probability[::-1], cmap="Greys", extent=extent, vmin=0, vmax=1)
    figure.colorbar(shown, ax=left, label="probability", shrink=0.7)
    right.imshow(grid.pixels(), cmap="gray", extent=extent, vmin=0, vmax=255)
    for ax, ay, bx, by in walls:
        right.plot([ax, bx], [ay, by], color="tab:orange", lw=0.8)
    return figure


def main(
    recording: str = DATA, file: str = "grid.yaml", picture: str = "grid.png"
) -> dict[str, float]:
    """Make a grid, save it, read it back, compare it; return the shares."""
    grid, source, found = answer(recording)
    height, width = grid.log_odds.shape
    known = grid.is_known.mean()
    print(f"{len(source)} scans, {width} x {height} cells, {known:.0%} of them known")
    print(f"{found['occupied']} cells occupied, {found['true']:.1%} of them walls")
    print(f"{found['found']:.1%} of the walls that beams met occupied")
    print(f"{found['free_m2']:.0f} m2 free, {found['free_false']:.2%} of that walls")
    save(grid, Path(file))
    pixels, origin, resolution = load(Path(file))
    is_same = np.array_equal(pixels, grid.pixels()) and np.allclose(origin, grid.origin)
    theirs = odomap.load_grid(file)
    is_same &= np.array_equal(theirs.log_odds[::-1] > 0, pixels == BLACK)
    is_same &= np.array_equal(theirs.log_odds[::-1] < 0, pixels == WHITE)
    is_same &= resolution == theirs.resolution
    print(f"read back, here and by odomap: {'the same' if is_same else 'another grid'}")
    draw(grid, source.world.plan.walls).savefig(picture, dpi=110)
    return found | {"same": float(is_same)}


if __name__ == "__main__":
    main(*sys.argv[1:])
