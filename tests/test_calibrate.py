"""Calibration as a person does it: pictures on a disk, one command, rig.yaml and a picture back."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from odomap.calibrate import CalibrationResult, calibrate
from odomap.cli import main
from odomap.errors import CalibrationError, InputError
from odomap.files.rig import read_rig
from odomap.geometry.camera import Camera
from odomap.geometry.pose import SE3
from odomap.simulation.board import (
    BoardViews,
    board_pose,
    board_views,
    render_board,
    write_board_views,
)
from odomap.vision.board import Board

SIZE = (640, 480)
PINHOLE = Camera("pinhole", (520.0, 518.0, 325.0, 236.0), (-0.28, 0.09, 0.0005, -0.0003), SIZE)
RIGHT = Camera("pinhole", (515.0, 514.0, 318.0, 242.0), (-0.27, 0.08, -0.0005, 0.0003), SIZE)
FISHEYE = Camera(
    "kannala_brandt", (230.0, 229.0, 322.0, 238.0), (0.02, -0.006, 0.002, -0.0005), SIZE
)  # fmt: skip
SPHERE = Camera("double_sphere", (190.0, 189.5, 322.0, 238.0), (-0.2, 0.58), SIZE)
T_LEFT_RIGHT = SE3.exp([0.11, 0.001, -0.002, 0.01, -0.02, 0.005])
BOARD = ("--board", "9x6", "--square", "0.025")
SMALL = Camera("pinhole", (260.0, 259.0, 162.0, 118.0), (-0.2, 0.05, 0.0, 0.0), (320, 240))


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(monkeypatch, tmp_path):
    monkeypatch.delenv("ODOMAP_DEBUG", raising=False)
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="session")
def small() -> BoardViews:
    """Fourteen small pictures, taken well."""
    return board_views(SMALL, seed=3, count=14)


@pytest.fixture
def pictures(small: BoardViews, tmp_path: Path) -> Path:
    return write_board_views(small, tmp_path / "pictures")


@pytest.fixture
def cli(capsys):
    def call(*words: object) -> tuple[int, str, str]:
        code = main(["calibrate", *map(str, words)])
        out, err = capsys.readouterr()
        assert "Traceback" not in out + err
        return code, out, err

    return call


@pytest.fixture
def refused(cli):
    """Run the command line and expect bad input: exit code 2, one line, and nothing written."""

    def call(*words: object, code: int = 2) -> str:
        found, out, err = cli(*words)
        lines = [line for line in err.splitlines() if line.startswith("odomap: ")]
        assert found == code, err
        assert len(lines) == 1, err
        assert "internal error" not in lines[0]
        assert out == ""
        assert not Path("rig.yaml").exists()
        return lines[0]

    return call


def found_in(views: BoardViews, folder: Path, model: str = "pinhole") -> CalibrationResult:
    """Calibrate from files; the picture is drawn elsewhere, it takes as long as all the rest."""
    write_board_views(views, folder)
    if views.right_images:
        return calibrate(folder / "left", folder / "right", model=model)
    return calibrate(folder, model=model)


# ---- the bars: known cameras, two of the five seeds that docs/calibration.md tells of ----

SEEDS = (0, 3)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("truth", [PINHOLE, FISHEYE], ids=["pinhole", "fisheye"])
def test_rendered_boards_give_the_camera_back(truth: Camera, seed: int, tmp_path: Path) -> None:
    result = found_in(board_views(truth, seed, 16), tmp_path, truth.model)
    camera = result.rig.cameras[0].camera
    assert np.abs(camera.intrinsics[:2] / truth.intrinsics[:2] - 1.0).max() < 2e-3
    assert np.abs(camera.intrinsics[2:] - truth.intrinsics[2:]).max() < 1.0
    assert result.calibration.rms_px[0] < 0.1
    assert result.counts[0][2] >= 15


@pytest.mark.parametrize("seed", SEEDS)
def test_a_double_sphere_maps_every_ray_as_the_truth_does(seed: int, tmp_path: Path) -> None:
    """Its focal length trades off against xi: what counts is where rays end."""
    result = found_in(board_views(SPHERE, seed, 16), tmp_path, "double_sphere")
    camera = result.rig.cameras[0].camera
    u, v = np.meshgrid(np.arange(60, 600, 20.0), np.arange(60, 440, 20.0))
    pixels = np.column_stack([u.ravel(), v.ravel()])
    error = np.linalg.norm(camera.project(SPHERE.unproject(pixels)) - pixels, axis=1)
    assert np.median(error) < 0.1
    assert error.max() < 0.5
    assert np.abs(camera.intrinsics[:2] / SPHERE.intrinsics[:2] - 1.0).max() < 1e-2
    assert np.abs(camera.intrinsics[2:] - SPHERE.intrinsics[2:]).max() < 1.0


@pytest.mark.parametrize("seed", SEEDS)
def test_rendered_pairs_give_the_baseline_back(seed: int, tmp_path: Path) -> None:
    views = board_views(PINHOLE, seed, 10, right=RIGHT, T_left_right=T_LEFT_RIGHT)
    left, right = found_in(views, tmp_path).rig.stereo_pair()
    assert left.T_body_camera == SE3.identity()
    T = right.T_body_camera
    assert np.linalg.norm(T.t) == pytest.approx(np.linalg.norm(T_LEFT_RIGHT.t), rel=2e-3)
    assert np.abs((T_LEFT_RIGHT.inverse() @ T).log()).max() < 2e-3
    for mount, truth in ((left, PINHOLE), (right, RIGHT)):
        assert np.abs(mount.camera.intrinsics[:2] / truth.intrinsics[:2] - 1).max() < 2e-3
        assert np.abs(mount.camera.intrinsics[2:] - truth.intrinsics[2:]).max() < 1.0


# ---- the command ----


def test_one_command_writes_a_rig_and_a_picture(cli, pictures: Path) -> None:
    code, out, err = cli(pictures, *BOARD)
    assert code == 0, err
    rows = {line[:16].strip(): line[17:] for line in out.splitlines()}
    camera = read_rig("rig.yaml").cameras[0].camera
    assert rows["camera"] == "pinhole, 320x240"
    assert rows["focal length"].startswith(f"fx {camera.fx:.2f} ± 0.")
    assert rows["centre"].startswith(f"cx {camera.cx:.2f} ± 0.")
    assert rows["distortion"].startswith("k1 -0.")
    assert rows["reprojection"].endswith("px RMS")
    assert rows["views"] == "14 used, 14 with the 9x6 board, 14 pictures"
    assert (rows["rig"], rows["picture"]) == ("rig.yaml", "calibration.png")
    assert np.abs(camera.intrinsics / SMALL.intrinsics - 1).max() < 5e-3
    image = cv2.imread("calibration.png")
    assert image.shape[0] > 600
    assert image.shape[1] > 1000
    # Paper, and a plausible amount of ink on every quarter of it.
    ink = image.min(axis=2) < 200
    h, w = ink.shape[0] // 2, ink.shape[1] // 2
    shares = [part.mean() for half in (ink[:h], ink[h:]) for part in (half[:, :w], half[:, w:])]
    assert min(shares) > 0.005
    assert max(shares) < 0.6


def test_a_pattern_or_files_do_as_well_as_a_folder(cli, pictures: Path) -> None:
    expected = calibrate(pictures).rig
    assert calibrate(f"{pictures}/board_*.png").rig == expected
    code, _, err = cli(*sorted(pictures.iterdir()), *BOARD, "--out", "phone.yaml")
    assert code == 0, err
    assert read_rig("phone.yaml") == expected
    assert Path("phone.calibration.png").exists()


def test_a_pair_is_two_folders(cli, tmp_path: Path) -> None:
    views = board_views(SMALL, 1, 7, right=SMALL, T_left_right=T_LEFT_RIGHT)
    write_board_views(views, tmp_path)
    blank = np.full((240, 320), 90, np.uint8)
    cv2.imwrite("right/board_004.png", blank)
    code, out, err = cli("left", "right", *BOARD)
    assert code == 0, err
    assert "baseline         0.1" in out
    assert "6 used, 6 with the 9x6 board, 7 pictures" in out
    assert "7 used" in out
    read_rig("rig.yaml").stereo_pair()
    code, _, err = cli("right", "left", *BOARD, "--out", "swapped.yaml")
    assert code == 2
    assert "the pair is swapped" in err
    assert not Path("swapped.yaml").exists()


def test_a_video_is_looked_through_for_views_that_differ(cli, tmp_path: Path) -> None:
    """A board wanders about: many frames, most of them much like their neighbours."""
    board = Board(9, 6, 0.025)
    corners = [(90, 70), (230, 70), (220, 175), (100, 170), (160, 120), (90, 70)]
    writer = cv2.VideoWriter("clip.avi", cv2.VideoWriter.fourcc(*"MJPG"), 15.0, (320, 240))
    frames = 30
    for k in range(frames):
        s = (len(corners) - 1) * k / frames
        i = int(s)
        at = (1 - s + i) * np.array(corners[i]) + (s - i) * np.array(corners[i + 1])
        tilt = (0.6 * np.cos(0.35 * k), 0.6 * np.sin(0.35 * k))
        T = board_pose(SMALL, board, (float(at[0]), float(at[1])), 0.45, tilt)
        image = render_board(SMALL, T, board, seed=1) if k % 10 else np.zeros((240, 320), np.uint8)
        writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    writer.release()
    code, _, err = cli("clip.avi", *BOARD)
    assert code == 0, err
    camera = read_rig("rig.yaml").cameras[0].camera
    assert np.abs(camera.intrinsics / SMALL.intrinsics - 1).max() < 1e-2
    data = Path("clip.avi").read_bytes()
    Path("cut.avi").write_bytes(data[: int(0.7 * len(data))])
    assert "cut.avi: the file is cut: it ends after" in calibrate("cut.avi").warnings[0]
    Path("no.avi").write_bytes(b"RIFF0000AVI LIST")
    code, _, err = cli("no.avi", *BOARD, "--out", "no.yaml")
    assert code == 2
    assert err.startswith("odomap: no.avi")


# ---- bad input ----


def test_a_board_never_seen_is_named_by_what_is_seen(refused, pictures: Path) -> None:
    for file in sorted(pictures.iterdir())[4:]:  # not to find takes long
        file.unlink()
    message = refused(pictures, "--board", "10x7", "--square", "0.025")
    assert "a 10x7 board is seen in none of 4 pictures" in message
    assert "looks like a 9x6 board: give --board 9x6" in message


def test_pictures_without_any_board(refused, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    Path("empty").mkdir()
    assert "no pictures in it" in refused("empty", *BOARD)
    for k in range(4):
        cv2.imwrite(f"empty/{k}.png", rng.integers(90, 99, (120, 160)).astype(np.uint8))
    message = refused("empty", *BOARD)
    assert "seen in none of 4 pictures" in message
    assert "INNER corners" in message


def test_bricks_are_not_taken_for_a_board(refused) -> None:
    from odomap.simulation.world import World

    world = World.make(kind="room", seed=4, frames=50, sensors=("mono",))
    Path("walk").mkdir()
    for k in range(0, 48, 8):
        cv2.imwrite(f"walk/{k}.png", world.frame(k).images[0])
    assert "and are there 9x6 INNER corners?" in refused("walk", *BOARD)


def test_too_few_views(refused, pictures: Path) -> None:
    files = sorted(pictures.iterdir())
    assert "seen in only 2 of 2 pictures: 3 are the least" in refused(*files[:2], *BOARD)


def test_all_boards_in_one_place(refused, pictures: Path) -> None:
    first = sorted(pictures.iterdir())[5].read_bytes()
    for file in pictures.iterdir():
        file.write_bytes(first)
    assert "all 14 boards are in one place: move the board" in refused(pictures, *BOARD)


def test_boards_never_tilted(refused, tmp_path: Path) -> None:
    board, folder = Board(9, 6, 0.025), Path("flat")
    folder.mkdir()
    for k, (x, y, z) in enumerate([(0.0, 0.0, 0.35), (0.05, 0.03, 0.4), (-0.08, 0.02, 0.45),
                                   (0.03, -0.05, 0.5), (-0.02, 0.04, 0.36)]):  # fmt: skip
        T = SE3.from_parts(np.eye(3), np.array([x - 0.1, y - 0.0625, z]))
        cv2.imwrite(str(folder / f"{k}.png"), render_board(SMALL, T, board, seed=k))
    assert "do not determine the focal length" in refused(folder, *BOARD)


def test_pictures_of_two_sizes(refused, pictures: Path) -> None:
    file = sorted(pictures.iterdir())[3]
    cv2.imwrite(str(file), cv2.rotate(cv2.imread(str(file)), cv2.ROTATE_90_CLOCKWISE))
    message = refused(pictures, *BOARD)
    assert "board_003.png: is 240x320, most pictures are 320x240" in message


def test_broken_pictures_are_skipped_and_told(cli, refused, pictures: Path) -> None:
    files = sorted(pictures.iterdir())
    files[2].write_bytes(files[2].read_bytes()[:3000])
    files[4].write_bytes(b"no picture")
    code, out, err = cli(pictures, *BOARD)
    assert code == 0
    assert "skipped board_002.png: PNG is truncated (and 1 more)" in err
    assert "12 used, 12 with the 9x6 board, 14 pictures" in out
    Path("rig.yaml").unlink()
    for file in files:
        file.write_bytes(b"no picture")
    assert "no image can be read" in refused(pictures, *BOARD)


def test_pairs_that_do_not_pair(refused, tmp_path: Path) -> None:
    views = board_views(SMALL, 1, 4, right=SMALL, T_left_right=T_LEFT_RIGHT)
    write_board_views(views, tmp_path)
    Path("right/board_002.png").rename("right/other.png")
    assert "'board_002.png' and 'board_003.png' do not pair" in refused("left", "right", *BOARD)
    Path("right/other.png").unlink()
    message = refused("left", "right", *BOARD)
    assert "4 and 3 pictures do not pair" in message
    assert "'board_002.png' has no partner in right" in message


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("pictures", "--board", "9x6", "--square", "25"), "is it in millimetres?"),
        (("pictures", "--board", "nine", "--square", "0.025"), "'nine' is not a size"),
        (("pictures", "--board", "2x6", "--square", "0.025"), "3x3 to 100x100"),
        (("nowhere", *BOARD), "nowhere: no such folder, video or picture"),
        (("nowhere/*.png", *BOARD), "no picture has such a name"),
        (("a/", "b/", "c/", *BOARD), "3 sets of pictures"),
        (("a/1.png", "b/1.png", *BOARD), "pictures of several folders"),
        (("pictures",), "--board is missing"),
        (("pictures", *BOARD, "--model", "fisheye"), "invalid choice 'fisheye'"),
        (("pictures", *BOARD, "--model", "double_sphere", "--k3"), "of the pinhole"),
        (BOARD, "IMAGES is missing"),
    ],
)
def test_bad_words(refused, words: tuple[str, ...], message: str) -> None:
    assert message in refused(*words)


def test_what_is_there_is_not_lost(cli, pictures: Path) -> None:
    Path("rig.yaml").write_text("odomap_rig: 1\nimu: {rate_hz: 200.0}\n")
    before = Path("rig.yaml").read_text()
    code, _, err = cli(pictures, *BOARD)
    assert code == 1
    assert "describes more than cameras" in err
    Path("notes.yaml").write_text("my: notes\n")
    code, _, err = cli(pictures, *BOARD, "--out", "notes.yaml")
    assert code == 1
    assert "is no rig.yaml" in err
    assert Path("rig.yaml").read_text() == before


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_cannot_be_written_is_told_before_the_search(cli, pictures: Path) -> None:
    Path("locked").mkdir(mode=0o500)
    code, _, err = cli(pictures, *BOARD, "--out", "locked/rig.yaml")
    assert code == 1
    assert "no permission" in err


# ---- the call ----


def test_progress_is_told_and_nothing_is_written_unasked(small, pictures: Path) -> None:
    told = []
    result = calibrate(pictures, progress=lambda *step: told.append(step))
    assert told[0][:2] == (0, 14)
    assert told[-1][2] == "solving"
    assert result.written == ()
    assert not Path("rig.yaml").exists()
    assert result.names[0][:2] == ("board_000.png", "board_001.png")
    assert np.abs(result.calibration.pixels[0] - small.pixels).max() < 1.0


def test_errors_are_of_the_house(pictures: Path) -> None:
    with pytest.raises(CalibrationError, match="'fisheye' is unknown"):
        calibrate(pictures, model="fisheye")
    with pytest.raises(InputError, match="no such folder"):
        calibrate("nowhere")
