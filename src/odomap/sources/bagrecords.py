"""Records of bags in the order they were written, with or without an index.

ROS 1 bags and MCAP files are sequences of records, most of them in compressed chunks, and an index
behind them. A recorder that is stopped hard writes no index, and a copy that is cut loses it; what
was written before is whole. Here records are read one after the other until the file ends:

    ROS 1    u32 length, header ("op=…", "conn=…", "time=…"), u32 length, data
    MCAP     u8 op, u64 length, data

The database of a ROS 2 bag is read row by row until one cannot be.

Cost: O(size of the file); one chunk is in memory.

Reference: S. Macenski et al., "Robot Operating System 2", Science Robotics 7(66), 2022.
"""

import bz2
import sqlite3
import struct
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

__all__ = ["MCAP_MAGIC", "ROS1_MAGIC", "SQLITE_MAGIC", "Cut", "Record", "records"]

ROS1_MAGIC = b"#ROSBAG V2.0\n"
MCAP_MAGIC = b"\x89MCAP0\r\n"
SQLITE_MAGIC = b"SQLite format 3\0"
LARGE = 1 << 20
"""Bytes from which on a record is looked for in the file before it is read."""

Unpack = Callable[[bytes], bytes]


class Cut(Exception):
    """A file ends within a record, or goes on with something else."""


@dataclass(frozen=True)
class Record:
    """A message as it stands in the file.

    Attributes:
        topic: where it was published.
        kind: its type, as ROS 2 names it ("sensor_msgs/msg/LaserScan").
        encoding: "ros1" or "cdr" (or what else an MCAP file says).
        time_ns: when it was recorded.
        data: the message.
    """

    topic: str
    kind: str
    encoding: str
    time_ns: int
    data: bytes


def records(path: Path, unpack: dict[str, Unpack]) -> Iterator[Record]:
    """Yield the messages of a file until it ends.

    Args:
        path: a ROS 1 bag, an MCAP file, or the database of a ROS 2 bag.
        unpack: how to decompress a chunk, by the name of its compression.

    Raises:
        Cut: after the last message that is whole, if the file does not end as it should.
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        magic = file.read(len(ROS1_MAGIC))
        if magic == ROS1_MAGIC:
            yield from _ros1(file, {}, {"none": _as_is, "bz2": bz2.decompress, **unpack})
        elif magic.startswith(MCAP_MAGIC):
            file.seek(len(MCAP_MAGIC))
            yield from _mcap(file, {}, {}, {"": _as_is, **unpack})
        elif SQLITE_MAGIC.startswith(magic) and magic:
            yield from _sqlite(path)
        else:
            raise Cut(
                "is empty"
                if not magic
                else "begins neither as a ROS 1 bag nor as an MCAP file or a database"
            )


def _as_is(data: bytes) -> bytes:
    return data


def _exactly(file: BinaryIO, count: int) -> bytes:
    if count > LARGE:  # before so much memory is asked for
        here = file.tell()
        if count > file.seek(0, 2) - here:
            raise Cut("ends within a record")
        file.seek(here)
    data = file.read(count)
    if len(data) != count:
        raise Cut("ends within a record")
    return data


def _number(file: BinaryIO, form: str) -> int:
    return int(struct.unpack(form, _exactly(file, struct.calcsize(form)))[0])


def _ros1(
    file: BinaryIO, connections: dict[int, tuple[str, str]], unpack: dict[str, Unpack]
) -> Iterator[Record]:
    """Yield the messages of a ROS 1 bag, or of a chunk of one."""
    while start := file.read(4):
        if len(start) < 4:
            raise Cut("ends within a record")
        header = _fields(_exactly(file, struct.unpack("<I", start)[0]))
        data = _exactly(file, _number(file, "<I"))
        try:
            op = header["op"][0]
            if op == 5:
                inside = _unpacked(unpack, header["compression"].decode(), data)
                yield from _ros1(BytesIO(inside), connections, unpack)
            elif op == 7:
                kind = _fields(data)["type"].decode().replace("/", "/msg/", 1)
                connection = struct.unpack("<I", header["conn"])[0]
                connections[connection] = header["topic"].decode(), kind
            elif op == 2:
                seconds, rest = struct.unpack("<II", header["time"])
                topic, kind = connections[struct.unpack("<I", header["conn"])[0]]
                yield Record(topic, kind, "ros1", seconds * 10**9 + rest, data)
        except (KeyError, IndexError, UnicodeDecodeError, struct.error) as error:
            raise Cut(f"a record cannot be read ({type(error).__name__} {error})") from error


def _fields(data: bytes) -> dict[str, bytes]:
    """Return the fields of a header, name=value each."""
    file, fields = BytesIO(data), {}
    while file.tell() < len(data):
        name, _, value = _exactly(file, _number(file, "<I")).partition(b"=")
        fields[name.decode("ascii", "replace")] = value
    return fields


def _mcap(
    file: BinaryIO, schemas: dict[int, str], channels: dict[int, tuple[str, str, str]],
    unpack: dict[str, Unpack],
) -> Iterator[Record]:  # fmt: skip
    """Yield the messages of an MCAP file behind its magic, or of a chunk of one."""
    while op := file.read(1):
        if op == MCAP_MAGIC[:1]:
            return  # the magic that ends a file
        data = BytesIO(_exactly(file, _number(file, "<Q")))
        try:
            if op == b"\x03":
                number = _number(data, "<H")
                schemas[number] = _text(data)
            elif op == b"\x04":
                number, schema = _number(data, "<H"), _number(data, "<H")
                topic, encoding = _text(data), _text(data)
                kind = schemas.get(schema, "")
                kind = kind if "/msg/" in kind else kind.replace("/", "/msg/", 1)
                channels[number] = topic, kind, encoding
            elif op == b"\x05":
                topic, kind, encoding = channels[_number(data, "<H")]
                _, time_ns, _ = struct.unpack("<IQQ", _exactly(data, 20))
                yield Record(topic, kind, encoding, time_ns, data.read())
            elif op == b"\x06":
                data.seek(28)
                name = _text(data)
                inside = _unpacked(unpack, name, _exactly(data, _number(data, "<Q")))
                yield from _mcap(BytesIO(inside), schemas, channels, unpack)
        except (KeyError, UnicodeDecodeError, struct.error) as error:
            raise Cut(f"a record cannot be read ({type(error).__name__} {error})") from error


def _sqlite(path: Path) -> Iterator[Record]:
    """Yield the messages of a ROS 2 database, row by row."""
    try:
        place = f"{path.absolute().as_uri()}?mode=ro&immutable=1"
        with closing(sqlite3.connect(place, uri=True)) as base:
            found = base.execute("SELECT id, name, type, serialization_format FROM topics")
            topics = {row[0]: (str(row[1]), str(row[2]), str(row[3])) for row in found}
            for topic, time_ns, data in base.execute(
                "SELECT topic_id, timestamp, data FROM messages ORDER BY id"
            ):
                if topic in topics:
                    name, kind, encoding = topics[topic]
                    yield Record(name, kind, encoding, int(time_ns), bytes(data))
    except (sqlite3.Error, TypeError, ValueError) as error:
        raise Cut(" ".join(str(error).split())) from error


def _text(file: BinaryIO) -> str:
    return _exactly(file, _number(file, "<I")).decode()


def _unpacked(unpack: dict[str, Unpack], name: str, data: bytes) -> bytes:
    if name not in unpack:
        raise Cut(f"a chunk is packed by '{name}', which is not known")
    try:
        return unpack[name](data)
    # Each library that unpacks has errors of its own.
    except Exception as error:
        raise Cut(f"a chunk cannot be unpacked ({error})") from error
