"""Bags of ROS without ROS: messages of ROS 1 bags, ROS 2 bags (sqlite3, MCAP) and MCAP files.

The `rosbags` library reads them (extra `ros`). A file without an index, or one that was cut, is
read record by record instead (`bagrecords`), and what comes before the damage is given.

Only messages of known types are decoded, by the definitions of the ROS releases and not by those
in the file, so that a type nobody knows, or one whose definition is broken, costs nothing.
"""

import struct
import weakref
from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, cast

from odomap.errors import InputError, MissingExtra
from odomap.sources.bagrecords import (
    MCAP_MAGIC,
    ROS1_MAGIC,
    SQLITE_MAGIC,
    Cut,
    Record,
    records,
)

__all__ = ["CLOUD", "SCAN", "BagFile", "Head", "Topic", "is_bag"]

SUFFIXES = (".bag", ".mcap", ".db3")
SCAN, CLOUD = "sensor_msgs/msg/LaserScan", "sensor_msgs/msg/PointCloud2"
KNOWN = {
    SCAN: SCAN,
    CLOUD: CLOUD,
    "nav_msgs/msg/Odometry": "nav_msgs/msg/Odometry",
    "tf2_msgs/msg/TFMessage": "tf2_msgs/msg/TFMessage",
    "tf/msg/tfMessage": "tf2_msgs/msg/TFMessage",
}
"""Types that are decoded, and what they are decoded as."""
TRANSFORMS = "geometry_msgs/TransformStamped[] transforms"
"""Definition of a TFMessage, which not every release has among its own."""


@dataclass(frozen=True)
class Topic:
    """A topic of a bag: its name, type, and how many messages it has."""

    name: str
    kind: str
    count: int


@dataclass(frozen=True)
class Head:
    """When and in which frame a message was measured; nothing else of it."""

    stamp_ns: int
    frame: str


def is_bag(path: Path) -> bool:
    """Tell whether a file or a folder is a bag, by its first bytes or by its metadata."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file() or bool(_parts(path))
    if not path.is_file():
        return False
    with path.open("rb") as file:
        start = file.read(16)
    return start.startswith((ROS1_MAGIC, MCAP_MAGIC, SQLITE_MAGIC)) or (
        path.suffix.lower() in SUFFIXES
    )


def _parts(folder: Path) -> list[Path]:
    return sorted(p for p in folder.iterdir() if p.suffix in (".mcap", ".db3") and p.is_file())


class BagFile:
    """The messages of a bag.

    Attributes:
        path: file or folder that is read.
        given: file or folder that was asked for.
        topics: what is in it, by name.
        notes: what is odd about it.
        is_indexed: whether messages of a time can be found without reading all before.
    """

    def __init__(self, path: Path) -> None:
        """Open a bag.

        Raises:
            MissingExtra: rosbags is not installed.
            InputError: it is no bag, or nothing of it can be read.
        """
        try:
            from rosbags.typesys import Stores, get_types_from_msg, get_typestore
        except ImportError as error:
            raise MissingExtra(f"{path}: a bag needs rosbags: pip install 'odomap[ros]'") from error
        self.path = self.given = path
        self.notes: list[str] = []
        self._stores = {
            "ros1": get_typestore(Stores.ROS1_NOETIC),
            "cdr": get_typestore(Stores.ROS2_HUMBLE),
        }
        transforms = get_types_from_msg(TRANSFORMS, "tf2_msgs/msg/TFMessage")
        for store in self._stores.values():
            if not transforms.keys() & store.fielddefs.keys():
                store.register(transforms)
        self._reader: Any = None
        self.is_indexed = True
        reason = self._open()
        if reason:
            self.is_indexed = False
            self.topics = self._counted(reason)

    def _open(self) -> str:
        """Open the file with the library; return why that cannot be, or nothing."""
        from rosbags.rosbag1 import Reader as Reader1
        from rosbags.rosbag2 import Reader as Reader2

        whole = self.path
        if whole.is_dir() and not (whole / "metadata.yaml").is_file():
            parts = _parts(whole)
            self.notes.append(f"metadata.yaml is missing: {parts[0].name} is read alone")
            self.path = whole = parts[0]
        try:
            if whole.is_file() and _starts(whole, ROS1_MAGIC):
                self._reader = Reader1(whole)
            else:
                self._reader = Reader2(whole)
            self._reader.open()
            weakref.finalize(self, self._reader.close)
            connections = self._reader.connections
        # A damaged file fails anywhere in the library, as anything; it is read otherwise.
        except Exception as error:
            return " ".join(str(error).split()) or type(error).__name__
        counts: dict[tuple[str, str], int] = {}
        for item in connections:
            key = item.topic, item.msgtype
            counts[key] = counts.get(key, 0) + int(item.msgcount)
        self.topics = [Topic(*key, count) for key, count in sorted(counts.items())]
        return ""

    def _counted(self, reason: str) -> list[Topic]:
        """Count messages record by record, and say what is the matter."""
        counts: dict[tuple[str, str], int] = {}
        end = ""
        try:
            for record in self._records():
                key = record.topic, record.kind
                counts[key] = counts.get(key, 0) + 1
        except Cut as error:
            end = f", {error}"
        if not counts:
            raise InputError(f"{self.path}: cannot be read: {reason}{end}")
        self.notes.append(
            f"has no index that can be used ({reason.rstrip('.')}{end}): "
            f"{sum(counts.values())} messages were found one by one"
        )
        return [Topic(*key, count) for key, count in sorted(counts.items())]

    def _records(self) -> Iterator[Record]:
        files = _parts(self.path) if self.path.is_dir() else [self.path]
        for file in files:
            yield from records(file, _unpackers())

    def messages(
        self, topics: Collection[str], at_ns: int | None = None, heads: Collection[str] = ()
    ) -> Iterator[tuple[str, int, Any]]:
        """Yield topic, time of recording in ns, and message, of known types.

        Args:
            topics: names of those wanted.
            at_ns: only messages recorded then.
            heads: topics of which only the header is read, as a `Head`.

        Raises:
            Cut: after the last message that can be read, if the file is damaged there.
        """
        stop = None if at_ns is None else at_ns + 1
        for topic, kind, encoding, time_ns, data in self._raw(topics, at_ns, stop):
            store = self._stores.get(encoding)
            if store is None or kind not in KNOWN:
                continue
            read = store.deserialize_ros1 if encoding == "ros1" else store.deserialize_cdr
            try:
                message = _head(data, encoding) if topic in heads else read(data, KNOWN[kind])
            # The bytes of one message are not what its type says; that fails as anything.
            except Exception as error:
                raise Cut(f"a message of {topic} cannot be decoded ({error})") from error
            yield topic, time_ns, message

    def _raw(
        self, topics: Collection[str], start: int | None, stop: int | None
    ) -> Iterator[tuple[str, str, str, int, bytes]]:
        if not self.is_indexed:
            for r in self._records():
                if r.topic in topics and (start is None or start <= r.time_ns < cast(int, stop)):
                    yield r.topic, r.kind, r.encoding, r.time_ns, r.data
            return
        wanted = [c for c in self._reader.connections if c.topic in topics]
        encoding = "ros1" if type(self._reader).__module__.startswith("rosbags.rosbag1") else "cdr"
        if not wanted:
            return
        found = self._reader.messages(connections=wanted, start=start, stop=stop)
        while True:
            try:
                connection, time_ns, data = next(found)
            except StopIteration:
                return
            except Exception as error:
                raise Cut(f"is damaged ({' '.join(str(error).split())})") from error
            yield connection.topic, connection.msgtype, encoding, int(time_ns), bytes(data)


def _head(data: bytes, encoding: str) -> Head:
    """Read the header that a message begins with."""
    if encoding == "ros1":
        _, seconds, rest, length = struct.unpack_from("<4I", data)
        name = data[16 : 16 + length]
    else:
        order = "<" if data[1] & 1 else ">"
        seconds, rest, length = struct.unpack_from(f"{order}iII", data, 4)
        name = data[16 : 16 + length].rstrip(b"\0")
    return Head(seconds * 10**9 + rest, name.decode())


def _unpackers() -> dict[str, Callable[[bytes], bytes]]:
    """Return how to unpack chunks, with what rosbags brings along."""
    found: dict[str, Callable[[bytes], bytes]] = {}
    for name, module in (
        ("lz4", "lz4.frame"),
        ("zstd", "zstandard"),
        ("zstd", "backports.zstd"),
        ("zstd", "compression.zstd"),
    ):
        with suppress(ImportError):
            found[name] = import_module(module).decompress
    return found


def _starts(path: Path, magic: bytes) -> bool:
    with path.open("rb") as file:
        return file.read(len(magic)) == magic
