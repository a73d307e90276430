"""COLMAP text: a map as structure-from-motion and Gaussian-splatting programs read it.

    cameras.txt    CAMERA_ID PINHOLE WIDTH HEIGHT fx fy cx cy
    images.txt     IMAGE_ID qw qx qy qz tx ty tz CAMERA_ID NAME      T_camera_world
                   X Y POINT3D_ID ...                                all features, -1: no landmark
    points3D.txt   POINT3D_ID X Y Z R G B ERROR (IMAGE_ID POINT2D_INDEX) ...

There is one camera, the ideal pinhole that all features are in; images are the living keyframes,
named by their stamps in nanoseconds. Ids are those of the map plus 1, since COLMAP counts from 1.
Its pixels begin at the corner of an image and not at the centre of its first pixel, so half a pixel
is added to all that is measured in them. ERROR is the mean distance of what was seen from what is
expected, pixels. O(features).

Reference: J. L. Schönberger, J.-M. Frahm, "Structure-from-Motion Revisited", CVPR 2016.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.files.atomic import atomic_text
from odomap.geometry.camera import Camera
from odomap.geometry.lie import quaternion_from_rotation
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.maps.states import act_inverse, compose

__all__ = ["ColmapModel", "colmap_model", "write_colmap"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

GREY = "128 128 128"
"""Colour of all points: a map knows none."""


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """A map as COLMAP sees it; rows, not ids, refer to each other.

    Attributes:
        camera: the pinhole of all images.
        keyframes: K of them, the images.
        Ts_world_camera: (K, 4, 4).
        point_ids: (M,) landmarks that are seen.
        points_world: (M, 3).
        errors_px: (M,) mean reprojection errors; -1 where all images that see one are before it.
        obs_image, obs_keypoint, obs_point: (N,) which image sees which point at which feature, in
            this order; no feature has two points.
    """

    camera: Camera
    keyframes: tuple[Keyframe, ...]
    Ts_world_camera: Array
    point_ids: Index
    points_world: Array
    errors_px: Array
    obs_image: Index
    obs_keypoint: Index
    obs_point: Index


def write_colmap(folder: str | Path, map: Map, camera: Camera, T_body_camera: Array) -> ColmapModel:
    """Write cameras.txt, images.txt and points3D.txt, each whole or not at all.

    Args:
        folder: where to; it must exist.
        map: what is remembered.
        camera: the ideal pinhole that its features are in.
        T_body_camera: (4, 4) its mount.

    Returns:
        What was written.

    Raises:
        InputError: the camera has distortion, or the map no keyframe.
        OutputError: a file cannot be written.

    Example:
        >>> write_colmap("model", map, eye.camera, eye.T_body_camera)  # doctest: +SKIP
    """
    if camera.model != "pinhole" or np.any(camera.distortion):
        raise InputError("COLMAP: give the ideal pinhole that the features are in, without a lens")
    model = colmap_model(map, camera, T_body_camera)
    parts = {
        "cameras.txt": _camera_lines(model.camera),
        "images.txt": _image_lines(model),
        "points3D.txt": _point_lines(model),
    }
    for name, lines in parts.items():
        with atomic_text(Path(folder) / name) as file:
            file.writelines(f"{line}\n" for line in lines)
    return model


def colmap_model(map: Map, camera: Camera, T_body_camera: Array) -> ColmapModel:
    """Read off a map what COLMAP asks for.

    Args:
        map, camera, T_body_camera: see `write_colmap`.

    Raises:
        InputError: the map has no keyframe.
    """
    with map.lock:
        ids = map.keyframe_ids
        if not len(ids):
            raise InputError("the map is empty: there is nothing to export")
        keyframes = tuple(map.keyframe(k) for k in ids.tolist())
        Ts, scales = map.Ts_world_body(ids), np.array([map.scale(k) for k in ids.tolist()])
        obs_image, obs_keypoint, landmarks = _observations(map, keyframes)
        point_ids, obs_point = np.unique(landmarks, return_inverse=True)
        points = map.points_world(point_ids)
    placements = compose((Ts, scales), (np.asarray(T_body_camera), np.ones(len(ids))))
    errors = np.zeros(len(obs_image))
    ends = np.searchsorted(obs_image, np.arange(len(ids) + 1))
    for k, keyframe in enumerate(keyframes):
        rows, at = slice(ends[k], ends[k + 1]), keyframe.features
        if at is not None:
            ahead = act_inverse((placements[0][k], placements[1][k]), points[obs_point[rows]])
            gap = camera.project(ahead) - at.keypoints[obs_keypoint[rows]]
            errors[rows] = np.linalg.norm(gap, axis=1)
    return ColmapModel(
        camera,
        keyframes,
        placements[0],
        point_ids,
        points,
        _means(obs_point, errors, len(point_ids)),
        obs_image,
        obs_keypoint,
        obs_point,
    )


def _observations(map: Map, keyframes: tuple[Keyframe, ...]) -> tuple[Index, Index, Index]:
    """Return image, feature and landmark of all observations at features, in this order.

    Of several landmarks at one feature, which fusing may leave for a while, the oldest has it.
    """
    rows = [np.empty((3, 0), np.int64)]
    for k, keyframe in enumerate(keyframes):
        if keyframe.features is not None:
            ids, keypoints = map.observations_of(keyframe.id)
            rows.append(np.stack([np.full(len(ids), k), keypoints, ids]))
    table = np.concatenate(rows, axis=1)
    table = table[:, table[1] >= 0]
    table = table[:, np.lexsort(table[::-1])]
    again = np.zeros(table.shape[1], np.bool_)
    again[1:] = (table[:2, 1:] == table[:2, :-1]).all(axis=0)
    image, keypoint, landmark = np.ascontiguousarray(table[:, ~again])
    return image, keypoint, landmark


def _means(rows: Index, values: Array, count: int) -> Array:
    """Return the means of finite values by row, -1 where there is none."""
    known = np.isfinite(values)
    number = np.bincount(rows[known], minlength=count)
    total = np.bincount(rows[known], values[known], minlength=count)
    return np.where(number > 0, total / np.maximum(number, 1), -1.0)


def _camera_lines(camera: Camera) -> Iterator[str]:
    yield "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"
    numbers = (camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5)
    yield f"1 PINHOLE {camera.width} {camera.height} {_text(numbers)}"


def _image_lines(model: ColmapModel) -> Iterator[str]:
    yield "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME"
    yield "# POINTS2D[] as (X, Y, POINT3D_ID)"
    R_camera_world = np.swapaxes(model.Ts_world_camera[:, :3, :3], 1, 2)
    t = -(R_camera_world @ model.Ts_world_camera[:, :3, 3:])[:, :, 0]
    q = quaternion_from_rotation(R_camera_world)
    ends = np.searchsorted(model.obs_image, np.arange(len(model.keyframes) + 1))
    for k, name in enumerate(_names(model.keyframes)):
        keyframe, rows = model.keyframes[k], slice(ends[k], ends[k + 1])
        pose = _text((*q[k].tolist(), *t[k].tolist()))
        yield f"{keyframe.id + 1} {pose} 1 {name}"
        if keyframe.features is None:
            yield ""
            continue
        pixels = keyframe.features.keypoints.astype(np.float64) + 0.5
        ids = np.full(len(pixels), -1)
        ids[model.obs_keypoint[rows]] = model.point_ids[model.obs_point[rows]] + 1
        yield " ".join(f"{x:.9g} {y:.9g} {i}" for (x, y), i in zip(pixels.tolist(), ids.tolist()))


def _point_lines(model: ColmapModel) -> Iterator[str]:
    yield "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"
    order = np.argsort(model.obs_point, kind="stable")
    ends = np.searchsorted(model.obs_point[order], np.arange(len(model.point_ids) + 1))
    image_ids = np.array([k.id + 1 for k in model.keyframes])[model.obs_image[order]].tolist()
    keypoints = model.obs_keypoint[order].tolist()
    for m, point_id in enumerate(model.point_ids.tolist()):
        track = range(ends[m], ends[m + 1])
        seen = " ".join(f"{image_ids[n]} {keypoints[n]}" for n in track)
        place = _text(model.points_world[m].tolist())
        yield f"{point_id + 1} {place} {GREY} {float(model.errors_px[m])!r} {seen}"


def _names(keyframes: tuple[Keyframe, ...]) -> Iterator[str]:
    """Yield the images' names; where two recordings have one stamp, the later ones with the id."""
    known: set[int] = set()
    for keyframe in keyframes:
        again = f"_{keyframe.id}" if keyframe.stamp_ns in known else ""
        known.add(keyframe.stamp_ns)
        yield f"{keyframe.stamp_ns}{again}.png"


def _text(numbers: tuple[float, ...] | list[float]) -> str:
    return " ".join(repr(float(number)) for number in numbers)
