"""Clouds of a bag of ROS: PointCloud2 as sweeps, with the mount from tf.

Opening reads of each message only when and where it was measured, and the fixed transforms; points
are read when they are asked for. What the fields mean is found out from a few sweeps: names,
whether times are in ns, µs, ms or s and since when (`pointtimes`), how beams are ordered
(`pointbeams`). Of several topics the one with most messages is taken; "run.bag?cloud=/points" names
another. Sweeps are sorted by their stamps (?order=log leaves them as recorded), and of two with the
same stamp the first is taken.

The body is what moves in "odom", or else base_link, where fixed transforms lead from there to the
LiDAR, or else the LiDAR.

Reference: ROS enhancement proposal 105 (frames of mobile platforms).
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from odomap.errors import InputError, nearest_name
from odomap.files.pointtable import PointTable
from odomap.geometry.pose import SE3
from odomap.sensors.frame import Frame
from odomap.sensors.rig import LidarMount, Rig
from odomap.sensors.sweep import Sweep
from odomap.sources.bagfile import CLOUD, BagFile, Head
from odomap.sources.bagrecords import Cut
from odomap.sources.options import check_options
from odomap.sources.pointcloud2 import BadCloud, table_of
from odomap.sources.pointfields import OPTIONS, recognised
from odomap.sources.scans import ordered_rows
from odomap.sources.source import Skipped, UnusableFrame
from odomap.sources.survey import FAR_M, NEAR_M, SAMPLES, mounted_sweeps, sample, survey
from odomap.sources.sweeplog import SweepLog, usual_rate
from odomap.sources.transforms import FrameTree, tidy

__all__ = ["CloudBagSource"]

TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
BASE = "base_link"


@dataclass
class _Pass:
    """What the first reading of a bag collects."""

    times_ns: list[int] = field(default_factory=list)
    stamps_ns: list[int] = field(default_factory=list)
    frames: Counter[str] = field(default_factory=Counter)
    tree: FrameTree = field(default_factory=FrameTree)


class CloudBagSource(SweepLog):
    """The clouds of a bag as a source of frames."""

    def __init__(
        self, bag: BagFile, rig: Rig | None = None, options: Mapping[str, str] | None = None
    ) -> None:
        """Open a bag.

        Args:
            bag: the bag.
            rig: its one LiDAR is used instead of what the bag says of mount and range.
            options: cloud (the topic), order ("stamps" or "log"), time, ring (names of fields, or
                "off"), unit (of times: s, ms, us, ns).

        Raises:
            InputError: it holds no clouds that can be read, or an option is wrong.
            CalibrationError: the rig is for another LiDAR.
        """
        path, options = bag.given, dict(options or {})
        check_options(path, options, ("cloud", "order", *OPTIONS))
        self._bag = bag
        notes, left_out = list(bag.notes), list[Skipped]()
        self._topic = _chosen(bag, options.get("cloud", ""), notes)
        seen = self._read(notes)
        names = [f"{self._topic}:{row}" for row in range(len(seen.stamps_ns))]
        stamps = np.array(seen.stamps_ns, np.int64)
        try:
            order = options.get("order", "stamps")
            self._rows = ordered_rows(stamps, order, names, left_out, notes)
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
        self._names = [names[row] for row in self._rows]
        self._times = [seen.times_ns[row] for row in self._rows]
        self._stamps = stamps = stamps[self._rows]
        rate = usual_rate(np.sort(stamps))
        samples = [(k, table) for k, table in self._samples() if table.count]
        self._fields = fields = recognised(
            path,
            [table for _, table in samples],
            [int(stamps[k]) for k, _ in samples],
            1 / rate if len(stamps) > 1 else 0.0,
            options,
        )
        if fields.time and fields.times is None and samples:
            notes.append(
                f"'{fields.time}' is the same for all points of a sweep: they have no times"
            )
        facts = survey(
            sample(len(samples), lambda k: self._made(*samples[k])),
            fields.times_how,
            *fields.num_beams,
        )
        frame = seen.frames.most_common(1)[0][0]
        mount = LidarMount(
            frame or "lidar", _mount(seen.tree, frame), (NEAR_M, FAR_M), rate, "none"
        )
        super().__init__(
            name=path.name,
            rig=mounted_sweeps(mount, rig, facts, path),
            stamps_ns=stamps,
            read=self._sweep,
            survey=facts,
            left_out=left_out,
            notes=notes,
            details={
                "cloud": f"{self._topic} in {frame or 'a frame without a name'}",
                "fields": ", ".join(samples[0][1].columns) if samples else "",
                "topics": ", ".join(f"{t.name} ({t.count} {t.kind})" for t in bag.topics),
            },
        )

    def _read(self, notes: list[str]) -> _Pass:
        """Read the bag once, without the points."""
        bag, seen = self._bag, _Pass()
        tf = [topic.name for topic in bag.topics if topic.kind in TRANSFORMS]
        try:
            for topic, time_ns, message in bag.messages([self._topic, *tf], heads=[self._topic]):
                if isinstance(message, Head):
                    seen.times_ns.append(time_ns)
                    seen.stamps_ns.append(message.stamp_ns)
                    seen.frames[tidy(message.frame)] += 1
                else:
                    seen.tree.add(message, topic.endswith("static"))
        except Cut as error:
            if bag.is_indexed:
                notes.append(f"{error}: what comes before is read")
        if not seen.stamps_ns:
            raise InputError(f"{bag.path}: no cloud of {self._topic} can be read")
        return seen

    def _samples(self) -> list[tuple[int, PointTable]]:
        """Return some sweeps by their number: evenly spaced, or the first of a damaged bag."""
        if self._bag.is_indexed:
            return sample(len(self._stamps), lambda k: (k, self._table(k)))
        places = {int(row): k for k, row in enumerate(self._rows)}
        found: list[tuple[int, PointTable]] = []
        for row, message in self._messages():
            if row in places and len(found) < SAMPLES:
                try:
                    found.append((places[row], table_of(message)))
                except BadCloud:  # is said when it is its turn
                    continue
            if row >= 2 * SAMPLES:
                break
        return found

    def _messages(self) -> Iterator[tuple[int, Any]]:
        """Yield the clouds as recorded, with their numbers, up to where a bag is damaged."""
        try:
            for row, (_, _, message) in enumerate(self._bag.messages([self._topic])):
                yield row, message
        except Cut:  # noted when the bag was opened
            return

    def __iter__(self) -> Iterator[Frame]:
        """Yield the sweeps that can be read; the bag is read once, whatever its order."""
        self.skipped = list(self.left_out)
        places = {int(row): k for k, row in enumerate(self._rows)}
        waiting: dict[int, Any] = {}
        count = turn = 0
        for row, message in self._messages():
            if row in places:
                waiting[places[row]] = message
            while turn in waiting:
                frame = self._frame(turn, waiting.pop(turn))
                turn += 1
                if frame is not None:
                    count += 1
                    yield frame
        for k in range(turn, len(self)):  # those behind one that could not be read
            frame = self._frame(k, waiting[k]) if k in waiting else None
            if frame is not None:
                count += 1
                yield frame
            elif k not in waiting:
                self.skipped.append(self._lost(k, "cannot be read any more"))
        if count == 0:
            first = self.skipped[-1]
            raise InputError(f"{first.file}: {first.reason}; no sweep of {self.name} can be read")

    def _frame(self, index: int, message: Any) -> Frame | None:
        try:
            cloud = self._made(index, self._tabled(index, message))
        except UnusableFrame as error:
            self.skipped.append(error.skipped)
            return None
        return Frame(index, int(self.stamps_ns[index]), cloud=cloud)

    def _sweep(self, index: int) -> Sweep:
        return self._made(index, self._table(index))

    def _table(self, index: int) -> PointTable:
        """Find one cloud in the bag."""
        stamp, reason = int(self._stamps[index]), "is not there any more"
        try:
            for _, _, message in self._bag.messages([self._topic], self._times[index]):
                if (
                    int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)
                    == stamp
                ):
                    return self._tabled(index, message)
        except Cut as error:
            reason = str(error)
        raise UnusableFrame(self._lost(index, reason))

    def _tabled(self, index: int, message: Any) -> PointTable:
        try:
            return table_of(message)
        except BadCloud as error:
            raise UnusableFrame(self._lost(index, str(error))) from error

    def _made(self, index: int, table: PointTable) -> Sweep:
        """Return a table as a sweep."""
        try:
            sweep = self._fields.sweep(table, int(self._stamps[index]))
        except KeyError as error:
            reason = f"points have no {error}, as those of the other clouds have"
            raise UnusableFrame(self._lost(index, reason)) from error
        if self._fields.times is not None and sweep.times is None and table.count:
            reason = f"'{self._fields.time}' is not within this sweep: it has no times"
            skipped, known = self._lost(index, reason), getattr(self, "skipped", [])
            if skipped not in known:
                known.append(skipped)
        return sweep

    def _lost(self, index: int, reason: str) -> Skipped:
        return Skipped(int(self._stamps[index]), self._names[index], reason)


def _mount(tree: FrameTree, frame: str) -> SE3:
    """Return T_body_lidar along fixed transforms; the identity where none lead to the body."""
    moved = tree.wheels()
    T = tree.fixed(BASE if moved is None else moved[0], frame)
    return SE3(np.eye(4) if T is None else T)


def _chosen(bag: BagFile, asked: str, notes: list[str]) -> str:
    """Return the topic of clouds to read; note the others."""
    counts = {t.name: t.count for t in bag.topics if t.kind == CLOUD and t.count}
    if asked and asked not in counts:
        has = ", ".join(counts) or "none"
        raise InputError(
            f"{bag.path}: there is no PointCloud2 topic '{asked}'{nearest_name(asked, counts)}; "
            f"there are: {has}"
        )
    if not counts:
        held = ", ".join(f"{t.name} ({t.kind})" for t in bag.topics[:6]) or "nothing"
        raise InputError(f"{bag.path}: holds no PointCloud2; it holds {held}")
    best = asked or min(counts, key=lambda name: (-counts[name], name))
    others = [name for name in counts if name != best]
    if others and not asked:
        notes.append(
            f"of {len(counts)} PointCloud2 topics {best} is read; others: "
            + ", ".join(f"?cloud={name}" for name in others)
        )
    return best
