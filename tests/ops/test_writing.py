"""Files are written as a whole or not at all, errors name them, and what killed processes have left is removed."""

import errno
import os
import signal
import tempfile
from pathlib import Path
from typing import NoReturn

import pytest

from msdgs_serve import writing as module
from msdgs_serve.writing import (
    WriteFailed,
    in_words,
    remove_abandoned,
    replacing,
    scratch_folder,
    temporary_folder,
    write_text,
    writing,
)
from tests.support.file_sizes import largest_file
from tests.support.processes import program


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError, SystemExit])
def test_an_error_leaves_the_old_file_alone(tmp_path: Path, error: type[BaseException]):
    file = tmp_path / "a.txt"
    write_text(file, "old")

    def write() -> None:
        with replacing(file) as temporary:
            assert temporary.suffix == ".txt"
            temporary.write_text("new")
            raise error

    with pytest.raises(error):
        write()
    assert (file.read_text(), os.listdir(tmp_path)) == ("old", ["a.txt"])


@pytest.mark.parametrize("buffering", [-1, 0])
def test_a_file_that_is_too_large_is_named_and_the_old_one_stays(tmp_path: Path, buffering: int):
    file = tmp_path / "a.bin"
    file.write_bytes(b"old")

    def write() -> None:
        with replacing(file) as temporary, temporary.open("wb", buffering) as stream:
            for _ in range(3):  # the second write is cut off
                stream.write(bytes(600))

    with pytest.raises(WriteFailed) as failed, largest_file(1000):
        write()
    assert str(failed.value).startswith(f"{file}: can't be written: a file may not be as large there; raise the limit")
    assert (file.read_bytes(), os.listdir(tmp_path)) == (b"old", ["a.bin"])


def test_a_full_disk_is_named():
    full = Path("/dev/full")
    with pytest.raises(WriteFailed, match=r"/dev/full: can't be written: the disk is full; free space"), writing(full):
        full.write_text("more than nothing")


@pytest.mark.parametrize(
    ("number", "cause"),
    [
        (errno.ENOSPC, "the disk is full"), (errno.EDQUOT, "your share of the disk"), (errno.EROFS, "the disk is read"),
        (errno.EACCES, "permission is denied"), (errno.EPERM, "permission is denied"), (errno.EIO, "Input/output"),
    ],
)  # fmt: skip
def test_a_folder_that_cannot_be_written_to_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, cause: str
):
    def refuse(prefix: str, dir: Path) -> NoReturn:
        raise OSError(number, os.strerror(number), f"{dir}/{prefix}abc")

    monkeypatch.setattr(tempfile, "mkdtemp", refuse)
    with pytest.raises(WriteFailed, match=f"^{tmp_path / 'a.txt'}: can't be written: {cause}"):
        write_text(tmp_path / "a.txt", "")


def test_a_path_that_cannot_be_a_file_is_named(tmp_path: Path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").touch()
    for path, cause in (
        (tmp_path / "none" / "a.txt", "there is no such file or folder"),
        (tmp_path / "file" / "a.txt", "a part of the path is a file"),
        (tmp_path / "folder", "it is a folder"),
    ):
        with pytest.raises(WriteFailed, match=f"^{path}: can't be written: {cause}"):
            write_text(path, "")


def test_errors_about_other_files_are_their_own(tmp_path: Path):
    with pytest.raises(FileNotFoundError) as failed, replacing(tmp_path / "a.txt"):
        (tmp_path / "source").read_bytes()
    assert not isinstance(failed.value, WriteFailed)
    assert in_words(failed.value) == f"{tmp_path / 'source'}: there is no such file or folder"
    with pytest.raises(BrokenPipeError) as ended, writing(tmp_path):  # of an output that is not read
        raise BrokenPipeError(errno.EPIPE, "Broken pipe")
    assert in_words(ended.value) == "Broken pipe"


def test_temporary_files_have_a_remedy_of_their_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with pytest.raises(WriteFailed, match=f"^{tmp_path}: .*TMPDIR"), largest_file(10), scratch_folder() as folder:
        (folder / "large").write_bytes(bytes(100))
    assert not os.listdir(tmp_path)
    monkeypatch.setattr(tempfile, "gettempdir", lambda: Path(tmp_path / "none").stat())
    with pytest.raises(WriteFailed, match=r"^temporary files: .*TMPDIR"), scratch_folder():
        pass


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_what_a_killed_process_has_left_is_removed_and_what_a_living_one_needs_is_not(tmp_path: Path, number: int):
    (tmp_path / ".msdgs-of-others").mkdir()  # without a lock: it may have been made this moment
    with program("tests.support.half_written", tmp_path / "a.txt") as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "writing\n"
        (left,) = (path.parent for path in tmp_path.glob(".msdgs-*/a.txt"))
        remove_abandoned(tmp_path)
        assert (left / "a.txt").read_text() == "half"
        process.send_signal(number)
        process.wait()
    assert left.exists()
    remove_abandoned.cache_clear()
    write_text(tmp_path / "b.txt", "another file of the same folder")
    assert sorted(os.listdir(tmp_path)) == [".msdgs-of-others", "b.txt"]


def test_a_file_system_without_locks_is_written_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def refuse(*_: object) -> NoReturn:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(module.fcntl, "flock", refuse)
    with temporary_folder(tmp_path, tmp_path) as folder:
        remove_abandoned.cache_clear()
        write_text(tmp_path / "a.txt", "new")
        assert folder.exists()
    assert os.listdir(tmp_path) == ["a.txt"]
