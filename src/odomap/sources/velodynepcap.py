"""Captures of a Velodyne LiDAR (pcap) as sweeps, one per turn.

`velodyne-decoder` (extra `lidar`) makes points of packets: places, times and beams by the sensor's
geometry. Which packets make a turn is found here (`packets`), so that any sweep can be read by
itself: turns are cut behind, and stamped by their first packet. Beginning and end of a recording
are parts of turns; those of less than half of one are left out. Where packets were lost points are
missing, and how many is said.

Models are recognised by the packets; "run.pcap?model=VLP32C" names another. An HDL-64E sends its
calibration along.

Reference: Velodyne LiDAR, "VLP-16 user manual", 63-9243 rev. D, 2016, chapter 9.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError, MissingExtra, nearest_name
from odomap.sensors.rig import LidarMount, Rig
from odomap.sensors.sweep import Sweep
from odomap.sources.options import check_options
from odomap.sources.packets import Capture, read_capture, turns_of
from odomap.sources.source import Skipped, UnusableFrame
from odomap.sources.survey import FAR_M, NEAR_M, mounted_sweeps, sample, survey
from odomap.sources.sweeplog import SweepLog, usual_rate

__all__ = ["PcapSource"]

BEAMS = {"16": 16, "Puck": 16, "32": 32, "64": 64, "128": 128, "Alpha": 128}
"""Beams by a part of a model's name."""
WHOLE = 0.5
"""A turn with a smaller share of the usual packets at the begin or the end is left out."""
X, Y, Z, INTENSITY, TIME, _, RING, _ = range(8)
"""Columns of what the library returns."""


class PcapSource(SweepLog):
    """The sweeps of a capture as a source of frames."""

    def __init__(
        self, path: str | Path, rig: Rig | None = None, options: Mapping[str, str] | None = None
    ) -> None:
        """Open a capture.

        Args:
            path: the file.
            rig: its one LiDAR is used for mount and range.
            options: model (its name in velodyne-decoder).

        Raises:
            MissingExtra: velodyne-decoder is not installed.
            InputError: it holds no sweeps, or the model is not known.
            CalibrationError: the rig is for another LiDAR.
        """
        path, options = Path(path), dict(options or {})
        check_options(path, options, ("model",))
        self._capture = capture = read_capture(path)
        self._vd, self._config = _decoder(capture, options.get("model", ""))
        notes = list(capture.notes)
        self._turns = turns = _whole(turns_of(capture), notes)
        stamps = np.array([capture.stamps_ns[turn[0]] for turn in turns], np.int64)
        kept = np.flatnonzero(np.r_[True, np.diff(np.maximum.accumulate(stamps)) > 0])
        left_out = [
            Skipped(int(stamps[k]), f"{path.name}:{k}", "its stamp is not after the one before")
            for k in np.setdiff1d(np.arange(len(stamps)), kept).tolist()
        ]
        self._turns, self._stamps = [turns[k] for k in kept.tolist()], stamps[kept]
        rate = usual_rate(self._stamps)
        sweeps = sample(len(self._stamps), self._sweep)
        model = str(self._config.model).rpartition(".")[2]
        beams = next((n for part, n in BEAMS.items() if part in model), 0)
        facts = survey(
            sweeps, "from the packets, since the first of a turn", beams, f"by the model, {model}"
        )
        mount = LidarMount("velodyne", range_m=(NEAR_M, FAR_M), rate_hz=rate, sweep="clockwise")
        super().__init__(
            name=path.name,
            rig=mounted_sweeps(mount, rig, facts, path),
            stamps_ns=self._stamps,
            read=self._sweep,
            survey=facts,
            left_out=left_out,
            notes=notes,
            details={
                "model": model,
                "packets": f"{len(capture.places)}, {capture.lost} lost",
            },
        )

    def _sweep(self, index: int) -> Sweep:
        """Decode the packets of one turn."""
        rows = self._turns[index]
        try:
            packets = self._capture.packets(rows)
            points = self._decoded(packets, self._capture.host_ns[rows])
        # The library says what is wrong with a packet in its own ways.
        except (OSError, RuntimeError, ValueError) as error:
            reason = " ".join(str(error).split())
            name = f"{self._capture.path.name}:{index}"
            raise UnusableFrame(Skipped(int(self._stamps[index]), name, reason)) from error
        return Sweep(
            points[:, :3].astype(np.float64),
            points[:, TIME].astype(np.float64),
            points[:, INTENSITY].astype(np.float32),
            points[:, RING].astype(np.int16),
        )

    def _decoded(self, packets: list[bytes], host_ns: NDArray[np.int64]) -> NDArray[np.float32]:
        turn = self._vd.PacketVector()
        for data, host in zip(packets, host_ns.tolist(), strict=True):
            turn.append(self._vd.VelodynePacket(host * 1e-9, data))
        _, points = self._vd.ScanDecoder(self._config).decode(turn)
        found = np.asarray(points, np.float32)
        return found if found.ndim == 2 else np.zeros((0, 8), np.float32)


def _decoder(capture: Capture, asked: str) -> tuple[Any, Any]:
    """Return the library, and its settings for the model of a capture."""
    try:
        import velodyne_decoder
    except ImportError as error:
        lacks = "" if error.name in ("velodyne_decoder", None) else f" ({error})"
        raise MissingExtra(
            f"{capture.path}: a capture needs velodyne-decoder{lacks}: pip install 'odomap[lidar]'"
        ) from error
    models = dict(velodyne_decoder.Model.__members__)
    if asked and asked not in models:
        raise InputError(
            f"{capture.path}: model: '{asked}' is none of {', '.join(models)}"
            + nearest_name(asked, models)
        )
    config = velodyne_decoder.Config(timestamp_first_packet=True)
    if asked:
        config.model = models[asked]
    elif capture.model < 0:
        try:
            config.model, config.calibration = velodyne_decoder.hdl64e.detect_hdl64e(
                str(capture.path)
            )
        except ValueError as error:
            raise InputError(
                f"{capture.path}: of an HDL-64E, but its calibration is not whole in it "
                f"({error}): record for some seconds more, or give ?model="
            ) from error
    else:
        config.model = _model(velodyne_decoder, capture)
    return velodyne_decoder, config


def _model(library: Any, capture: Capture) -> Any:
    """Return the model that the library sees in the packets."""
    decoder = library.ScanDecoder(library.Config())
    turn = library.PacketVector()
    turn.append(library.VelodynePacket(0.0, capture.packets(np.arange(1))[0]))
    try:
        decoder.decode(turn)
    except (RuntimeError, ValueError) as error:
        raise InputError(
            f"{capture.path}: of a LiDAR of kind {capture.model}: {error}; give ?model="
        ) from error
    return decoder.model_id


def _whole(turns: list[NDArray[np.int64]], notes: list[str]) -> list[NDArray[np.int64]]:
    """Leave out what is less than half a turn at the begin and the end."""
    usual = float(np.median([len(turn) for turn in turns]))
    first = 1 if len(turns) > 2 and len(turns[0]) < WHOLE * usual else 0
    last = len(turns) - (1 if len(turns) > 2 and len(turns[-1]) < WHOLE * usual else 0)
    if last - first < len(turns):
        notes.append("parts of turns at the begin or the end are left out")
    return turns[first:last]
