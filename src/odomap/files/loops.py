"""loops.json: every place that a run took for one seen before, and what was decided.

    {"odomap_loops": 1, "name": "...", "is_metric": true, "start_ns": ...,
     "candidates": [{"keyframe_id": 120, "matched_id": 3, "frame": 402, ...}, ...]}

The file says why each refused candidate was refused, which is in no map, and how far each loop that
was closed moved the path, which no map tells afterwards. Keyframes may be culled: so the file
has their frames and stamps as well. Files are not trusted: each field is asked for by name and
kind, numbers must be finite and in range, texts are short and printable.

Cost: O(candidates).

Reference: ECMA-404, "The JSON data interchange syntax", 2nd ed., 2017.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.files.records import read_json, write_json

__all__ = [
    "LOOPS_FILE",
    "LoopLog",
    "LoopRecord",
    "as_fields",
    "nearest",
    "read_loops",
    "write_loops",
]

LOOPS_FILE = "loops.json"
VERSION = 1
MOST_BYTES = 1 << 26
LONGEST = 2000
"""Letters of a text at most."""
FEW = 3
"""Loops that are named in a line."""
LARGEST = 1e100
ROTATION_TOLERANCE = 1e-6


@dataclass(frozen=True, eq=False)
class LoopRecord:
    """A candidate for a loop that was decided on.

    Attributes:
        keyframe_id: the keyframe that may have come back.
        matched_id: the keyframe it may have come back to.
        frame: number of its frame; -1 where it is none of this run.
        matched_frame: likewise of the other; -1 where it was in the map before.
        stamp_ns: time of the keyframe.
        matched_stamp_ns: time of the other.
        num_inliers: matches that agree with the measured pose.
        is_accepted: whether the map was corrected with it.
        reason: why not; empty where it was.
        merges: whether it made one of two pieces of the map.
        moved: by how much the correction moved the keyframe, world units.
        turned: by how much it turned it, radians.
        rescaled: units of the keyframe after it per unit before.
        T_matched_keyframe: (4, 4) measured pose of the keyframe in the matched one, in its units;
            the identity where none was found.
        doubts: loops closed before that contradict it and are not believed any more, each by the
            keyframe that came back and the one it came back to.
        is_tied: whether landmarks of the old map pointed at it, which tracking had found again.
    """

    keyframe_id: int
    matched_id: int
    frame: int
    matched_frame: int
    stamp_ns: int
    matched_stamp_ns: int
    num_inliers: int
    is_accepted: bool
    reason: str
    merges: bool
    moved: float
    turned: float
    rescaled: float
    T_matched_keyframe: NDArray[np.float64]
    doubts: tuple[tuple[int, int], ...] = ()
    is_tied: bool = False

    @property
    def ends(self) -> tuple[int, int]:
        """The keyframe that came back, and the one it came back to."""
        return self.keyframe_id, self.matched_id


@dataclass(frozen=True, eq=False)
class LoopLog:
    """What a run decided on loops.

    Attributes:
        name: the recording.
        is_metric: whether lengths are metres.
        start_ns: stamp of the first frame.
        records: in the order in which they were decided on.
    """

    name: str
    is_metric: bool
    start_ns: int
    records: tuple[LoopRecord, ...]

    @property
    def closed(self) -> tuple[LoopRecord, ...]:
        """Those that were believed."""
        return tuple(record for record in self.records if record.is_accepted)

    @property
    def rejected(self) -> tuple[LoopRecord, ...]:
        """Those that were not."""
        return tuple(record for record in self.records if not record.is_accepted)

    def remarks(self, record: LoopRecord) -> tuple[str, ...]:
        """Say in words how a loop was found if not by its look, and what contradicts it.

        Args:
            record: one that was closed.
        """
        closed = {other.ends: other for other in self.closed}
        earlier = [closed[ends] for ends in record.doubts if ends in closed]
        before = [ends for ends in record.doubts if ends not in closed]
        later = [other for other in self.closed if record.ends in other.doubts]
        said = [
            "tracking had found the old map again" if record.is_tied else "",
            f"contradicts the one at {self._at(earlier)}" if earlier else "",
            f"contradicts {_of_the_map_before(before)}" if before else "",
            f"not believed any more: contradicts that at {self._at(later)}" if later else "",
        ]
        return tuple(filter(None, said))

    def _at(self, records: Sequence[LoopRecord]) -> str:
        times = [f"{self.seconds(r.stamp_ns):.2f} s (frame {r.frame})" for r in records]
        return _some(times)

    def seconds(self, stamp_ns: int) -> float:
        """Return the time of a stamp since the first frame, seconds."""
        return (stamp_ns - self.start_ns) * 1e-9


def _of_the_map_before(loops: Sequence[tuple[int, int]]) -> str:
    return f"that of keyframes {_some([f'{a} and {b}' for a, b in loops])} of the map before"


def _some(words: Sequence[str]) -> str:
    """Return the first of some words, and how many more there are."""
    more = f" and {len(words) - FEW} more" if len(words) > FEW else ""
    return ", ".join(words[:FEW]) + more


def write_loops(path: str | Path, loops: LoopLog) -> None:
    """Write what a run decided on loops; the same content gives the same bytes.

    Raises:
        OutputError: it cannot be written.
    """
    write_json(path, as_fields(loops))


def as_fields(loops: LoopLog) -> dict[str, Any]:
    """Return the content of the file."""
    return {
        "odomap_loops": VERSION,
        "name": loops.name,
        "is_metric": loops.is_metric,
        "start_ns": loops.start_ns,
        "candidates": [vars(record) for record in loops.records],
    }


def nearest(records: Sequence[LoopRecord], most: int) -> list[LoopRecord]:
    """Return those with the most inliers, in their order."""
    strongest = sorted(records, key=lambda record: -record.num_inliers)[:most]
    return [record for record in records if record in strongest]


def read_loops(path: str | Path) -> LoopLog:
    """Read what a run decided on loops.

    Args:
        path: the file.

    Raises:
        InputError: it cannot be read, is cut short, of another version, or says what cannot be.
    """
    file = Path(path)
    if file.is_file() and file.stat().st_size > MOST_BYTES:
        raise InputError(f"{file}: has more than {MOST_BYTES >> 20} MB: it is no list of loops")
    content = read_json(file, packed=False)
    if not isinstance(content, Mapping) or type(content.get("odomap_loops")) is not int:
        raise InputError(f"{file}: is no list of loops: 'odomap_loops' with a version is missing")
    if content["odomap_loops"] != VERSION:
        raise InputError(
            f"{file}: is of version {content['odomap_loops']}, this odomap reads {VERSION}: update "
            "odomap, or run it again"
        )
    whole = _Checked(str(file), content)
    candidates = content.get("candidates")
    if not isinstance(candidates, list):
        raise whole.error("candidates", "must be a list")
    return LoopLog(
        whole.text("name"),
        whole.truth("is_metric"),
        whole.integer("start_ns"),
        tuple(
            _record(_Checked(f"{file}: candidates[{n}]", each)) for n, each in enumerate(candidates)
        ),
    )


def _record(at: "_Checked") -> LoopRecord:
    record = LoopRecord(
        keyframe_id=at.integer("keyframe_id", 0),
        matched_id=at.integer("matched_id", 0),
        frame=at.integer("frame", -1),
        matched_frame=at.integer("matched_frame", -1),
        stamp_ns=at.integer("stamp_ns"),
        matched_stamp_ns=at.integer("matched_stamp_ns"),
        num_inliers=at.integer("num_inliers", 0),
        is_accepted=at.truth("is_accepted"),
        reason=at.text("reason"),
        merges=at.truth("merges"),
        moved=at.number("moved", 0.0),
        turned=at.number("turned", 0.0),
        rescaled=at.number("rescaled", 0.0),
        T_matched_keyframe=at.pose("T_matched_keyframe"),
        doubts=at.pairs("doubts"),
        is_tied=at.truth("is_tied", False),
    )
    if record.is_accepted == bool(record.reason):
        raise at.error("reason", "must be there for a candidate that is refused, and only there")
    return record


class _Checked:
    """A mapping whose fields are what they should be, or an error."""

    def __init__(self, where: str, content: Any) -> None:
        if not isinstance(content, Mapping):
            raise InputError(f"{where}: must be a mapping of fields")
        self._where, self._content = where, content

    def error(self, name: str, problem: str) -> InputError:
        """Return the error that says what is wrong with a field."""
        return InputError(f"{self._where}: {name} {problem}")

    def integer(self, name: str, least: int = -(1 << 63)) -> int:
        """Return a whole number of 64 bits."""
        value = self._content.get(name)
        if type(value) is not int or not least <= value < 1 << 63:
            raise self.error(name, f"must be a whole number{'' if least < -1 else f' >= {least}'}")
        return value

    def number(self, name: str, least: float) -> float:
        """Return a finite number."""
        value: Any = self._content.get(name)
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if not is_number or not least <= value < LARGEST:
            raise self.error(name, f"must be a finite number >= {least:g}")
        return float(value)

    def truth(self, name: str, default: bool | None = None) -> bool:
        """Return true or false, or the default where the file is older than the field."""
        value = self._content.get(name, default)
        if type(value) is not bool:
            raise self.error(name, "must be true or false")
        return value

    def text(self, name: str) -> str:
        """Return a text that a terminal can be shown."""
        value = self._content.get(name)
        if type(value) is not str or len(value) > LONGEST:
            raise self.error(name, f"must be a text of at most {LONGEST} letters")
        return "".join(c if c.isprintable() else "?" for c in value)

    def pairs(self, name: str) -> tuple[tuple[int, int], ...]:
        """Return pairs of keyframes; none where the file is older than they are."""
        rows: Any = self._content.get(name, [])
        if type(rows) is not list or any(type(row) is not list or len(row) != 2 for row in rows):
            raise self.error(name, "must be a list of pairs of keyframes")
        if any(type(k) is not int or not 0 <= k < 1 << 63 for row in rows for k in row):
            raise self.error(name, "must hold whole numbers >= 0")
        return tuple((a, b) for a, b in rows)

    def pose(self, name: str) -> NDArray[np.float64]:
        """Return a (4, 4) rigid transform."""
        rows: Any = self._content.get(name)
        rows = rows if isinstance(rows, list) else []
        if [len(row) if type(row) is list else 0 for row in rows] != [4] * 4:
            raise self.error(name, "must be four rows of four numbers")
        if any(type(x) not in (int, float) or not abs(x) < LARGEST for row in rows for x in row):
            raise self.error(name, "must hold finite numbers")
        T = np.array(rows, np.float64)
        R = T[:3, :3]
        is_rigid = (T[3] == (0, 0, 0, 1)).all() and np.linalg.det(R) > 0
        if not is_rigid or np.abs(R @ R.T - np.eye(3)).max() > ROTATION_TOLERANCE:
            raise self.error(name, "is no rigid transform")
        return T
