"""Small bags of every kind, written by rosbags: a robot that drives along x with a laser on it."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

START_NS = 1_700_000_000_123_456_789
STEP_NS = 100_000_000
SCANS = 8
BEAMS = 91


@dataclass
class Robot:
    """What a test robot publishes.

    Attributes:
        scans: topics of its lasers, and the frame each is in.
        odometry: topic, or nothing.
        tf: "static" (tf_static), "sent" (fixed ones again and again), or nothing.
        moves: whether tf has odom -> base_link.
        stamps: of the scans; default evenly spaced.
        strange: whether a topic has a type nobody knows.
        changes: of scans: number -> fields that differ.
        clouds: topics of its 3D LiDARs, and the frame each is in.
        cloud: fields of the PointCloud2 of a number, without its header.
    """

    scans: dict[str, str] = field(default_factory=lambda: {"/scan": "laser"})
    odometry: str = "/odom"
    tf: str = "static"
    moves: bool = False
    stamps: list[int] = field(
        default_factory=lambda: [START_NS + k * STEP_NS for k in range(SCANS)]
    )
    strange: bool = False
    changes: dict[int, dict[str, Any]] = field(default_factory=dict)
    clouds: dict[str, str] = field(default_factory=dict)
    cloud: Callable[[int], dict[str, Any]] = lambda k: {}


def messages(robot: Robot, store: Any) -> Iterator[tuple[str, str, int, Any]]:
    """Yield topic, type, time and message."""
    types = store.types

    def header(stamp: int, frame: str) -> Any:
        time = types["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9)
        named = {"stamp": time, "frame_id": frame}
        if "seq" in types["std_msgs/msg/Header"].__dataclass_fields__:
            named["seq"] = 0
        return types["std_msgs/msg/Header"](**named)

    def vector(x: float, y: float = 0.0, z: float = 0.0, kind: str = "Vector3") -> Any:
        return types[f"geometry_msgs/msg/{kind}"](x, y, z)

    def turn(angle: float = 0.0) -> Any:
        quaternion = types["geometry_msgs/msg/Quaternion"]
        return quaternion(0.0, 0.0, float(np.sin(angle / 2)), float(np.cos(angle / 2)))

    def transform(stamp: int, parent: str, child: str, x: float, angle: float = 0.0) -> Any:
        between = types["geometry_msgs/msg/Transform"](vector(x), turn(angle))
        stamped = types["geometry_msgs/msg/TransformStamped"]
        return stamped(header(stamp, parent), child, between)

    fixed = [
        transform(START_NS, "base_link", "mast", 0.2),
        transform(START_NS, "mast", "laser", 0.1, np.pi / 2),
        transform(START_NS, "base_link", "rear", -0.4, np.pi),
    ]
    if robot.tf == "static":
        kind = "tf2_msgs/msg/TFMessage"
        yield "/tf_static", kind, START_NS - STEP_NS, types[kind](fixed)
    for k in range(-1, 2 * len(robot.stamps) + 1):
        now = START_NS + k * STEP_NS // 2 - 7_000_000
        sent = [*fixed] if robot.tf == "sent" else []
        if robot.moves:
            sent.append(transform(now, "odom", "base_link", 0.05 * k))
        if sent:
            yield "/tf", "tf2_msgs/msg/TFMessage", now, types["tf2_msgs/msg/TFMessage"](sent)
        if robot.odometry:
            pose = types["geometry_msgs/msg/Pose"](vector(0.05 * k, kind="Point"), turn())
            wide = np.zeros(36)
            twist = types["geometry_msgs/msg/Twist"](vector(0.5), vector(0.0))
            odometry = types["nav_msgs/msg/Odometry"](
                header(now, "odom"), "base_link",
                types["geometry_msgs/msg/PoseWithCovariance"](pose, wide),
                types["geometry_msgs/msg/TwistWithCovariance"](twist, wide),
            )  # fmt: skip
            yield robot.odometry, "nav_msgs/msg/Odometry", now, odometry
        if k >= 0 and k % 2 == 0 and k // 2 < len(robot.stamps):
            for topic, frame in robot.scans.items():
                yield from _scan(robot, types, header, topic, frame, k // 2)
            for topic, frame in robot.clouds.items():
                yield from _cloud(robot, types, header, topic, frame, k // 2)
        if robot.strange:
            yield "/strange", "std_msgs/msg/Float64", now, types["std_msgs/msg/Float64"](1.0)


def _scan(
    robot: Robot, types: Any, header: Any, topic: str, frame: str, k: int
) -> Iterator[tuple[str, str, int, Any]]:
    ranges = np.linspace(1.0, 9.0, BEAMS, dtype=np.float32) + np.float32(0.01 * k)
    ranges[:6] = [0.0, 0.05, np.nan, -np.inf, np.inf, 12.0]
    fields = {
        "header": header(robot.stamps[k], frame),
        "angle_min": -0.9,
        "angle_max": 0.9,
        "angle_increment": 0.02,
        "time_increment": 0.0004,
        "scan_time": 0.1,
        "range_min": 0.1,
        "range_max": 10.0,
        "ranges": ranges,
        "intensities": np.zeros(0, np.float32),
    } | robot.changes.get(k, {})
    kind = "sensor_msgs/msg/LaserScan"
    yield topic, kind, START_NS + k * STEP_NS + 3_000_000, types[kind](**fields)


def _cloud(
    robot: Robot, types: Any, header: Any, topic: str, frame: str, k: int
) -> Iterator[tuple[str, str, int, Any]]:
    fields = robot.cloud(k)
    one = types["sensor_msgs/msg/PointField"]
    fields["fields"] = [one(*words) for words in fields["fields"]]
    kind = "sensor_msgs/msg/PointCloud2"
    message = types[kind](header(robot.stamps[k], frame), **fields)
    yield topic, kind, START_NS + k * STEP_NS + 3_000_000, message


KINDS = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}


def cloud_fields(
    columns: dict[str, Any], big: bool = False, gap: int = 3, height: int = 1, line_gap: int = 0
) -> dict[str, Any]:
    """Return the fields of a PointCloud2 without its header.

    Args:
        columns: (N,) each.
        big: whether the highest byte comes first.
        gap: bytes behind each value that mean nothing.
        height: rows of the cloud.
        line_gap: bytes behind each row that mean nothing.
    """
    fields, at = [], 0
    for name, column in columns.items():
        fields.append((name, at, KINDS[column.dtype.str[1:]], 1))
        at += column.dtype.itemsize + gap
    order = ">" if big else "<"
    row = np.dtype({
        "names": list(columns), "formats": [order + c.dtype.str[1:] for c in columns.values()],
        "offsets": [f[1] for f in fields], "itemsize": at,
    })  # fmt: skip
    count = len(next(iter(columns.values())))
    rows = np.zeros(count, row)
    for name, column in columns.items():
        rows[name] = column
    lines = np.frombuffer(rows.tobytes(), np.uint8).reshape(height, -1)
    data = np.pad(lines, ((0, 0), (0, line_gap)), constant_values=255).reshape(-1)
    return {
        "height": height, "width": count // height, "fields": fields, "is_bigendian": big,
        "point_step": at, "row_step": lines.shape[1] + line_gap, "data": data, "is_dense": False,
    }  # fmt: skip


def write_bag(path: Path, kind: str, robot: Robot | None = None) -> Path:
    """Write a bag of a kind: "ros1", "ros1-bz2", "ros1-lz4", "sqlite3", "mcap", "mcap-zstd"."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    robot = robot or Robot()
    is_old = kind.startswith("ros1")
    store = get_typestore(Stores.ROS1_NOETIC if is_old else Stores.ROS2_HUMBLE)
    if "tf2_msgs/msg/TFMessage" not in store.types:
        definition = "geometry_msgs/TransformStamped[] transforms"
        store.register(get_types_from_msg(definition, "tf2_msgs/msg/TFMessage"))
    writer: Any
    if is_old:
        writer = Writer1(path)
        if "-" in kind:
            writer.set_compression(Writer1.CompressionFormat[kind.partition("-")[2].upper()])
    else:
        storage = StoragePlugin.SQLITE3 if kind == "sqlite3" else StoragePlugin.MCAP
        writer = Writer2(path, version=9, storage_plugin=storage)
        if kind.endswith("zstd"):
            writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    connections: dict[str, Any] = {}
    with writer:
        for topic, name, time_ns, message in messages(robot, store):
            if topic not in connections:
                if topic == "/strange":
                    told: dict[str, Any] = {"msgdef": "float64 data\n"}
                    told |= {"md5sum": "0" * 32} if is_old else {"rihs01": "RIHS01_" + "0" * 64}
                    added = writer.add_connection(topic, "acme_msgs/msg/Warp", **told)
                else:
                    added = writer.add_connection(topic, name, typestore=store)
                connections[topic] = added
            turn = store.serialize_ros1 if is_old else store.serialize_cdr
            writer.write(connections[topic], time_ns, bytes(turn(message, name)))
    return path
