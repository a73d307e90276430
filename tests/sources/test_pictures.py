"""Pictures of one camera: folders, patterns, files, videos; and how they pair."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from odomap.errors import InputError
from odomap.sources.pictures import MOST, Pictures, open_pictures, pair_pictures


def save(path: Path, value: int = 100, size: tuple[int, int] = (32, 24)) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    image = np.full(size[::-1], value, np.uint8)
    image[0, 0] = 0
    assert cv2.imwrite(str(path), image)
    return path


def clip(path: Path, frames: int) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (64, 48))
    for k in range(frames):
        writer.write(np.full((48, 64, 3), 10 + k, np.uint8))
    writer.release()
    return path


def test_a_folder_a_pattern_and_files_are_the_same(tmp_path: Path) -> None:
    files = [save(tmp_path / f"p{k}.png", 50 + k) for k in range(3)]
    (tmp_path / "notes.txt").write_text("no picture")
    for inputs in ([tmp_path], [f"{tmp_path}/p*.png"], files):
        pictures = open_pictures(inputs)
        assert [picture.name for picture in pictures] == ["p0.png", "p1.png", "p2.png"]
        values = [int(p.image[5, 5]) for p in pictures if p.image is not None]
        assert values == [50, 51, 52]


def test_many_pictures_are_thinned_evenly_and_told(tmp_path: Path) -> None:
    files = [tmp_path / f"{k:04d}.png" for k in range(2 * MOST)]
    pictures = open_pictures(files)
    assert len(pictures) == MOST
    assert pictures.files[0] == files[0]
    assert pictures.files[-1] == files[-1]
    assert f"{MOST} of {2 * MOST} pictures" in pictures.notes[0]


def test_frames_of_a_video_are_those_they_say(tmp_path: Path) -> None:
    pictures = open_pictures([clip(tmp_path / "a.avi", 2 * MOST // 3)])
    assert pictures.is_video
    for picture in pictures:
        assert picture.image is not None
        number = int(picture.name.removeprefix("frame "))
        assert abs(int(picture.image.mean()) - 10 - number) <= 2


def test_a_broken_picture_says_why_and_another_size_is_an_error(tmp_path: Path) -> None:
    for k in range(4):
        save(tmp_path / f"p{k}.png")
    (tmp_path / "p1.png").write_bytes((tmp_path / "p1.png").read_bytes()[:40])
    pictures = list(open_pictures([tmp_path]))
    assert pictures[1].image is None
    assert "truncated" in pictures[1].reason
    save(tmp_path / "p2.png", size=(24, 32))
    with pytest.raises(InputError, match=r"p2\.png: is 24x32, most pictures are 32x24"):
        list(open_pictures([tmp_path]))


def pictures_named(*names: str) -> Pictures:
    return Pictures("folder", tuple(map(Path, names)))


def test_pictures_pair_by_name_or_number() -> None:
    pair_pictures(pictures_named("a/x.png", "a/y.png"), pictures_named("b/x.jpg", "b/y.jpg"))
    pair_pictures(pictures_named("l_01.png", "l_2.png"), pictures_named("r1.png", "r02.png"))
    with pytest.raises(InputError, match=r"'l_2\.png' and 'r_3\.png' do not pair"):
        pair_pictures(pictures_named("l_1.png", "l_2.png"), pictures_named("r_1.png", "r_3.png"))
    with pytest.raises(InputError, match=r"'a\.png' and 'b\.png' do not pair"):
        pair_pictures(pictures_named("a.png"), pictures_named("b.png"))
    with pytest.raises(InputError, match=r"2 and 1 pictures.*'2\.png' has no partner"):
        pair_pictures(pictures_named("1.png", "2.png"), pictures_named("1.png"))


def test_videos_pair_frame_by_frame(tmp_path: Path) -> None:
    long, short = (open_pictures([clip(tmp_path / f"{n}.avi", n)]) for n in (12, 10))
    pair_pictures(long, long)
    with pytest.raises(InputError, match="12 and 10 frames do not pair"):
        pair_pictures(long, short)
    with pytest.raises(InputError, match="one is a video"):
        pair_pictures(long, pictures_named("1.png"))


def test_nothing_there_is_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder, video or picture"):
        open_pictures([tmp_path / "none"])
    with pytest.raises(InputError, match="no picture has such a name"):
        open_pictures([f"{tmp_path}/*.png"])
    with pytest.raises(InputError, match="no pictures in it"):
        open_pictures([tmp_path])
