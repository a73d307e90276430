"""Occupancy grids as files: what map_server would make of them, and what comes back."""

import cv2
import numpy as np
import pytest
import yaml

from lidar.rooms import ROOM, cast
from odomap.errors import InputError, OutputError
from odomap.files.grids import load_grid, save_grid
from odomap.lidar.branchbound import GridPyramid
from odomap.lidar.grid import Evidence, OccupancyGrid
from odomap.lidar.gridmatching import match_to_grid
from odomap.lidar.scans import Beams
from odomap.sensors.rig import LidarMount

LIMIT = Evidence().limit
FIELDS = {
    "image": "a.pgm", "resolution": 0.1, "origin": [-1.0, 2.0, 0.0], "negate": 0,
    "occupied_thresh": 0.65, "free_thresh": 0.196,
}  # fmt: skip


def written(folder, pixels, name="a.pgm", **fields):
    """Write a picture and its YAML as another program would; None leaves a field out."""
    data = pixels
    if not isinstance(pixels, bytes):
        pixels = np.asarray(pixels, np.uint8)
        data = bytes(cv2.imencode(".png" if name.endswith("png") else ".pgm", pixels)[1])
    (folder / name).write_bytes(data)
    content = {k: v for k, v in {**FIELDS, "image": name, **fields}.items() if v is not None}
    (folder / "a.yaml").write_text(yaml.safe_dump(content))
    return folder / "a.yaml"


def map_server(file):
    """Occupancy as ROS's map_server has it: (H, W) of 0 to 100 and -1, the least y first."""
    said = yaml.safe_load(file.read_text())
    pixels = cv2.imread(str(file.parent / said["image"]), cv2.IMREAD_GRAYSCALE)[::-1].astype(float)
    if said["mode"] == "raw":
        return np.where(pixels <= 100, pixels, -1).astype(int)
    p = (pixels if said["negate"] else 255 - pixels) / 255.0
    occupied, free = p > said["occupied_thresh"], p < said["free_thresh"]
    return np.where(occupied, 100, np.where(free, 0, -1))


def a_grid(seed=0):
    """A grid of all there can be: sure, doubted, and not known, with a border of the last."""
    rng = np.random.default_rng(seed)
    l = rng.uniform(-LIMIT, LIMIT, (23, 37)).astype(np.float32)  # noqa: E741
    l[rng.random(l.shape) < 0.3] = 0.0
    l[0, 0], l[-1, -1] = 4.0, -4.0
    return OccupancyGrid.of(np.pad(l, 5), np.array([-3.217, 1.4142]), 0.05)


def the_room():
    beams = Beams(LidarMount("laser", angles=(-np.pi, np.pi - 2 * np.pi / 720, 720)))
    grid, rng = OccupancyGrid(0.05), np.random.default_rng(0)
    for x in np.linspace(-1.5, 1.5, 12):
        seen = beams.points(
            cast(ROOM, (x, 0.3 * x, 0.0), np.linspace(-np.pi, np.pi, 721)[:-1], rng)
        )
        there = np.array([x, 0.3 * x])
        grid.insert(there, seen.hits + there, between=seen.between + there)
    return grid, beams


@pytest.mark.parametrize("mode", ["trinary", "raw"])
def test_map_server_reads_what_is_known_where_it_is(tmp_path, mode):
    grid = a_grid()
    file, image = save_grid(tmp_path / "a b#.yaml", grid, mode=mode)
    assert image.read_bytes().startswith(b"P5\n")
    said = yaml.safe_load(file.read_text())
    assert said["origin"][2] == said["negate"] == 0
    assert (said["occupied_thresh"], said["free_thresh"]) == (0.65, 0.196)
    seen = map_server(file)
    assert seen.shape == (23, 37)  # what is not known all around is left out
    rows, columns = np.indices(seen.shape)
    centres = np.column_stack([columns.ravel(), rows.ravel()]) + 0.5
    at = np.array(said["origin"][:2]) + centres * said["resolution"]
    p = grid.probability(at).reshape(seen.shape)
    known = grid.is_known[5:-5, 5:-5]
    if mode == "raw":
        np.testing.assert_allclose(seen[known], 100 * p[known], atol=0.5001)
        assert (seen[~known] == -1).all()
    else:
        np.testing.assert_array_equal(seen == 100, known & (p > 0.65))
        np.testing.assert_array_equal(seen == 0, known & (p < 0.35))


@pytest.mark.parametrize("mode", ["trinary", "raw"])
def test_what_is_saved_comes_back_and_is_saved_as_the_same_bytes(tmp_path, mode):
    grid = a_grid(1)
    first, again = tmp_path / "a.yaml", tmp_path / "b.yaml"
    save_grid(first, grid, mode=mode)
    back = load_grid(first)
    assert back.resolution == 0.05
    p, q = (1 / (1 + np.exp(-g.cropped().log_odds)) for g in (grid, back))
    known = grid.cropped().is_known
    if mode == "raw":
        np.testing.assert_array_equal(back.is_known, known)
        np.testing.assert_allclose(q, p, atol=0.00501)
    else:
        np.testing.assert_array_equal(back.log_odds > 0, known & (p > 0.65))
        np.testing.assert_array_equal(back.log_odds < 0, known & (p < 0.35))
        assert set(np.unique(back.log_odds)) == {-LIMIT, 0.0, LIMIT}
    np.testing.assert_array_equal(back.origin, grid.cropped().origin)
    save_grid(again, back, mode=mode)
    assert again.with_suffix(".pgm").read_bytes() == first.with_suffix(".pgm").read_bytes()
    assert again.read_text() == first.read_text().replace("a.pgm", "b.pgm")


def test_a_scan_is_found_in_a_grid_that_was_saved(tmp_path):
    grid, beams = the_room()
    save_grid(tmp_path / "room.yaml", grid)
    loaded = load_grid(tmp_path / "room.yaml")
    true = np.array([0.9, -0.4, 2.1])
    angles = np.linspace(-np.pi, np.pi, 721)[:-1]
    seen = beams.points(cast(ROOM, true, angles, np.random.default_rng(5)))
    points = np.concatenate([seen.hits, seen.between])
    normals = np.concatenate([seen.normals, np.zeros_like(seen.between)])
    found = GridPyramid(loaded).search(points, np.zeros(3), 3.0, np.pi, 0.4)
    exact = match_to_grid(loaded, points, normals, found.x_grid_body)
    assert np.hypot(*(exact.x_grid_body - true)[:2]) < 0.035  # half the diagonal of a cell
    assert abs(np.angle(np.exp(1j * (exact.x_grid_body - true)[2]))) < 0.01  # a cell at 5 m
    assert exact.on_walls > 0.9


def test_a_loaded_grid_goes_on_growing(tmp_path):
    grid, _ = the_room()
    save_grid(tmp_path / "room.yaml", grid)
    loaded = load_grid(tmp_path / "room.yaml")
    loaded.insert(np.array([3.0, 2.02]), np.array([[9.02, 2.02]]))
    assert loaded.probability(np.array([[9.02, 2.02], [6.02, 2.02]])).round(2).tolist() == [
        0.71,
        0.43,
    ]


@pytest.mark.parametrize("kind", ["P5", "P2", "png", "rgb.png", "negated", "comments", "half"])
def test_pictures_of_other_programs_are_read(tmp_path, kind):
    pixels = np.array([[0, 254, 205], [254, 254, 205]], np.uint8)
    fields, name = {}, "a.pgm"
    if kind == "P2":
        rows = "\n".join(" ".join(map(str, row)) for row in pixels.tolist())
        data = f"P2 # by hand\n3 2\n255\n{rows} # the end\n".encode()
    elif kind == "comments":
        data = b"P5 # CREATOR: a map saver\n#\n3 # wide\n2\r\n255\n" + pixels.tobytes()
    elif kind == "half":
        data = b"P5 3 2 127\n" + (pixels // 2).tobytes()
    else:
        data = pixels
        if kind.endswith("png"):
            name, data = "a.png", np.dstack([pixels] * 3) if kind == "rgb.png" else pixels
        if kind == "negated":
            fields, data = {"negate": 1}, 255 - pixels
    grid = load_grid(written(tmp_path, data, name, **fields))
    if kind == "half":  # 102 of 127 is 0.197: by a hair not free
        assert grid.log_odds[1].tolist() == [LIMIT, -LIMIT, 0.0]
        return
    assert grid.log_odds.tolist() == [[-LIMIT, -LIMIT, 0.0], [LIMIT, -LIMIT, 0.0]]
    assert grid.origin.tolist() == [-1.0, 2.0]
    assert grid.resolution == 0.1


def test_205_is_unknown_whatever_the_threshold(tmp_path):
    file = written(tmp_path, [[0, 205, 254]], free_thresh=0.25)
    assert load_grid(file).log_odds.tolist() == [[LIMIT, 0.0, -LIMIT]]


def test_scale_counts_from_threshold_to_threshold(tmp_path):
    pixels = np.dstack([np.full((1, 5), v) for v in (0, 0, 0, 255)])
    pixels[0, :, :3] = np.array([0, 100, 150, 254, 90])[:, None]
    pixels[0, 4, 3] = 0
    file = written(tmp_path, pixels, "a.png", mode="scale")
    p = 1 / (1 + np.exp(-load_grid(file).log_odds[0].astype(float)))
    between = [0.99 * ((255 - v) / 255 - 0.196) / (0.65 - 0.196) for v in (100, 150)]
    sure = 1 / (1 + np.exp(-LIMIT))
    np.testing.assert_allclose(p, [sure, *between, 1 - sure, 0.5], atol=1e-6)


def test_raw_is_percent_and_even_is_known(tmp_path):
    grid = load_grid(written(tmp_path, [[0, 50, 100, 101, 255]], mode="raw"))
    assert grid.is_known[0].tolist() == [True, True, True, False, False]
    np.testing.assert_allclose(grid.log_odds[0], [-LIMIT, 0, LIMIT, 0, 0], atol=1e-5)


@pytest.mark.parametrize("turn", [np.pi / 2, 0.3])
def test_a_turned_grid_is_turned_back(tmp_path, turn):
    pixels = np.full((20, 30), 254)
    pixels[3, 5] = 0
    grid = load_grid(written(tmp_path, pixels, origin=[-1.0, 2.0, turn]))
    c, s = np.cos(turn), np.sin(turn)
    wall = np.array([-1, 2]) + np.array([[c, -s], [s, c]]) @ (0.1 * np.array([5.5, 16.5]))
    (row, column), *_ = np.argwhere(grid.log_odds > 0)
    assert np.abs(grid.centres(np.array([[row, column]]))[0] - wall).max() <= 0.1
    assert np.mean(np.abs((grid.log_odds < 0).sum() - 599)) < 20


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"image": None}, "'image' is missing"),
        ({"resolution": None}, "'resolution' is missing"),
        ({"origin": None}, "'origin' is missing"),
        ({"negate": None}, "'negate' is missing"),
        ({"occupied_thresh": None}, "'occupied_thresh' is missing"),
        ({"free_thresh": None}, "'free_thresh' is missing"),
        ({"resolution": 0.0}, "'resolution' is 0 m"),
        ({"resolution": float("nan")}, "finite"),
        ({"resolution": "wide"}, "must hold numbers"),
        ({"origin": [1.0]}, "must have 2 or 3 numbers"),
        ({"origin": [1e300, 0.0, 0.0]}, "farther away than any map"),
        ({"negate": 2}, "must be 0 or 1"),
        ({"mode": "binary"}, "none of trinary, scale, raw"),
        ({"free_thresh": 0.7}, "the first below the second"),
        ({"image": "../none.pgm"}, "No such file"),
        ({"image": "/dev/zero"}, "no file that could hold a picture"),
        ({"image": "."}, "no file that could hold a picture"),
        ({"image": "a\0b"}, "null byte"),
        ({"resolution": 10**400}, "finite"),
        ({"origin": [10**400, 0, 0]}, "finite"),
        ({"negate": [0]}, "must be 0 or 1"),
        ({"image": "a.yaml"}, "neither PGM"),
    ],
)
def test_fields_that_cannot_be_are_one_clear_line(tmp_path, fields, said):
    file = written(tmp_path, [[0, 254]])
    content = {k: v for k, v in {**FIELDS, **fields}.items() if v is not None}
    file.write_text(yaml.safe_dump(content))
    with pytest.raises(InputError, match=said) as error:
        load_grid(file)
    assert str(error.value).startswith((str(tmp_path), f"'{tmp_path}", "/dev/zero: "))
    assert "\n" not in str(error.value)


PNG = bytes(cv2.imencode(".png", np.zeros((40, 40), np.uint8))[1])
WIDE = bytes(cv2.imencode(".png", np.zeros((4, 4), np.uint16))[1])
HUGE = PNG[:16] + (2**31 - 1).to_bytes(4, "big") * 2 + PNG[24:]


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"", "neither PGM"),
        (b"P5", "its header is broken"),
        (b"P5 3 2", "its header is broken"),
        (b"P5 x 2 255\n", "its header is broken"),
        (b"P5 3 2 255\n\0\0\0\0\0", "ends after 5 of 6 pixels"),
        (b"P5 0 2 255\n", "has none"),
        (b"P5 999999999 999999999 255\n", "too many"),
        (b"P5 20000 20000 255\n", "ends after 0 of"),
        (b"P5 3 2 65535\n" + bytes(12), "only 8 bits"),
        (b"P5 3 2 0\n" + bytes(6), "only 8 bits"),
        (b"P5 3 2 100\n" + bytes([200] * 6), "a pixel is 200"),
        (b"P2 3 2 255\n1 2 3", "ends after 3 of 6"),
        (b"P2 3 2 255\n1 2 3 4 x 6", "no number"),
        (b"P2 3 2 255\n1 2 3 4 -5 6", "below 0"),
        (b"P2 3 2 255\n1 2 3 4 5 600", "a pixel is 600"),
        (b"P6 3 2 255\n" + bytes(18), "neither PGM"),
        (PNG[:20], "header is broken"),
        (PNG[:-20], "a broken PNG"),
        (HUGE, "too many"),
        (WIDE, "16 bits"),
    ],
)
def test_pictures_that_are_broken_are_one_clear_line(tmp_path, data, said):
    with pytest.raises(InputError, match=said) as error:
        load_grid(written(tmp_path, data))
    assert str(error.value).startswith(str(tmp_path / "a.pgm"))
    assert "\n" not in str(error.value)


def test_a_file_cut_anywhere_is_refused(tmp_path):
    save_grid(tmp_path / "a.yaml", a_grid())
    whole = (tmp_path / "a.pgm").read_bytes()
    for length in range(0, len(whole), 7):
        (tmp_path / "a.pgm").write_bytes(whole[:length])
        with pytest.raises(InputError):
            load_grid(tmp_path / "a.yaml")


def test_what_is_no_yaml_is_said(tmp_path):
    (tmp_path / "a.pgm").write_bytes(b"P5 1 1 255\n\0")
    with pytest.raises(InputError, match=r"give the \.yaml"):
        load_grid(tmp_path / "a.pgm")
    for text in ("[1, 2]", "image: [", "!!python/object/apply:os.system ['true']", "[" * 5000):
        (tmp_path / "b.yaml").write_text(text)
        with pytest.raises(InputError):
            load_grid(tmp_path / "b.yaml")


def test_saving_says_what_cannot_be_and_leaves_what_was(tmp_path):
    grid = a_grid()
    with pytest.raises(InputError, match="nothing is known"):
        save_grid(tmp_path / "a.yaml", OccupancyGrid(0.1))
    with pytest.raises(InputError, match=r"ends in \.yaml"):
        save_grid(tmp_path / "a.pgm", grid)
    with pytest.raises(InputError, match="saved as trinary or raw"):
        save_grid(tmp_path / "a.yaml", grid, mode="scale")
    with pytest.raises(OutputError, match="folder does not exist"):
        save_grid(tmp_path / "none" / "a.yaml", grid)
    assert not list(tmp_path.iterdir())
    save_grid(tmp_path / "a.yaml", grid)
    before = (tmp_path / "a.yaml").read_bytes()
    (tmp_path / "a.pgm").unlink()
    (tmp_path / "a.pgm").mkdir()  # the picture cannot be written
    with pytest.raises(OutputError, match=r"a\.pgm"):
        save_grid(tmp_path / "a.yaml", the_room()[0])
    assert (tmp_path / "a.yaml").read_bytes() == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.pgm", "a.yaml"]
