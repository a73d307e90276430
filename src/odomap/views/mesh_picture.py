"""A picture of a mesh, for people without a viewer at hand.

Four views on one sheet: from where the camera was and from above, each in colour and in clay, which
shows what colour hides. Triangles are drawn into a depth buffer: a pixel inside one, with weights
w₀ + w₁ + w₂ = 1 of its corners, has

    1/z = Σ wᵢ / zᵢ,   colour = Σ wᵢ cᵢ,   light = 0.3 + 0.7 |n·l|

and the nearest one wins. Triangles seen from behind are left out: from above one looks into a room
through its ceiling.

Cost: about 0.1 s per million triangles and view.

Reference: J. Pineda, "A parallel algorithm for polygon rasterization", SIGGRAPH 1988.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.pose import SE3
from odomap.kernels import kernel
from odomap.maps.surface import Surface

__all__ = ["mesh_picture", "mesh_png", "warm_up"]

F32 = NDArray[np.float32]
Array = NDArray[np.float64]
Image = NDArray[np.uint8]

PAPER = 250
CLAY = 200
SMOOTH = 2
"""Pixels drawn per pixel shown, along each side."""
ABOVE_DEG = 52.0
"""How steeply the view from above looks down."""


def mesh_picture(
    mesh: Surface, Ts_world_camera: Array, size: tuple[int, int] = (800, 560)
) -> Image:
    """Draw a mesh from where a camera was and from above, in colour and in clay.

    Args:
        mesh: triangles with normals.
        Ts_world_camera: (N, 4, 4) where cameras were, N at least 1: they tell where up is.
        size: width and height of each of the four views, pixels.

    Returns:
        (2 H, 2 W, 3) uint8 RGB.
    """
    views = [_from_camera(mesh, Ts_world_camera, size), _from_above(mesh, Ts_world_camera, size)]
    count = len(mesh.points)
    clay = np.full((count, 3), CLAY, np.uint8)
    normals = mesh.normals if mesh.normals is not None else np.zeros((count, 3), np.float32)
    rows = []
    for colours in (clay if mesh.colours is None else mesh.colours, clay):
        drawn = [_draw(mesh, normals, colours, T, focal, size) for T, focal in views]
        rows.append(np.concatenate(drawn, axis=1))
    return np.concatenate(rows)


def mesh_png(mesh: Surface, Ts_world_camera: Array) -> bytes:
    """Return the same as the bytes of a PNG file."""
    import cv2

    picture = mesh_picture(mesh, Ts_world_camera)
    _, data = cv2.imencode(".png", np.ascontiguousarray(picture[:, :, ::-1]))
    return bytes(data)


def _from_camera(mesh: Surface, Ts: Array, size: tuple[int, int]) -> tuple[Array, float]:
    """Return T_view_world and the focal length of the middle camera's view, from further back."""
    T = Ts[len(Ts) // 2].copy()
    ahead = (mesh.points - T[:3, 3]) @ T[:3, 2]
    ahead = ahead[ahead > 0]
    back = 0.3 * float(np.median(ahead)) if len(ahead) else 0.0
    T[:3, 3] -= back * T[:3, 2]
    return np.asarray(SE3(T).inverse().matrix), 0.75 * size[0]


def _from_above(mesh: Surface, Ts: Array, size: tuple[int, int]) -> tuple[Array, float]:
    """Return T_view_world and the focal length of a view from above that holds the mesh."""
    up = -Ts[:, :3, 1].mean(axis=0)
    up /= max(float(np.linalg.norm(up)), 1e-9)
    points = mesh.points.astype(np.float64)
    low, high = (np.quantile(points, q, axis=0) for q in (0.02, 0.98)) if len(points) else (up, up)
    middle = 0.5 * (low + high)
    steep = np.deg2rad(ABOVE_DEG)
    ahead = _across(points - middle, up, Ts[:, :3, 2].mean(axis=0))
    z = np.cos(steep) * ahead - np.sin(steep) * up
    x = np.cross(z, up)
    x /= max(float(np.linalg.norm(x)), 1e-9)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    focal = 2.0 * size[0]
    # As near as leaves hardly a point outside.
    offset = (points - middle) @ T[:3, :3]
    needed = np.abs(offset[:, :2]) * focal / (0.47 * np.array(size)) - offset[:, 2:]
    far = float(np.quantile(needed.max(axis=1), 0.995)) if len(points) else 1.0
    T[:3, 3] = middle - far * z
    return np.asarray(np.linalg.inv(T)), focal


def _across(offset: Array, up: Array, towards: Array) -> Array:
    """Return the level direction across the longest extent, turned towards another."""
    level = offset - np.outer(offset @ up, up)
    along = np.linalg.eigh(level.T @ level)[1][:, 2]
    across = np.cross(along, up)
    across /= max(float(np.linalg.norm(across)), 1e-9)
    return np.asarray(across if across @ towards >= 0.0 else -across)


def _draw(
    mesh: Surface, normals: F32, colours: Image, T: Array, focal: float, size: tuple[int, int]
) -> Image:
    """Draw one view, smoothed."""
    width, height = size[0] * SMOOTH, size[1] * SMOOTH
    points = mesh.points.astype(np.float64) @ T[:3, :3].T + T[:3, 3]
    turned = normals.astype(np.float64) @ T[:3, :3].T
    rgb = np.full((height, width, 3), PAPER, np.uint8)
    nearest = np.zeros((height, width), np.float32)
    draw_kernel(
        np.ascontiguousarray(points), np.ascontiguousarray(turned), np.ascontiguousarray(colours),
        np.ascontiguousarray(mesh.faces), focal * SMOOTH, nearest, rgb,
    )  # fmt: skip
    import cv2

    return np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.uint8)


@kernel
def draw_kernel(
    points: Array, normals: Array, colours: Image, faces: NDArray[np.int32], focal: float,
    nearest: F32, rgb: Image,
) -> None:  # fmt: skip
    """Draw triangles given in view axes; nearest holds 1/z, rgb the colours.

    wᵢ = cross of the edge opposite corner i with the way to the pixel, over twice the area. The
    light comes from the viewer's upper left.
    """
    height, width = nearest.shape
    for f in range(faces.shape[0]):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        za, zb, zc = points[a, 2], points[b, 2], points[c, 2]
        if min(za, zb, zc) < 0.05:
            continue
        xa, ya = focal * points[a, 0] / za + 0.5 * width, focal * points[a, 1] / za + 0.5 * height
        xb, yb = focal * points[b, 0] / zb + 0.5 * width, focal * points[b, 1] / zb + 0.5 * height
        xc, yc = focal * points[c, 0] / zc + 0.5 * width, focal * points[c, 1] / zc + 0.5 * height
        area = (xb - xa) * (yc - ya) - (xc - xa) * (yb - ya)
        # Rows grow downwards: what turns counter-clockwise as seen has a negative area.
        if not area < 0.0:
            continue
        left, right = max(0.0, min(xa, xb, xc)), min(width - 1.0, max(xa, xb, xc))
        top, bottom = max(0.0, min(ya, yb, yc)), min(height - 1.0, max(ya, yb, yc))
        for row in range(int(np.ceil(top)), int(np.floor(bottom)) + 1):
            for column in range(int(np.ceil(left)), int(np.floor(right)) + 1):
                wa = ((xb - column) * (yc - row) - (xc - column) * (yb - row)) / area
                wb = ((xc - column) * (ya - row) - (xa - column) * (yc - row)) / area
                wc = 1.0 - wa - wb
                if wa < 0.0 or wb < 0.0 or wc < 0.0:
                    continue
                closeness = wa / za + wb / zb + wc / zc
                if closeness <= nearest[row, column]:
                    continue
                nearest[row, column] = closeness
                nx = wa * normals[a, 0] + wb * normals[b, 0] + wc * normals[c, 0]
                ny = wa * normals[a, 1] + wb * normals[b, 1] + wc * normals[c, 1]
                nz = wa * normals[a, 2] + wb * normals[b, 2] + wc * normals[c, 2]
                length = np.sqrt(nx * nx + ny * ny + nz * nz) + 1e-12
                light = 0.3 + 0.7 * abs(-0.35 * nx - 0.5 * ny - 0.79 * nz) / length
                for k in range(3):
                    value = wa * colours[a, k] + wb * colours[b, k] + wc * colours[c, k]
                    rgb[row, column, k] = min(255.0, value * light + 0.5)


def warm_up() -> None:
    """Compile the kernel."""
    points = np.array([[0.0, 0, 1], [0, 1, 1], [1, 0, 1]])
    faces, colours = np.array([[0, 1, 2]], np.int32), np.zeros((3, 3), np.uint8)
    nearest, rgb = np.zeros((4, 4), np.float32), np.zeros((4, 4, 3), np.uint8)
    draw_kernel(points, points, colours, faces, 4.0, nearest, rgb)
