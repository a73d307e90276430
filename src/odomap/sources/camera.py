"""Live cameras: frames as they come, the newest first, the stale ones dropped.

    camera:0                                  the first camera; also camera:/dev/video2
    camera:0?width=640&height=480&fps=30      asked for; by default what the calibration says
    camera:/path/to/clip.mp4                  a file played as if it were a camera, at its own rate

A driver buffers a few frames, and gives the oldest first: who is slower than the camera would
see the past, later with every frame. So before a frame is taken, buffered ones are thrown away:
one is fresh if the driver says that it is younger than a period, or if it had to be waited for.
No thread is needed for that, since waiting for a camera is all there is to do meanwhile.

A frame's stamp is the system's clock when it was taken: now, less its age where the driver tells
that. The number of frames is unknown, so the length is 0. A camera that is unplugged ends the
stream with a note, and what was computed stays.

Reference: Linux kernel documentation, "Video for Linux API", streaming I/O (buffers and their
monotonic time stamps).
"""

import time
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import parse_qsl

from odomap.errors import InputError, nearest_name
from odomap.geometry.trajectory import Trajectory
from odomap.sensors.frame import Frame
from odomap.sensors.rig import CameraMount, Rig
from odomap.sources.calibration import find_rig, one_camera
from odomap.sources.capture import to_grey
from odomap.sources.devices import BUFFERS, Device, FileDevice, VideoDevice
from odomap.sources.source import Skipped

__all__ = ["PREFIX", "CameraSource"]

PREFIX = "camera:"
OPTIONS = ("width", "height", "fps")
TRIES = 10
PAUSE_S = 0.1
"""A camera that gives no frame is asked again so often, so far apart."""
WAITED = 0.1
"""A grab that took that share of a period found no frame buffered."""


class CameraSource:
    """The frames of a live camera, as they come.

    Attributes:
        details: facts for people: device, backend, size.
    """

    def __init__(self, spec: str, rig: Rig | None = None) -> None:
        """Open a camera.

        Args:
            spec: "camera:0", "camera:/dev/video0", "camera:clip.mp4", with options behind a '?'.
            rig: its calibration; without it, what lies beside a file, as for a video, or the
                rig.yaml in the folder one is in.

        Raises:
            InputError: it cannot be opened or gives no frames, or an option is unknown.
            CalibrationError: there is no calibration, or it is for another resolution.
        """
        self.name = spec
        self._place, self._asked = _parse(spec)
        here = [Path("rig.yaml")]
        if Path(self._place).is_file():  # as for a video that is not played as a camera
            file = Path(self._place)
            here = [file.with_suffix(".rig.yaml"), file.with_name("rig.yaml"), *here]
        self.rig = one_camera(find_rig(rig, here, spec), spec)
        self.truth: Trajectory | None = None
        self.skipped: list[Skipped] = []
        self.notes: list[str] = []
        self._device: Device | None = self._open()
        self.details = dict(self._device.details)

    def _open(self) -> Device:
        return _open_device(self._place, self.rig.cameras[0], self._asked)

    def __len__(self) -> int:
        """Return 0: nobody knows how many frames will come."""
        return 0

    def __repr__(self) -> str:
        return f"CameraSource({self.name})"

    def __iter__(self) -> Iterator[Frame]:
        """Yield the newest frame, again and again, until the camera gives none any more."""
        device, self._device = self._device or self._open(), None
        self.skipped, self.notes = [], []
        watch = _Watch(device)
        offset_ns = round(self.rig.cameras[0].time_offset_s * 1e9)
        index = 0
        try:
            while (taken_ns := watch.take()) is not None:
                image = device.image()
                stamp_ns = taken_ns + offset_ns
                if image is None:
                    self.skipped.append(Skipped(stamp_ns, self.name, "cannot be decoded"))
                    continue
                yield Frame(index, stamp_ns, (to_grey(image),))
                index += 1
        finally:
            device.close()
            self.notes += watch.notes(index)


class _Watch:
    """Takes the newest frames of a device, and says when."""

    def __init__(self, device: Device) -> None:
        self._device = device
        self._period_s = 1 / device.rate_hz
        self._dropped = 0
        self._is_lost = False
        self._waited_s: float | None = None
        self._since = 0
        self._last_ns = 0
        # Seconds may leap when the system's clock is set: it is read once.
        self._epoch_ns = time.time_ns() - time.monotonic_ns()

    def take(self) -> int | None:
        """Take the newest frame; return when it was exposed, or None if no frame comes any more."""
        for attempt in range(TRIES):
            if self._newest():
                age_s = self._device.age_s() or 0.0
                stamp_ns = self._epoch_ns + time.monotonic_ns() - round(age_s * 1e9)
                self._last_ns = max(stamp_ns, self._last_ns + 1)
                return self._last_ns
            if self._device.has_ended:
                return None
            if attempt < TRIES - 1:
                time.sleep(PAUSE_S)
        self._is_lost = True
        return None

    def _newest(self) -> bool:
        """Take buffered frames until one is fresh."""
        for behind in range(BUFFERS + 1):
            before_s = time.monotonic()
            if not self._device.grab():
                return False
            if self._is_fresh(before_s) or behind == BUFFERS:
                return True
            self._dropped += 1
        return True

    def _is_fresh(self, before_s: float) -> bool:
        """Tell whether no newer frame can be there than the one grabbed since a time."""
        age_s = self._device.age_s()
        if age_s is not None:
            return age_s <= self._period_s
        # Count from the last frame that had to be waited for, which came when it was grabbed.
        now_s = time.monotonic()
        if now_s - before_s > WAITED * self._period_s:
            self._waited_s, self._since = now_s, 0
            return True
        self._since += 1
        if self._waited_s is None:
            return False
        return int((now_s - self._waited_s) / self._period_s) <= self._since

    def notes(self, frames: int) -> list[str]:
        """Return what the user should know at the end, after so many frames."""
        notes = []
        if self._dropped:
            notes.append(
                f"{self._dropped} frames grew stale while those before them were worked on: dropped"
            )
        if self._is_lost:
            notes.append(
                f"{self._device.label} gave no frame for {TRIES * PAUSE_S:g} s after "
                f"{frames} frames: was it unplugged? What was computed until then stays"
            )
        return notes


def _parse(spec: str) -> tuple[str, dict[str, float]]:
    """Return which device a spec means, and what is asked of it."""
    place, _, query = spec.removeprefix(PREFIX).partition("?")
    asked = {}
    for name, text in parse_qsl(query, keep_blank_values=True):
        if name not in OPTIONS:
            hint = nearest_name(name, OPTIONS) or f" (known are {', '.join(OPTIONS)})"
            raise InputError(f"{spec}: unknown option '{name}'{hint}")
        try:
            asked[name] = float(text)
        except ValueError:
            raise InputError(f"{spec}: {name} must be a number, not '{text}'") from None
        if not 0 < asked[name] < 1e6:
            raise InputError(f"{spec}: {name} must be positive, not {text}")
    return place or "0", asked


def _open_device(place: str, mount: CameraMount, asked: dict[str, float]) -> Device:
    if place.isdigit():
        return VideoDevice(int(place), mount, asked)
    if Path(place).is_file():
        if asked:
            raise InputError(f"{place}: is a file, which is played as it is: leave the options out")
        return FileDevice(Path(place), mount)
    if Path(place).suffix and not Path(place).exists():
        raise InputError(f"{place}: there is no such file to play as a camera")
    return VideoDevice(place, mount, asked)
