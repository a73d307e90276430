"""Bags of ROS as a source: laser scans, with the wheels' odometry and the mount from tf.

Opening reads the file once: the stamps of the scans, their angles, the poses of the wheels and the
fixed transforms; ranges are read again when they are asked for, scan by scan, so that memory does
not grow with them. A damaged file cannot be read at random; of one the ranges are kept (4 bytes
each). Where a bag holds several topics of a kind, the one with the usual name is taken, or else the
one with most messages; options name another: "run.bag?scan=/rear/scan&odometry=/wheel/odom".

The body is the frame whose motion the wheels tell (an Odometry's child frame, or what moves in
"odom" by tf, mostly base_link); without wheels it is base_link, where fixed transforms lead from
there to the laser, and else the laser. Odometry is interpolated to the scans' stamps. Of a scan

    r < range_min, NaN, −inf    is invalid: NaN
    r ≥ range_max, inf          nothing within reach: inf

Reference: ROS enhancement proposals 105 (frames of mobile platforms) and 117 (ranges).
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odomap.errors import CalibrationError, InputError, nearest_name
from odomap.geometry.pose import SE3
from odomap.geometry.trajectory import Trajectory
from odomap.sensors.frame import Frame
from odomap.sensors.rig import LidarMount, Rig
from odomap.sources.bagfile import CLOUD, SCAN, BagFile, Topic
from odomap.sources.bagrecords import Cut
from odomap.sources.options import check_options
from odomap.sources.scanlog import mounted, rate_of
from odomap.sources.scans import Beams, mark, ordered_rows
from odomap.sources.source import Skipped, UnusableFrame
from odomap.sources.transforms import FrameTree, pose_of, tidy

__all__ = ["BagSource"]

Array = NDArray[np.float64]

OPTIONS = ("scan", "odometry", "order")
ODOMETRY = "nav_msgs/msg/Odometry"
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
USUAL = {SCAN: ("/scan", "/base_scan", "/front/scan"), ODOMETRY: ("/odom", "/odometry", "/wheel")}
REACH_NS = 200_000_000
"""So long before the first and after the last word of the wheels that word still holds."""


@dataclass(frozen=True)
class _Kind:
    """What scans of a laser have in common."""

    first: float
    step: float
    count: int
    nearest: float
    farthest: float


@dataclass
class _Pass:
    """What the first reading of a bag collects."""

    times_ns: list[int] = field(default_factory=list)
    stamps_ns: list[int] = field(default_factory=list)
    kinds: list[_Kind] = field(default_factory=list)
    frames: Counter[str] = field(default_factory=Counter)
    between_s: Counter[tuple[float, float]] = field(default_factory=Counter)
    lost: list[tuple[int, int]] = field(default_factory=list)
    kept: list[NDArray[np.float32]] | None = None
    body: str = ""
    wheel_stamps: list[int] = field(default_factory=list)
    wheel_poses: list[Array] = field(default_factory=list)
    tree: FrameTree = field(default_factory=FrameTree)


class BagSource:
    """The scans of a bag; a `RandomAccess`.

    Attributes:
        stamps_ns: (N,) int64, those of the scans' headers, none twice.
        odometry: (N, 4, 4) T_odom_body at those, NaN where the wheels say nothing, or None.
        beams: what became of the beams.
        notes: what was found odd and mended, for the user.
        details: topics, frames and times of a scan.
    """

    def __init__(
        self, path: str | Path | BagFile, rig: Rig | None = None,
        options: Mapping[str, str] | None = None,
    ) -> None:  # fmt: skip
        """Open a bag.

        Args:
            path: a .bag, .mcap or .db3 file, or the folder of a ROS 2 bag; or one that is open.
            rig: its one LiDAR is used instead of what the bag says of mount and angles.
            options: scan and odometry (topics; odometry=off leaves it out), order (as of logs).

        Raises:
            MissingExtra: rosbags is not installed.
            InputError: it cannot be read, holds no scans, or an option is wrong.
            CalibrationError: the rig is for another number of beams.
        """
        self._bag = bag = path if isinstance(path, BagFile) else BagFile(Path(path))
        path, options = bag.given, dict(options or {})
        check_options(path, options, OPTIONS)
        self.name = path.name
        self.truth: Trajectory | None = None
        self.notes, self.left_out = bag.notes, list[Skipped]()
        self._scan = _chosen(bag, SCAN, options.get("scan", ""), self.notes)
        if self._scan == "":
            held = ", ".join(f"{t.name} ({t.kind})" for t in bag.topics[:6]) or "nothing"
            raise InputError(f"{path}: holds no LaserScan; it holds {held}")
        clouds = [topic.name for topic in bag.topics if topic.kind == CLOUD and topic.count]
        if clouds:
            self.notes.append(f"holds clouds of a 3D LiDAR, too: ?cloud={clouds[0]}")
        wheels = options.get("odometry", "")
        is_off = wheels == "off"
        topic = "" if is_off else _chosen(bag, ODOMETRY, wheels, self.notes)
        seen = self._read(topic)
        self._index(seen, options.get("order", "log"))
        self.odometry = None if is_off else self._wheels(seen, topic)
        frame = seen.frames.most_common(1)[0][0]
        self.rig = mounted(self._mount(seen, frame), rig, path)
        self.details = self._details(seen, topic, frame)
        self.skipped = list(self.left_out)

    def _read(self, odometry: str) -> _Pass:
        """Read the bag once."""
        bag, seen = self._bag, _Pass(kept=None if self._bag.is_indexed else [])
        tf = [topic.name for topic in bag.topics if topic.kind in TRANSFORMS]
        wanted = [self._scan, *([odometry] if odometry else []), *tf]
        try:
            for topic, time_ns, message in bag.messages(wanted):
                if topic == self._scan:
                    _see(seen, time_ns, message)
                elif topic == odometry:
                    T = pose_of(message.pose.pose.position, message.pose.pose.orientation)
                    if T is not None:
                        seen.body = tidy(message.child_frame_id)
                        seen.wheel_stamps.append(_stamp(message))
                        seen.wheel_poses.append(T)
                else:
                    seen.tree.add(message, topic.endswith("static"))
        except Cut as error:
            if bag.is_indexed:
                self.notes.append(f"{error}: what comes before is read")
        if not seen.stamps_ns:
            raise InputError(f"{bag.path}: no scan of {self._scan} can be read")
        return seen

    def _index(self, seen: _Pass, order: str) -> None:
        """Choose the scans to give, and in what order."""
        stamps = np.array(seen.stamps_ns, np.int64)
        self._kind = usual = Counter(seen.kinds).most_common(1)[0][0]
        names = [f"{self._scan}:{row}" for row in range(len(stamps))]
        like = np.array([kind == usual for kind in seen.kinds])
        for row in np.flatnonzero(~like).tolist():
            reason = "has other beams or angles than most"
            self.left_out.append(Skipped(int(stamps[row]), names[row], reason))
        rows = np.flatnonzero(like)
        try:
            chosen = rows[
                ordered_rows(
                    stamps[rows], order, [names[r] for r in rows], self.left_out, self.notes
                )
            ]
        except InputError as error:
            raise InputError(f"{self._bag.path}: {error}") from error
        self.stamps_ns = stamps[chosen]
        self._times = [seen.times_ns[row] for row in chosen]
        self._kept = None if seen.kept is None else [seen.kept[row] for row in chosen]
        lost = np.array([seen.lost[row] for row in chosen]).sum(axis=0)
        total = max(len(chosen) * usual.count, 1)
        self.beams = Beams(usual.farthest, int(lost[0]) / total, int(lost[1]) / total)

    def _wheels(self, seen: _Pass, topic: str) -> Array | None:
        """Return the wheels' poses at the stamps of the scans."""
        stamps, poses = seen.wheel_stamps, seen.wheel_poses
        if not topic and (moved := seen.tree.wheels()) is not None:
            seen.body, stamps, poses = moved
            self.notes.append(f"no Odometry: the motion of {seen.body} in odom (tf) is taken")
        if not stamps:
            return None
        known, first = np.unique(np.array(stamps, np.int64), return_index=True)
        path = Trajectory(known, np.stack(poses)[first])
        at = np.clip(self.stamps_ns, known[0], known[-1])
        asked, back = np.unique(at, return_inverse=True)
        Ts = np.array(path.interpolate(asked).Ts_world_body[back])
        Ts[np.abs(at - self.stamps_ns) > REACH_NS] = np.nan
        without = int(np.isnan(Ts[:, 0, 0]).sum())
        if without:
            self.notes.append(f"{without} scans are outside the time of the odometry")
        Ts.setflags(write=False)
        return Ts

    def _mount(self, seen: _Pass, frame: str) -> LidarMount:
        """Return the laser: mounted where fixed transforms say."""
        body = seen.body or "base_link"
        T = seen.tree.fixed(body, frame)
        if T is None:
            T = np.eye(4)
            if seen.body:
                self.notes.append(
                    f"tf from {body} to {frame} is missing: the laser is taken to be where "
                    f"{body} is"
                )
        kind, between = self._kind, seen.between_s.most_common(1)[0][0][0]
        turns = "none" if between <= 0 else "clockwise" if kind.step < 0 else "counter_clockwise"
        last = kind.first + (kind.count - 1) * kind.step
        try:
            return LidarMount(
                tidy(frame) or "laser", SE3(T), (kind.nearest, kind.farthest),
                rate_of(self.stamps_ns), turns, (kind.first, last, kind.count),
            )  # fmt: skip
        except CalibrationError as error:
            raise CalibrationError(f"{self._bag.path}: {error}") from error

    def _details(self, seen: _Pass, topic: str, frame: str) -> dict[str, Any]:
        increment, scan_time = seen.between_s.most_common(1)[0][0]
        return {
            "scan": f"{self._scan} in {frame or 'a frame without a name'}",
            "wheels": f"{topic} of {seen.body}" if topic else "",
            "time_increment_s": increment,
            "scan_time_s": scan_time,
            "topics": ", ".join(f"{t.name} ({t.count} {t.kind})" for t in self._bag.topics),
        }

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def __repr__(self) -> str:
        return f"BagSource({self.name}: {len(self)} scans of {self._scan})"

    def __iter__(self) -> Iterator[Frame]:
        """Yield the scans, in order of measurement."""
        self.skipped = list(self.left_out)
        if self._kept is not None or (np.diff(self._times) < 0).any():
            yield from map(self.frame, range(len(self)))
            return
        index = 0
        try:
            for _, time_ns, message in self._bag.messages([self._scan]):
                if index < len(self) and self._is(index, time_ns, message):
                    yield self._frame(index, _ranges(message))
                    index += 1
        except Cut as error:  # noted when the bag was opened
            if index < len(self):
                stamp = int(self.stamps_ns[index])
                self.skipped.append(Skipped(stamp, f"{self._scan}:{index}", str(error)))

    def frame(self, index: int) -> Frame:
        """Read one scan.

        Raises:
            UnusableFrame: it cannot be read any more.
            IndexError: there is no such frame.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)}")
        if self._kept is not None:
            return self._frame(index, self._kept[index].copy())
        reason = "is not there any more"
        try:
            for _, time_ns, message in self._bag.messages([self._scan], self._times[index]):
                if self._is(index, time_ns, message):
                    return self._frame(index, _ranges(message))
        except Cut as error:
            reason = str(error)
        stamp = int(self.stamps_ns[index])
        raise UnusableFrame(Skipped(stamp, f"{self._scan}:{index}", reason))

    def _is(self, index: int, time_ns: int, message: Any) -> bool:
        """Tell whether a message is the scan of a frame."""
        return (
            time_ns == self._times[index]
            and _stamp(message) == self.stamps_ns[index]
            and len(message.ranges) == self._kind.count
        )

    def _frame(self, index: int, ranges: NDArray[np.float32]) -> Frame:
        mark(ranges, self._kind.nearest, self._kind.farthest)
        with np.errstate(invalid="ignore"):  # some NaN of a damaged file signal when they are cast
            scan = ranges.astype(np.float64)
        T = None if self.odometry is None else self.odometry[index]
        return Frame(
            id=index,
            stamp_ns=int(self.stamps_ns[index]),
            scan=scan,
            odometry=None if T is None or np.isnan(T[0, 0]) else T,
        )


def _chosen(bag: BagFile, kind: str, asked: str, notes: list[str]) -> str:
    """Return the topic of a type to read, empty if there is none; note the others."""
    topics = [topic for topic in bag.topics if topic.kind == kind and topic.count]
    names = [topic.name for topic in topics]
    word = kind.rpartition("/")[2]
    if asked:
        if asked not in names:
            has = ", ".join(names) or "none"
            raise InputError(
                f"{bag.path}: there is no {word} topic '{asked}'{nearest_name(asked, names)}; "
                f"there are: {has}"
            )
        return asked
    if not topics:
        return ""

    def rank(topic: Topic) -> tuple[int, int, str]:
        usual = USUAL[kind]
        place = usual.index(topic.name) if topic.name in usual else len(usual)
        return place, -topic.count, topic.name

    best = min(topics, key=rank).name
    others = [name for name in names if name != best]
    if others:
        option = "scan" if kind == SCAN else "odometry"
        notes.append(
            f"of {len(names)} {word} topics {best} is read; others: "
            + ", ".join(f"?{option}={name}" for name in others)
        )
    return best


def _see(seen: _Pass, time_ns: int, message: Any) -> None:
    """Note what a scan is, and what became of its beams."""
    ranges = _ranges(message)
    kind = _Kind(
        float(message.angle_min),
        float(message.angle_increment),
        len(ranges),
        max(float(message.range_min), 0.0),
        float(message.range_max),
    )
    if not (len(ranges) and np.isfinite([kind.first, kind.step]).all()):
        return
    if not kind.nearest < kind.farthest:
        kind = _Kind(kind.first, kind.step, kind.count, 0.0, float("inf"))
    seen.times_ns.append(time_ns)
    seen.stamps_ns.append(_stamp(message))
    seen.kinds.append(kind)
    seen.frames[tidy(message.header.frame_id)] += 1
    seen.between_s[float(message.time_increment), float(message.scan_time)] += 1
    if seen.kept is not None:
        seen.kept.append(ranges.copy())
    mark(ranges, kind.nearest, kind.farthest)
    seen.lost.append((int(np.isinf(ranges).sum()), int(np.isnan(ranges).sum())))


def _ranges(message: Any) -> NDArray[np.float32]:
    return np.array(message.ranges, np.float32)


def _stamp(message: Any) -> int:
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)
