"""Readers stream: what they hold does not grow with what they have read."""

import gc
import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from odomap.sources.disturb import blur, drop, freeze, reverse, there_and_back
from odomap.sources.open import open as open_source
from odomap.sources.source import Source

SIZE = (320, 240)
PAIR_BYTES = 2 * SIZE[0] * SIZE[1]

WRAPPERS: dict[str, Callable[[Source], Source]] = {
    "plain": lambda source: source,
    "blur": lambda source: blur(source, range(0, 200, 3)),
    "drop": lambda source: drop(source, range(0, 200, 3)),
    "freeze": lambda source: freeze(source, range(0, 200, 3)),
    "reverse": reverse,
    "there_and_back": there_and_back,
}


@pytest.fixture
def recording(euroc: Callable[..., Path], save_image: Callable[..., None]) -> Path:
    """Return a EuRoC recording of 120 frames of 320x240."""
    mav0 = euroc(frames=120)
    rng = np.random.default_rng(0)
    for camera in ("cam0", "cam1"):
        calibration = mav0 / camera / "sensor.yaml"
        text = calibration.read_text().replace("[64, 48]", str(list(SIZE)))
        calibration.write_text(text.replace("50.0, 50.0, 32.0, 24.0", "250.0, 250.0, 160.0, 120.0"))
        image = rng.integers(0, 255, SIZE[::-1], dtype=np.uint8)
        save_image(mav0 / "image.png", image)
        for file in (mav0 / camera / "data").iterdir():
            file.write_bytes((mav0 / "image.png").read_bytes())
    return mav0


def held(source: Source) -> Iterator[int]:
    """Yield the bytes held after each frame."""
    for _ in source:
        yield tracemalloc.get_traced_memory()[0]


@pytest.mark.parametrize("wrapper", WRAPPERS)
def test_memory_does_not_grow_with_the_frames(recording: Path, wrapper: str) -> None:
    source = WRAPPERS[wrapper](open_source(recording))
    gc.collect()
    tracemalloc.start()
    try:
        sizes = list(held(source))
        peak = tracemalloc.get_traced_memory()[1] - min(sizes)
    finally:
        tracemalloc.stop()
    assert len(sizes) >= 80
    # A few pairs at a time (the frame, the one before it, decoding), however many there are.
    assert peak < 8 * PAIR_BYTES
    # The last frames hold no more than the first ones, not even part of an image.
    assert max(sizes[-40:]) - max(sizes[:40]) < PAIR_BYTES // 8


def test_an_open_recording_is_small(recording: Path) -> None:
    gc.collect()
    tracemalloc.start()
    try:
        source = open_source(recording)
        gc.collect()
        size = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    imu_and_truth = 1210 * 56 + 246 * (128 + 8)
    # Stamps and names; the allowance is for what Python keeps of the modules.
    assert size < imu_and_truth + len(source) * 500 + 200_000
    assert size < 4 * PAIR_BYTES


def test_memory_does_not_grow_with_a_video(clip: Callable[..., Path]) -> None:
    source = open_source(clip("clip.avi", code="MJPG", frames=120, size=SIZE))
    gc.collect()
    tracemalloc.start()
    try:
        sizes = list(held(source))
        peak = tracemalloc.get_traced_memory()[1] - min(sizes)
    finally:
        tracemalloc.stop()
    assert len(sizes) == 120
    # In colour and grey; what FFmpeg keeps is not counted here.
    assert peak < 8 * PAIR_BYTES
    assert max(sizes[-40:]) - max(sizes[:40]) < PAIR_BYTES // 8


def test_memory_does_not_grow_with_depth(tum: Callable[..., Path]) -> None:
    source = open_source(tum(frames=80))
    gc.collect()
    tracemalloc.start()
    try:
        sizes = list(held(source))
    finally:
        tracemalloc.stop()
    # Not even one depth image of four bytes a pixel, though the list of sizes grows.
    assert max(sizes[-30:]) - max(sizes[:30]) < 4 * 64 * 48
