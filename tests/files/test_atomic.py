"""A result is on disk whole, or not at all; and an error says what to do."""

import errno
import os
from pathlib import Path

import pytest

from odomap.errors import OutputError
from odomap.files.atomic import (
    atomic_binary,
    atomic_text,
    find_obstacle,
    make_folder,
    write_bytes,
    write_text,
)


def names(folder: Path) -> list[str]:
    return sorted(entry.name for entry in folder.iterdir())


def test_what_was_written_is_there(tmp_path: Path) -> None:
    write_text(tmp_path / "a.txt", "grüß\n")
    write_bytes(tmp_path / "b.bin", b"\x00\r\n")
    with atomic_text(tmp_path / "c.txt") as file:
        file.write("one\n")
        file.write("two\n")
    assert (tmp_path / "a.txt").read_bytes() == "grüß\n".encode()
    assert (tmp_path / "b.bin").read_bytes() == b"\x00\r\n"
    assert (tmp_path / "c.txt").read_bytes() == b"one\ntwo\n"
    assert names(tmp_path) == ["a.txt", "b.bin", "c.txt"]


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    target = tmp_path / "poses.tum"
    write_text(target, "old")

    def write_and_fail() -> None:
        with atomic_text(target) as file:
            file.write("new")
            assert target.read_text() == "old"
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_and_fail()
    assert target.read_text() == "old"
    assert names(tmp_path) == ["poses.tum"]


@pytest.mark.parametrize("step", ["write", "fsync", "replace"])
def test_a_full_disk_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str) -> None:
    def full(*args: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    target = tmp_path / "poses.tum"
    target.write_text("old")
    if step != "write":
        monkeypatch.setattr(os, step, full)

    def write() -> None:
        with atomic_binary(target) as file:
            if step == "write":
                full()
            file.write(b"new")

    with pytest.raises(OutputError, match=r"poses\.tum: cannot be written: the disk is full"):
        write()
    assert target.read_text() == "old"
    assert names(tmp_path) == ["poses.tum"]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_really_full_device_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # The file beside the target is a device on which every write fails with ENOSPC.
    (tmp_path / f".poses.tum.{os.getpid()}.part").symlink_to("/dev/full")
    with pytest.raises(OutputError, match="the disk is full"):
        write_bytes(tmp_path / "poses.tum", b"x" * 100_000)
    assert names(tmp_path) == []


@pytest.mark.parametrize(
    ("code", "mend"),
    [
        (errno.EACCES, "no permission"),
        (errno.EROFS, "read-only"),
        (errno.EDQUOT, "quota"),
        (errno.EIO, os.strerror(errno.EIO)),
    ],
)
def test_the_reason_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int, mend: str
) -> None:
    def refuse(*args: object) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(os, "replace", refuse)
    with pytest.raises(OutputError, match=mend):
        write_text(tmp_path / "a.txt", "x")


def test_missing_folder_and_folder_in_the_way(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="the folder does not exist"):
        write_text(tmp_path / "nothing" / "a.txt", "x")
    (tmp_path / "a.txt").mkdir()
    with pytest.raises(OutputError, match="a folder of that name is in the way"):
        write_text(tmp_path / "a.txt", "x")
    assert names(tmp_path) == ["a.txt"]


def test_errors_of_the_caller_are_its_own(tmp_path: Path) -> None:
    def read_something_else() -> None:
        with atomic_text(tmp_path / "a.txt"):
            (tmp_path / "missing").read_text()

    with pytest.raises(FileNotFoundError):
        read_something_else()
    assert names(tmp_path) == []


def test_make_folder(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "runs" / "first")
    assert folder.is_dir()
    assert names(folder) == []
    assert make_folder(folder) == folder
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="in the way"):
        make_folder(tmp_path / "file")
    with pytest.raises(OutputError, match="a part of the path is a file"):
        make_folder(tmp_path / "file" / "inside")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_make_folder_without_permission(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(OutputError, match="no permission"):
            make_folder(tmp_path / "out")
        with pytest.raises(OutputError, match="no permission"):
            make_folder(tmp_path)
    finally:
        tmp_path.chmod(0o700)


@pytest.fixture
def pipe(tmp_path: Path) -> Path:
    path = tmp_path / "pipe.g2o"
    os.mkfifo(path)
    return path


def test_only_regular_files_are_replaced(tmp_path: Path, pipe: Path) -> None:
    (tmp_path / "link.g2o").symlink_to(pipe)
    for name in ("pipe.g2o", "link.g2o"):
        with pytest.raises(OutputError, match=rf"{name}: .* it is a device, a pipe or"):
            write_bytes(tmp_path / name, b"x")
    assert pipe.is_fifo()
    assert (tmp_path / "link.g2o").is_symlink()
    assert names(tmp_path) == ["link.g2o", "pipe.g2o"]


def test_what_is_in_the_way(tmp_path: Path, pipe: Path) -> None:
    (tmp_path / "old").write_text("old")
    (tmp_path / "link").symlink_to("old")
    (tmp_path / "nowhere").symlink_to("missing")
    for name in ("old", "link", "nowhere", "new", "old/inside", "no/where"):
        assert find_obstacle(tmp_path / name) is None
    assert "a folder of that name" in str(find_obstacle(tmp_path))
    assert "a pipe" in str(find_obstacle(pipe))


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="needs /proc")
def test_a_file_that_is_open_is_not_replaced_by_its_number(tmp_path: Path) -> None:
    with open(tmp_path / "log", "w") as file:
        (tmp_path / "out").symlink_to(f"/proc/self/fd/{file.fileno()}")
        assert "a pipe" in str(find_obstacle(tmp_path / "out"))
        with pytest.raises(OutputError, match="out: cannot be written"):
            write_text(tmp_path / "out", "x")
    assert names(tmp_path) == ["log", "out"]


def test_a_folder_that_takes_no_files_is_not_said_to_be_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(self: Path, data: bytes) -> None:
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(self))

    monkeypatch.setattr(Path, "write_bytes", refuse)
    with pytest.raises(OutputError, match="no files can be made there"):
        make_folder(tmp_path)
    monkeypatch.undo()
    monkeypatch.setattr(os, "replace", lambda a, b: refuse(Path(a), b""))
    with pytest.raises(OutputError, match="no files can be made there"):
        write_text(tmp_path / "a.txt", "x")
