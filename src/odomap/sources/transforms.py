"""The tree of frames of a robot: which are fixed to each other, and where the wheels say it is.

A bag holds transforms T_parent_child by name, those that never change (tf_static) beside those that
do (tf); some robots send fixed ones again and again among the latter. A pair is fixed if it was
sent as static or never changed. The mount of a sensor is the product of fixed transforms along the
way from the body to it, forwards or backwards:

    T_body_lidar = T_body_a T_a_b ... T_z_lidar

Cost: O(transforms) to read, O(frames) to look up.

Reference: T. Foote, "tf: the transform library", IEEE Conference on Technologies for Practical
Robot Applications 2013.
"""

from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.lie import se3_inverse
from odomap.geometry.so3 import rotation_from_quaternion

__all__ = ["FrameTree", "pose_of", "tidy"]

Array = NDArray[np.float64]
Pair = tuple[str, str]

SAME = 1e-6
"""Two transforms that differ by less are one (metres, and elements of rotations)."""
FARTHEST_M = 1e9
"""Farther from its origin no robot is."""
ODOM = "odom"
"""The frame in which wheels count, by REP-105."""


def tidy(frame: str) -> str:
    """Return the name of a frame without the slash that old ones begin with."""
    return frame.strip("/")


def pose_of(t: Any, q: Any) -> Array | None:
    """Return (4, 4) of a translation and a quaternion of ROS, None if they are no pose."""
    quaternion = np.array([q.w, q.x, q.y, q.z], np.float64)
    place = np.array([t.x, t.y, t.z], np.float64)
    # Bytes that were damaged give numbers too large to be squared.
    if not (np.all(np.abs(quaternion) < 2) and np.all(np.abs(place) < FARTHEST_M)):
        return None
    length = float(np.linalg.norm(quaternion))
    if abs(length - 1) >= 0.1:
        return None
    T = np.eye(4)
    T[:3, :3] = rotation_from_quaternion(quaternion / length)
    T[:3, 3] = place
    return T


class FrameTree:
    """Transforms between frames, collected message by message.

    Of those that change, only the ones out of a frame named "odom" are kept, 136 bytes each.
    """

    def __init__(self) -> None:
        self._first: dict[Pair, Array] = {}
        self._moving: set[Pair] = set()
        self._odometry: dict[str, tuple[list[int], list[Array]]] = {}

    def add(self, message: Any, is_static: bool) -> None:
        """Add the transforms of a message."""
        for item in message.transforms:
            T = pose_of(item.transform.translation, item.transform.rotation)
            parent, child = tidy(item.header.frame_id), tidy(item.child_frame_id)
            if T is None or not child:
                continue
            pair = parent, child
            first = self._first.setdefault(pair, T)
            if is_static:
                self._first[pair] = T
            elif first is not T and np.abs(first - T).max() > SAME:
                self._moving.add(pair)
            if parent == ODOM and not is_static:
                stamps, poses = self._odometry.setdefault(child, ([], []))
                stamps.append(item.header.stamp.sec * 10**9 + item.header.stamp.nanosec)
                poses.append(T)

    def wheels(self) -> tuple[str, list[int], list[Array]] | None:
        """Return the frame that moves in "odom", its stamps and its T_odom_body, or None."""
        if not self._odometry:
            return None
        body = max(self._odometry, key=lambda child: len(self._odometry[child][0]))
        return body, *self._odometry[body]

    def fixed(self, body: str, sensor: str) -> Array | None:
        """Return (4, 4) T_body_sensor along fixed transforms, None if no way leads there."""
        ways: dict[str, list[tuple[str, Array]]] = {}
        for (parent, child), T in self._first.items():
            if (parent, child) not in self._moving and parent != ODOM:
                ways.setdefault(parent, []).append((child, T))
                ways.setdefault(child, []).append((parent, se3_inverse(T)))
        found = {body: np.eye(4)}
        queue = deque([body])
        while queue and sensor not in found:
            at = queue.popleft()
            for frame, T in ways.get(at, []):
                if frame not in found:
                    found[frame] = found[at] @ T
                    queue.append(frame)
        return found.get(sensor)
