"""Scenes: textured rectangles, the light on them, and things that move.

A point of a rectangle is c + s u + t v with 0 <= s <= a and 0 <= t <= b; it is seen from the side
away from u × v (pictures have s to the right and t downwards) and shows the texel
(s, t) * scale + offset. What leaves the surface is albedo x gain x light, the light being baked
once on a grid over each rectangle (`light`): the same from every direction, as a dull surface is.

A `SceneBuilder` collects rectangles and boxes; `build()` bakes the light and freezes them.

Paper: J. T. Kajiya, "The rendering equation", SIGGRAPH 1986 (its diffuse case).
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from odomap.simulation.light import LightGrid, Lights, bake
from odomap.simulation.path import Path
from odomap.simulation.rays import BoxTree
from odomap.simulation.texture import Atlas, texture

__all__ = ["BareBuilder", "Rectangles", "Scene", "SceneBuilder"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Rectangles:
    """Struct of arrays over N rectangles.

    Attributes:
        frames: (N, 9) corner c and unit sides u, v, in the world or, of movers, in their own frame.
        faces: (N, 8) a, b in metres, texels per metre, offset s and t in texels, gain, 1 if seen
            from both sides, 0.
        codes: (N, 4) int64: texture, first value, width and height of the light grid.
        mover: (N,) int64 index of the moving object it belongs to, or -1.
    """

    frames: Array
    faces: Array
    codes: NDArray[np.int64]
    mover: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.frames)

    def corners(self) -> Array:
        """Return (N, 4, 3) corners in order around the rectangle."""
        c, u, v = self.frames[:, :3], self.frames[:, 3:6], self.frames[:, 6:9]
        a, b = u * self.faces[:, 0:1], v * self.faces[:, 1:2]
        return np.stack([c, c + a, c + a + b, c + b], 1)


@dataclass(frozen=True)
class Scene:
    """A world to look at.

    Attributes:
        rectangles: its surfaces.
        atlas: their textures.
        light: baked light.
        movers: path of each moving object.
        tree: over the rectangles that stand still.
        sky: brightness at the horizon and at the zenith.
    """

    rectangles: Rectangles
    atlas: Atlas
    light: LightGrid
    movers: tuple[Path, ...]
    tree: BoxTree
    sky: tuple[float, float]

    def frames_at(self, time: float) -> Array:
        """Return (N, 9) corners and sides in the world at a time in seconds."""
        if not self.movers:
            return self.rectangles.frames
        frames = self.rectangles.frames.copy()
        for k, path in enumerate(self.movers):
            rows = self.rectangles.mover == k
            T = path.at(np.array([time])).Ts_world_body[0]
            frames[rows] = _transformed(T, frames[rows])
        return frames

    def moving(self, time: float) -> tuple[NDArray[np.int64], Array]:
        """Return rows of moving rectangles (M,) and their velocities (M, 3), m/s, at a time."""
        rows = np.flatnonzero(self.rectangles.mover >= 0)
        speeds = [path.at(np.array([time])).v_world_body[0] for path in self.movers]
        return rows, np.array([speeds[k] for k in self.rectangles.mover[rows]]).reshape(-1, 3)


def _transformed(T: Array, frames: Array) -> Array:
    moved = np.empty_like(frames)
    moved[:, :3] = frames[:, :3] @ T[:3, :3].T + T[:3, 3]
    moved[:, 3:6] = frames[:, 3:6] @ T[:3, :3].T
    moved[:, 6:9] = frames[:, 6:9] @ T[:3, :3].T
    return moved


def _faces_of_a_box() -> list[tuple[int, Array, Array, Array]]:
    """Axis, outward normal, right and down of the six faces; the bottom is the last."""
    faces = []
    for axis in range(3):
        for sign in (1.0, -1.0):
            normal = np.zeros(3)
            normal[axis] = sign
            down = np.array([0.0, 0.0, -1.0]) if axis < 2 else np.array([0.0, -1.0, 0.0])
            faces.append((axis, normal, np.cross(normal, down), down))
    return faces


FACES = _faces_of_a_box()


class SceneBuilder:
    """Collects surfaces; everything random comes from one generator."""

    def __init__(self, rng: np.random.Generator, lights: Lights, sky: tuple[float, float]) -> None:
        self.rng = rng
        self.lights = lights
        self.sky = sky
        self._images: list[NDArray[np.float32]] = []
        self._frames: list[Array] = []
        self._faces: list[list[float]] = []
        self._textures: list[int] = []
        self._mover: list[int] = []
        self._paths: list[Path] = []

    def paint(self, kind: str, width: int = 512, height: int = 512) -> int:
        """Paint a texture and return its number."""
        self._images.append(texture(kind, self.rng, width, height))
        return len(self._images) - 1

    def mover(self, path: Path) -> int:
        """Add a moving object and return its number, to be given to `rectangle` or `box`."""
        self._paths.append(path)
        return len(self._paths) - 1

    def rectangle(
        self,
        corner: Array,
        u: Array,
        v: Array,
        size: tuple[float, float],
        texture: int,
        scale: float = 0.0,
        *,
        gain: float = 1.0,
        two_sided: bool = False,
        mover: int = -1,
        origin_texels: tuple[float, float] | None = None,
    ) -> None:
        """Add a rectangle.

        Args:
            corner: (3,) top left as seen from the front, metres.
            u: (3,) direction to the right, any length.
            v: (3,) direction downwards, square to u.
            size: extent along u and v, metres.
            texture: number from `paint`.
            scale: texels per metre; 0 spreads the texture over the rectangle as far as it goes.
            gain: factor on the albedo.
            two_sided: whether it is seen from behind too.
            mover: number from `mover`, or -1 if it stands still.
            origin_texels: which texel lies in the corner; default a random one, or the first
                where the texture is fitted.
        """
        height, width = self._images[texture].shape
        offset = self.rng.uniform(0, (width, height)) if scale > 0 else np.zeros(2)
        if origin_texels is not None:
            offset = np.array(origin_texels)
        scale = scale if scale > 0 else min((width - 1) / size[0], (height - 1) / size[1])
        sides = [x / np.sqrt(x @ x) for x in (u, v)]
        self._frames.append(np.concatenate([np.asarray(corner, float), *sides]))
        self._faces.append([*size, scale, *offset, gain, float(two_sided), 0.0])
        self._textures.append(texture)
        self._mover.append(mover)

    def box(
        self,
        centre: Array,
        size: tuple[float, float, float],
        textures: int | list[int],
        scale: float = 0.0,
        *,
        axes: Array | None = None,
        gain: float = 1.0,
        mover: int = -1,
        bottom: bool = False,
    ) -> None:
        """Add a box.

        Args:
            centre: (3,) metres.
            size: extents along its axes, metres.
            textures: number of the texture; or of the sides along ±x, ±y and of top and bottom.
            scale: texels per metre, 0 to fit.
            axes: (3, 3) columns are its axes; default those of the world.
            gain: factor on the albedo.
            mover: number of its moving object, or -1.
            bottom: whether it has one.
        """
        axes = np.eye(3) if axes is None else axes
        kinds = [textures] * 3 if isinstance(textures, int) else textures
        half = 0.5 * np.array(size)
        for axis, normal, right, down in FACES if bottom else FACES[:-1]:
            a, b = float(abs(right) @ half), float(abs(down) @ half)
            corner = normal * half[axis] - right * a - down * b
            self.rectangle(
                centre + axes @ corner,
                axes @ right,
                axes @ down,
                (2 * a, 2 * b),
                kinds[axis],
                scale,
                gain=gain,
                mover=mover,
            )

    @property
    def movers(self) -> tuple[Path, ...]:
        """Return the path of each moving object."""
        return tuple(self._paths)

    def rectangles(self) -> Rectangles:
        """Return what was collected, without light."""
        codes = np.zeros((len(self._frames), 4), np.int64)
        codes[:, 0] = self._textures
        return Rectangles(
            np.array(self._frames),
            np.array(self._faces),
            codes,
            np.array(self._mover, np.int64),
        )

    def build(self) -> Scene:
        """Bake the light and freeze the scene."""
        rectangles = self.rectangles()
        codes = rectangles.codes
        tree = self._tree(rectangles)
        start = replace(rectangles, frames=self._frames_at_start(rectangles))
        light = bake(start.frames, start.faces, rectangles.mover, tree, self.lights, self.rng)
        codes[:, 1:] = light.table
        atlas = Atlas.of(self._images)
        return Scene(rectangles, atlas, light, tuple(self._paths), tree, self.sky)

    def _tree(self, rectangles: Rectangles) -> BoxTree:
        still = np.flatnonzero(rectangles.mover < 0)
        tree = BoxTree.of(rectangles.corners()[still])
        return replace(tree, order=still[tree.order])

    def _frames_at_start(self, rectangles: Rectangles) -> Array:
        frames = rectangles.frames.copy()
        for k, path in enumerate(self._paths):
            rows = rectangles.mover == k
            frames[rows] = _transformed(path.at(np.zeros(1)).Ts_world_body[0], frames[rows])
        return frames


class BareBuilder(SceneBuilder):
    """Collects surfaces that no camera looks at: nothing is painted, which is what takes long.

    The same seed furnishes otherwise than with paint, since painting draws numbers, too.

    Attributes:
        materials: kind of each texture.
    """

    def __init__(self, rng: np.random.Generator, lights: Lights, sky: tuple[float, float]) -> None:
        super().__init__(rng, lights, sky)
        self.materials: list[str] = []

    def paint(self, kind: str, width: int = 512, height: int = 512) -> int:
        """Remember what a texture would show and return its number."""
        self.materials.append(kind)
        self._images.append(np.broadcast_to(np.zeros((), np.float32), (height, width)))
        return len(self._images) - 1
