"""Captures of a Velodyne LiDAR, as they go over a network: of a room, and of a drive."""

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from odomap.sources.packets import HOUR_US

Array = NDArray[np.float64]

START_S = 1_700_000_000
PACKET_US = 1327
"""From packet to packet: 24 firings of 55.296 µs."""
ANGLES = np.radians([-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15])
ROOM = 8.0


def packets(turns: float = 4.0, clock_us: int = 5_000_000, first: float = 250.0) -> Iterator[bytes]:
    """Yield packets of a VLP-16 at 10 Hz in the middle of a square room of 16 m."""
    step = 3600.0 * PACKET_US * 1e-6 / 12  # degrees of a block
    for number in range(round(turns * 1e5 / PACKET_US)):
        blocks = b""
        for block in range(12):
            azimuth = (first + (12 * number + block) * step) % 360
            ranges = []
            for firing in range(2):
                phi = np.radians(azimuth + firing * step / 2)
                flat = ROOM / max(abs(np.cos(phi)), abs(np.sin(phi)))
                ranges += [round(flat / np.cos(a) / 0.002) for a in ANGLES]
            words = b"".join(struct.pack("<HB", r, 10 * (k % 16)) for k, r in enumerate(ranges))
            blocks += b"\xff\xee" + struct.pack("<H", round(azimuth * 100) % 36000) + words
        told = (clock_us + number * PACKET_US) % HOUR_US
        yield blocks + struct.pack("<IBB", told, 0x37, 0x22)


def frame_of(data: bytes, port: int = 2368, host: bytes = b"\xc0\xa8\x01\xc9") -> bytes:
    """Return a packet as it goes over a network."""
    udp = struct.pack(">HHHH", port, port, len(data) + 8, 0)
    ip = struct.pack(">BBHHHBBH", 0x45, 0, 20 + 8 + len(data), 0, 0x4000, 17, 17, 0)
    return bytes(12) + b"\x08\x00" + ip + host + b"\xff" * 4 + udp + data


def capture(path: Path, sent: list[bytes], late_s: float = 0.002, order: str = "<") -> Path:
    """Write frames, one each 1327 µs by the host's clock, which is late."""
    magic = 0xA1B2C3D4
    data = [struct.pack(f"{order}IHHiIII", magic, 2, 4, 0, 0, 65535, 1)]
    for k, frame in enumerate(sent):
        now = START_S * 10**6 + k * PACKET_US + round(late_s * 1e6)
        head = struct.pack(f"{order}4I", now // 10**6, now % 10**6, len(frame), len(frame))
        data.append(head + frame)
    path.write_bytes(b"".join(data))
    return path


FIRING_S, BETWEEN_S = 55.296e-6, 2.304e-6
"""Time from firing to firing, and from laser to laser in it."""


def drive(turns: int, speed: float) -> Iterator[bytes]:
    """Yield packets of a VLP-16 that is driven straight through a yard with cabins."""
    rng = np.random.default_rng(4)
    low = np.c_[rng.uniform(-30, 40, 14), rng.choice([-1, 1], 14) * rng.uniform(3, 12, 14)]
    low -= [0.0, 1.0]
    boxes = np.c_[low, np.full(14, -1.8)], np.c_[low + rng.uniform(1, 4, (14, 2)), np.full(14, 3.0)]
    for number in range(round(turns * 1e5 / PACKET_US)):
        firing = 24 * number + np.arange(24)
        seconds = firing[:, None] * FIRING_S + np.arange(16) * BETWEEN_S
        phi = np.radians(250.0) + 2 * np.pi * 10 * seconds
        up = np.broadcast_to(ANGLES, phi.shape)
        ray = np.stack([np.cos(up) * np.cos(phi), -np.cos(up) * np.sin(phi), np.sin(up)], axis=-1)
        at = np.stack([speed * seconds - 10.0, 0 * seconds, 0 * seconds], axis=-1)
        far = _hit(at, ray, *boxes) + rng.normal(0.0, 0.01, phi.shape)
        words = np.where(far < 100.0, np.round(far / 0.002), 0).astype(int)
        turned = np.degrees(phi[::2, 0]) % 360
        data = b""
        for block in range(12):
            row = words[2 * block : 2 * block + 2].ravel().tolist()
            data += b"\xff\xee" + struct.pack("<H", round(turned[block] * 100) % 36000)
            data += b"".join(struct.pack("<HB", r, 100) for r in row)
        yield data + struct.pack("<IBB", (5_000_000 + number * PACKET_US) % HOUR_US, 0x37, 0x22)


def _hit(at: Array, ray: Array, low: Array, high: Array) -> Array:
    """Return how far (N, 16) rays go to the ground, to walls 45 m by 20 m away, and to boxes."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ground = np.where(ray[..., 2] < 0, (-1.8 - at[..., 2]) / ray[..., 2], np.inf)
        x = np.where(ray[..., 0] > 0, 45.0 - at[..., 0], -45.0 - at[..., 0]) / ray[..., 0]
        y = np.where(ray[..., 1] > 0, 20.0 - at[..., 1], -20.0 - at[..., 1]) / ray[..., 1]
        far = np.minimum(ground, np.minimum(x, y))
        one = (low - at[..., None, :]) / ray[..., None, :]
        two = (high - at[..., None, :]) / ray[..., None, :]
    into = np.minimum(one, two).max(axis=-1)
    out = np.maximum(one, two).min(axis=-1)
    box = np.where((into < out) & (into > 0.0), into, np.inf).min(axis=-1)
    return np.asarray(np.minimum(far, box))
