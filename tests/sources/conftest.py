"""Small recordings of every kind, written for a test and then broken by it."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

START_NS = 1403636584763555584
STEP_NS = 50_000_000
SIZE = (64, 48)

SENSOR = """%YAML:1.0
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [1.0, 0.0, 0.0, {x},
         0.0, 1.0, 0.0, 0.02,
         0.0, 0.0, 1.0, 0.03,
         0.0, 0.0, 0.0, 1.0]
rate_hz: 20
resolution: [64, 48]
camera_model: pinhole
intrinsics: [50.0, 50.0, 32.0, 24.0]
distortion_model: radial-tangential
distortion_coefficients: [-0.1, 0.01, 0.0001, 0.0002]
"""
IMU = """sensor_type: imu
T_BS:
  cols: 4
  rows: 4
  data: [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]
rate_hz: 200
gyroscope_noise_density: 1.6968e-04
gyroscope_random_walk: 1.9393e-05
accelerometer_noise_density: 2.0000e-3
accelerometer_random_walk: 3.0000e-3
"""


def picture(index: int, camera: int, size: tuple[int, int] = SIZE) -> NDArray[np.uint8]:
    """Return a textured image whose first pixels say which it is."""
    rng = np.random.default_rng((index, camera))
    image = rng.integers(40, 200, (size[1], size[0]), dtype=np.uint8)
    image[:4, :4] = index % 256
    image[:4, 4:8] = camera
    return image


def save(path: Path, image: NDArray[np.generic]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    done, data = cv2.imencode(path.suffix, image)
    assert done
    path.write_bytes(data.tobytes())


def write_euroc(root: Path, frames: int = 6, cameras: int = 2) -> Path:
    """Write a EuRoC recording and return its `mav0`."""
    mav0 = root / "mav0"
    stamps = [START_NS + i * STEP_NS for i in range(frames)]
    for camera in range(cameras):
        folder = mav0 / f"cam{camera}"
        rows = ["#timestamp [ns],filename"]
        for index, stamp in enumerate(stamps):
            save(folder / "data" / f"{stamp}.png", picture(index, camera))
            rows.append(f"{stamp},{stamp}.png")
        (folder / "data.csv").write_text("\n".join(rows) + "\n")
        (folder / "sensor.yaml").write_text(SENSOR.format(x=0.11 * camera))
    (mav0 / "imu0").mkdir()
    (mav0 / "imu0" / "sensor.yaml").write_text(IMU)
    samples = [
        f"{START_NS - STEP_NS + k * STEP_NS // 10},{k},0,0,9.8,0,0" for k in range(frames * 10 + 10)
    ]
    (mav0 / "imu0" / "data.csv").write_text("#header\n" + "\n".join(samples) + "\n")
    truth = mav0 / "state_groundtruth_estimate0" / "data.csv"
    truth.parent.mkdir()
    poses = [
        f"{START_NS + k * STEP_NS // 2},{k / 2},0,0,1,0,0,0" for k in range(-2, 2 * frames + 2)
    ]
    truth.write_text("#header\n" + "\n".join(poses) + "\n")
    return mav0


def write_kitti(root: Path, frames: int = 6, pair: tuple[int, ...] = (0, 1)) -> Path:
    """Write a KITTI sequence and return its folder; camera c stands 0.5 m right of camera c - 1."""
    for number in pair:
        for index in range(frames):
            save(root / f"image_{number}" / f"{index:06d}.png", picture(index, number))
    rows = []
    for number in range(4):
        row = [50, 0, 32, -25.0 * number, 0, 50, 24, 0, 0, 0, 1, 0]
        rows.append(f"P{number}: " + " ".join(f"{value:.12e}" for value in row))
    (root / "calib.txt").write_text("\n".join(rows) + "\n")
    (root / "times.txt").write_text("".join(f"{0.1 * i:e}\n" for i in range(frames)))
    (root / "poses.txt").write_text(
        "".join(f"1 0 0 0 0 1 0 0 0 0 1 {1.5 * i}\n" for i in range(frames))
    )
    return root


TUM_START_NS = 1305031229_500_000_000
TUM_RIG = """odomap_rig: 1
cameras:
  - {name: rgb, intrinsics: [60, 60, 32, 24], distortion: [0.1, -0.2, 0, 0], resolution: [64, 48]}
depth: {camera: rgb, factor: 5000.0, invalid: [0, 65535]}
"""


def depth_picture(index: int, factor: float = 5000.0) -> NDArray[np.uint16]:
    """Return a slope from 0.8 to 3 m with a hole, an overflow, and the number of the frame."""
    slope = np.linspace(0.8, 3, SIZE[0])[None, :].repeat(SIZE[1], 0)
    image = np.round(slope * factor).astype(np.uint16)
    image[10:14, 10:14] = 0
    image[20:22, 20:22] = 65535
    image[0, 0] = 5000 + index
    return image


def write_tum(root: Path, frames: int = 8, lag_ns: int = 3_000_000, factor: float = 5000.0) -> Path:
    """Write a TUM recording whose depth comes 3 ms after colour, and return its folder."""

    def stamp(index: int, offset_ns: int = 0) -> str:
        ns = TUM_START_NS + round(index * 1e9 / 30) + offset_ns
        return f"{ns // 10**9}.{ns % 10**9 // 1000:06d}"

    colour, depth, truth = ["# color images"], ["# depth maps"], ["# ground truth"]
    for i in range(frames):
        grey = picture(i, 0)
        save(root / f"rgb/{stamp(i)}.png", np.dstack([grey // 2, grey, grey]))
        save(root / f"depth/{stamp(i, lag_ns)}.png", depth_picture(i, factor))
        colour.append(f"{stamp(i)} rgb/{stamp(i)}.png")
        depth.append(f"{stamp(i, lag_ns)} depth/{stamp(i, lag_ns)}.png")
        truth.append(f"{stamp(i, 1000)} {i / 10} 0 0 0 0 0 1")
    truth.append(f"{stamp(frames)} {frames / 10} 0 0 0 0 0 1")
    (root / "rgb.txt").write_text("\n".join(colour) + "\n")
    (root / "depth.txt").write_text("\n".join(depth) + "\n")
    (root / "groundtruth.txt").write_text("\n".join(truth) + "\n")
    (root / "rig.yaml").write_text(TUM_RIG)
    return root


@pytest.fixture
def tum(tmp_path: Path) -> Callable[..., Path]:
    return lambda name="desk", **options: write_tum(tmp_path / name, **options)


@pytest.fixture
def draw_depth() -> Callable[..., NDArray[np.uint16]]:
    return depth_picture


@pytest.fixture
def euroc(tmp_path: Path) -> Callable[..., Path]:
    return lambda **options: write_euroc(tmp_path / "MH_00", **options)


@pytest.fixture
def kitti(tmp_path: Path) -> Callable[..., Path]:
    return lambda **options: write_kitti(tmp_path / "07", **options)


@pytest.fixture
def save_image() -> Callable[[Path, NDArray[np.generic]], None]:
    return save


@pytest.fixture
def draw() -> Callable[..., NDArray[np.uint8]]:
    return picture


def write_clip(
    path: Path,
    frames: int = 12,
    code: str = "mp4v",
    size: tuple[int, int] = (128, 96),
    rate_hz: float = 30.0,
) -> Path:
    """Write a video whose frames say which they are (`number_of`), and its rig.yaml beside it."""
    writer = cv2.VideoWriter(
        str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*code), rate_hz, size
    )
    assert writer.isOpened()
    ground = np.random.default_rng(0).integers(60, 190, (size[1] // 8, size[0] // 8), np.uint8)
    for index in range(frames):
        image = np.roll(ground, index, 1).repeat(8, 0).repeat(8, 1)
        for bit in range(8):
            image[:8, 8 * bit : 8 * bit + 8] = 255 * (index >> bit & 1)
        # Blue, green, red: a red that says what colour is.
        writer.write(np.dstack([image // 2, image, image]))
    writer.release()
    write_camera(path.with_name("rig.yaml"), size)
    return path


def write_camera(path: Path, size: tuple[int, int], rate_hz: float = 30.0) -> Path:
    """Write a rig.yaml of one camera."""
    width, height = size
    path.write_text(
        f"""odomap_rig: 1
cameras:
  - {{name: cam, intrinsics: [{width}, {width}, {width / 2}, {height / 2}],
     resolution: [{width}, {height}], rate_hz: {rate_hz}}}
"""
    )
    return path


@pytest.fixture
def clip(tmp_path: Path) -> Callable[..., Path]:
    return lambda name="clip.mp4", **options: write_clip(tmp_path / name, **options)


@pytest.fixture
def calibrate() -> Callable[..., Path]:
    return write_camera


@pytest.fixture
def number_of() -> Callable[[NDArray[np.uint8]], int]:
    """Return which frame of a clip an image is."""

    def number(image: NDArray[np.uint8]) -> int:
        bits = [image[2:6, 8 * bit + 2 : 8 * bit + 6].mean() > 127 for bit in range(8)]
        return sum(int(is_set) << bit for bit, is_set in enumerate(bits))

    return number
