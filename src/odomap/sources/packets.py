"""Packets of a Velodyne LiDAR in a capture (pcap): where they stand, and to which turn they belong.

A capture is a row of records, each a frame of the network with its time; the LiDAR's are those of
1206 bytes over UDP: 12 blocks of 100 bytes, each with its azimuth, and at the end the sensor's own
clock in microseconds since the hour. Here packets are found and told apart, not decoded:

    a turn ends where the azimuth since behind falls back, or half a turn of time is missing,
    packets lost = Σ round(step of the clock / usual step) - 1.

The sensor's clock is even, that of the host is late by what the network took: stamps are the
sensor's, moved by the median of the difference. An hour's end is seen in a step back.

Cost: a microsecond a packet (750 a second for 16 beams); the file is mapped, not read into memory.

Reference: Velodyne LiDAR, "VLP-16 user manual", 63-9243 rev. D, 2016, chapter 9.
"""

import mmap
import struct
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError

__all__ = ["PACKET_BYTES", "Capture", "is_pcap", "read_capture", "turns_of"]

MAGICS = {
    b"\xd4\xc3\xb2\xa1": ("<", 1000), b"\xa1\xb2\xc3\xd4": (">", 1000),
    b"\x4d\x3c\xb2\xa1": ("<", 1), b"\xa1\xb2\x3c\x4d": (">", 1),
}  # fmt: skip
"""Order of bytes, and nanoseconds in the smaller unit of time."""
PCAPNG = b"\x0a\x0d\x0d\x0a"
LINKS = {0: 4, 1: 14, 101: 0, 113: 16, 228: 0}
"""Bytes before the internet header, by the kind of network."""
PACKET_BYTES, BLOCK = 1206, b"\xff\xee"
HOUR_US = 3_600_000_000
BEHIND = 18_000
"""Azimuth at which turns are cut, hundredths of a degree clockwise from ahead."""


@dataclass(frozen=True, eq=False)
class Capture:
    """The packets of one LiDAR.

    Attributes:
        path: the file.
        places: (N,) where each begins in it, bytes.
        host_ns: (N,) when each was captured.
        stamps_ns: (N,) when each was measured, by the sensor's clock.
        azimuths: (N,) of the first block, hundredths of a degree.
        lost: how many are missing between them.
        model: the byte that names the sensor; -1 where it varies, as that of an HDL-64E does.
        notes: what is odd about it.
    """

    path: Path
    places: NDArray[np.int64]
    host_ns: NDArray[np.int64]
    stamps_ns: NDArray[np.int64]
    azimuths: NDArray[np.int64]
    lost: int
    model: int
    notes: list[str]

    def packets(self, rows: NDArray[np.integer]) -> list[bytes]:
        """Read some packets.

        Raises:
            OSError: the file cannot be read.
        """
        with self.path.open("rb") as file:
            found = []
            for place in self.places[rows].tolist():
                file.seek(place)
                found.append(file.read(PACKET_BYTES))
        return found


def is_pcap(path: Path) -> bool:
    """Tell whether a file is a capture, by its first bytes."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        magic = file.read(4)
    return magic in MAGICS or magic == PCAPNG


def read_capture(path: Path) -> Capture:
    """Find the packets of the LiDAR in a capture; of several, of the one that sent most.

    Raises:
        InputError: it cannot be read, is of another format, or holds no packets of a LiDAR.
    """
    try:
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            return _indexed(path, data)
    except ValueError as error:  # nothing to map
        raise InputError(f"{path}: is empty: copy it again") from error
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from error


def _indexed(path: Path, data: mmap.mmap) -> Capture:
    magic = data[:4]
    if magic == PCAPNG:
        raise InputError(f"{path}: is pcapng: convert it by 'editcap -F pcap {path.name} out.pcap'")
    if magic not in MAGICS or len(data) < 24:
        raise InputError(f"{path}: is no capture (pcap)")
    order, unit_ns = MAGICS[magic]
    (link,) = struct.unpack_from(f"{order}I", data, 20)
    if link & 0xFFFF not in LINKS:
        raise InputError(f"{path}: is of a network of kind {link & 0xFFFF}, which is not known")
    head, size, at = struct.Struct(f"{order}4I"), len(data), 24
    rows: list[tuple[int, int, tuple[bytes, int]]] = []
    notes = []
    while at + 16 <= size:
        seconds, rest, length, _ = head.unpack_from(data, at)
        at += 16
        if at + length > size:
            notes.append("is cut within its last packet: what comes before is read")
            break
        found = _payload(data, at, length, LINKS[link & 0xFFFF])
        if found is not None:
            rows.append((seconds * 10**9 + rest * unit_ns, *found))
        at += length
    senders = Counter(sender for _, _, sender in rows)
    if not senders:
        raise InputError(
            f"{path}: holds no packets of a Velodyne LiDAR ({PACKET_BYTES} bytes over UDP)"
        )
    sender = min(senders, key=lambda s: (-senders[s], s))
    if len(senders) > 1:
        notes.append(
            f"of {len(senders)} LiDARs the one that sent most is read: "
            f"{'.'.join(map(str, sender[0]))} to port {sender[1]}"
        )
    kept = [(host, place) for host, place, who in rows if who == sender]
    return _capture(path, data, np.array(kept, np.int64), notes)


def _payload(
    data: mmap.mmap, at: int, length: int, link: int
) -> tuple[int, tuple[bytes, int]] | None:
    """Return where the packet of a LiDAR begins in a frame, and who sent it; None for others."""
    if length < PACKET_BYTES + 8 + 20 + link:
        return None
    ip = at + link
    if link == 14 and data[ip - 2 : ip] == b"\x81\x00":  # of a virtual network
        ip += 4
    if data[ip] >> 4 != 4 or data[ip + 9] != 17:
        return None
    udp = ip + 4 * (data[ip] & 15)
    start, end = udp + 8, at + length
    if start + PACKET_BYTES > end or data[start : start + 2] != BLOCK:
        return None
    port, told = struct.unpack_from(">HH", data, udp + 2)
    if told != PACKET_BYTES + 8:
        return None
    return start, (data[ip + 12 : ip + 16], port)


def _capture(
    path: Path, data: mmap.mmap, rows: NDArray[np.int64], notes: list[str]
) -> Capture:  # fmt: skip
    host, places = rows[:, 0], rows[:, 1]
    tails = [struct.unpack_from("<IBB", data, place + 1200) for place in places.tolist()]
    azimuths = [struct.unpack_from("<H", data, place + 2)[0] for place in places.tolist()]
    clock = np.array([tail[0] for tail in tails], np.int64)
    models = Counter(tail[2] for tail in tails).most_common(1)
    is_one = models[0][1] > 0.9 * len(tails)
    stamps, lost = _timed(clock, host, notes)
    if lost:
        share = lost / (len(places) + lost)
        notes.append(f"{lost} packets were lost ({share:.2%}): their points are missing")
    return Capture(
        path, places, host, stamps, np.array(azimuths, np.int64), lost,
        models[0][0] if is_one else -1, notes,
    )  # fmt: skip


def _timed(
    clock_us: NDArray[np.int64], host_ns: NDArray[np.int64], notes: list[str]
) -> tuple[NDArray[np.int64], int]:
    """Return when packets were measured, and how many are missing."""
    steps = np.diff(clock_us)
    steps = (steps + HOUR_US // 2) % HOUR_US - HOUR_US // 2
    usual = float(np.median(steps)) if len(steps) else 0.0
    if len(steps) and (usual <= 0 or (steps < 0).mean() > 0.01):
        notes.append("the sensor's clock stands still or jumps: times are those of the host")
        return host_ns, 0
    since_ns = np.r_[0, np.cumsum(steps)] * 1000
    offset = int(np.median(host_ns - since_ns))
    missing = np.round(steps[steps > 1.5 * usual] / usual) - 1 if usual else np.zeros(0)
    return since_ns + offset, int(missing.sum())


def turns_of(capture: Capture) -> list[NDArray[np.int64]]:
    """Return the packets of each turn, by their numbers."""
    since = (capture.azimuths - BEHIND) % 36_000
    falls = np.diff(since) < 0
    steps = np.diff(capture.stamps_ns)
    ends = np.flatnonzero(falls)
    turn_ns = float(np.median(np.diff(capture.stamps_ns[ends]))) if len(ends) > 1 else np.inf
    new = np.flatnonzero(falls | (steps > 0.5 * turn_ns) | (steps < 0)) + 1
    return np.split(np.arange(len(since), dtype=np.int64), new)
