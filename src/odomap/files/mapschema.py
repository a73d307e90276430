"""What a map file holds: every array with its type and shape.

A shape names its lengths by letters, and a letter means the same number wherever it stands:

    K  keyframe ids, culled and never used ones included    M  landmarks     S  slots free again
    F  landmarks fused into others       R  observations    E  edges

Payloads are packed: the rows of all keyframes that have one, one after the other, beside a table
(keyframe, rows, width, checksum). N counts those keyframes, P their rows, Q their bytes or numbers
where rows have a width of their own. A file of version 1 has no `landmarks/expected`: it is read as
`landmarks/seen`. Before version 3 there was no `states/growths`: none is known. See docs/formats.md
for what each array means.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

__all__ = ["ARRAYS", "PAYLOADS", "PAYLOAD_TABLE", "Array", "Column", "Declared"]


@dataclass(frozen=True)
class Array:
    """Type and shape of an array as it should be; lengths are letters or numbers.

    Attributes:
        kind: type.
        shape: lengths.
        since: first version of the format that has it.
    """

    kind: str
    shape: tuple[str | int, ...]
    since: int = 1


@dataclass(frozen=True)
class Declared:
    """Type and shape of an array as it is, and its checksum."""

    kind: str
    shape: tuple[int, ...]
    crc32: int


@dataclass(frozen=True)
class Column:
    """A packed column of a payload.

    Attributes:
        name: of the field of the payload.
        kind: type.
        tail: shape of a row; None where each keyframe has rows of a width of its own.
    """

    name: str
    kind: str
    tail: tuple[int, ...] | None = ()

    @property
    def array(self) -> Array:
        """Type and shape of the packed array."""
        return Array(self.kind, ("Q",) if self.tail is None else ("P", *self.tail))


ARRAYS: Mapping[str, Array] = MappingProxyType(
    {
        "keyframes/stamp_ns": Array("<i8", ("K",)),
        "states/Ts_world_body": Array("<f8", ("K", 4, 4)),
        "states/scales": Array("<f8", ("K",)),
        "states/v_world_body": Array("<f8", ("K", 3)),
        "states/biases": Array("<f8", ("K", 6)),
        "states/covariances": Array("<f8", ("K", 6, 6)),
        "states/growths": Array("<f8", ("K", 6, 6), since=3),
        "tree/status": Array("|u1", ("K",)),
        "tree/parent": Array("<i8", ("K",)),
        "tree/created": Array("<i8", ("K",)),
        "tree/Ts_parent_self": Array("<f8", ("K", 4, 4)),
        "tree/scales_parent_self": Array("<f8", ("K",)),
        "landmarks/slot": Array("<i8", ("M",)),
        "landmarks/id": Array("<i8", ("M",)),
        "landmarks/anchor": Array("<i4", ("M",)),
        "landmarks/p_anchor": Array("<f8", ("M", 3)),
        "landmarks/descriptor": Array("|u1", ("M", 32)),
        "landmarks/seen": Array("<i4", ("M",)),
        "landmarks/expected": Array("<i4", ("M",), since=2),
        "landmarks/free": Array("<i8", ("S",)),
        "landmarks/fused": Array("<i8", ("F",)),
        "landmarks/survivor": Array("<i8", ("F",)),
        "observations/keyframe": Array("<i4", ("R",)),
        "observations/landmark": Array("<i8", ("R",)),
        "observations/keypoint": Array("<i4", ("R",)),
        "observations/by_landmark": Array("<i4", ("R",)),
        "edges/i": Array("<i8", ("E",)),
        "edges/j": Array("<i8", ("E",)),
        "edges/Ts_i_j": Array("<f8", ("E", 4, 4)),
        "edges/scales_i_j": Array("<f8", ("E",)),
        "edges/information": Array("<f8", ("E", 6, 6)),
        "edges/kind": Array("<i4", ("E",)),
    }
)
"""Arrays that every map file of the newest version has."""

PAYLOAD_TABLE: Mapping[str, Array] = MappingProxyType(
    {
        "keyframe": Array("<i8", ("N",)),
        "rows": Array("<i8", ("N",)),
        "width": Array("<i8", ("N",)),
        "crc32": Array("<u4", ("N",)),
    }
)
"""Which keyframes have a payload, and how many rows of which width."""

PAYLOADS: Mapping[str, tuple[Column, ...]] = MappingProxyType(
    {
        "features": (
            Column("keypoints", "<f4", (2,)),
            Column("descriptors", "|u1", None),
            Column("bearings", "<f8", (3,)),
            Column("depth", "<f8"),
            Column("level", "|u1"),
        ),
        "scan": (Column("ranges", "<f8"),),
        "cloud": (Column("points", "<f4", None),),
        "imu": (
            Column("stamps_ns", "<i8"),
            Column("gyro", "<f8", (3,)),
            Column("accel", "<f8", (3,)),
        ),
    }
)
"""Payloads of keyframes; a file has those that any keyframe has."""
