"""What a player (`ours.py`, `peer_launcher.py`) leaves of one run over one recording."""

import hashlib
import json
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from odomap.errors import OdomapError
from odomap.evaluation.metrics import Alignment, ate
from odomap.files.trajectories import read_tum
from odomap.geometry.trajectory import Trajectory

SKIPPED = 5
"""Frames at the start that do not count in the times per frame, on either side."""


@dataclass(frozen=True)
class Played:
    """What one run left.

    Attributes:
        frames: how many were played.
        tracked: how many have a pose.
        ms: milliseconds of each call of `track`.
        cpu_s: processor seconds of all calls and what ran beside them.
        peak_memory_mb: of the process.
        threads: the most that were alive after a frame.
        cv_threads: that OpenCV uses, as seen from Python.
        path: the TUM file of the trajectory.
        lost: frames that could not be placed, once tracking had begun.
        stall_ms: of each frame, what mapping beside the tracker cost it: waiting, reading, writing.
    """

    frames: int
    tracked: int
    ms: list[float]
    cpu_s: float
    peak_memory_mb: float
    threads: int
    cv_threads: int
    path: Path
    lost: int = 0
    stall_ms: list[float] = field(default_factory=list)

    def trajectory(self) -> Trajectory:
        """Return the path of the system."""
        return read_tum(self.path)

    def numbers(self, truth: Trajectory, align: Alignment = "se3") -> dict[str, float]:
        """Return what is compared, by name; the error is infinite where there is no path."""
        counted = self.ms[SKIPPED:] or self.ms
        try:
            error = ate(self.trajectory(), truth, align).rmse
        except OdomapError as why:
            print(f"no error can be computed: {why}", file=sys.stderr)
            error = float("inf")
        numbers = {
            "ate_m": error,
            "frames": self.frames,
            "tracked": self.tracked,
            "lost": self.lost,
            "ms_mean": float(np.mean(counted)),
            "ms_median": float(np.median(counted)),
            "ms_p95": float(np.percentile(counted, 95)),
            "cpu_s": self.cpu_s,
            "peak_memory_mb": self.peak_memory_mb,
            "threads": self.threads,
            "cv_threads": self.cv_threads,
            "digest": self.digest(),
        }
        if self.stall_ms:
            stalls = self.stall_ms[SKIPPED:] or self.stall_ms
            numbers["stall_p99"] = float(np.percentile(stalls, 99))
        return numbers

    def digest(self) -> float:
        """Return a number that two trajectories share if they have the same bytes."""
        return float(int.from_bytes(hashlib.sha256(self.path.read_bytes()).digest()[:6], "big"))


def play(command: list[str], prefix: Path, what: str) -> Played:
    """Run a player that writes PREFIX.json and PREFIX.tum, and read them.

    A failure ends the benchmark with the last it said.
    """
    meters, path = Path(f"{prefix}.json"), Path(f"{prefix}.tum")
    meters.unlink(missing_ok=True)
    path.unlink(missing_ok=True)
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0 or not meters.exists():
        said = (done.stderr or done.stdout).strip()[-2000:]
        sys.exit(f"{what} failed with exit code {done.returncode}:\n{said}")
    return Played(**json.loads(meters.read_text(encoding="utf-8")), path=path)
