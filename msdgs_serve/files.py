"""Files that other processes read and write too: whether they changed, moves that are complete after a crash, and
errors that name the file and the remedy."""

import errno
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from msdgs_serve.scene.errors import MsdgsError

REASONS = {
    errno.ENOSPC: "the disk is full; free space there, or choose another disk",
    errno.EDQUOT: "your share of the disk is used up; free space there, or choose another disk",
    errno.EFBIG: "a file may not be as large there; raise the limit (`ulimit -f`), or choose another disk",
    errno.EROFS: "the disk is read-only; choose another folder",
    errno.EACCES: "permission is denied; change it, or choose another folder",
    errno.EPERM: "permission is denied; change it, or choose another folder",
    errno.ENOENT: "there is no such file or folder",
    errno.EEXIST: "there is a file of this name already",
    errno.EISDIR: "it is a folder",
    errno.ENOTDIR: "a part of the path is a file, not a folder",
}
"""What people are told, by the number of the system's error; others are named as the system does."""

MAX_READ_BYTES = 1 << 30
"""Limit of bytes per read, below that of any system."""


class WriteFailed(MsdgsError, OSError):
    """A file can't be written; the message names it, the cause and the remedy."""

    def __init__(self, file: Path | str, error: OSError, remedy: str = "") -> None:
        super().__init__(error.errno, reason(error), str(file))
        self.remedy = remedy

    def __str__(self) -> str:
        return f"{self.filename}: can't be written: " + ". ".join(filter(None, (self.strerror, self.remedy)))


def reason(error: OSError) -> str:
    """The cause of a system's error, and what to do."""
    return REASONS.get(error.errno or 0) or error.strerror or str(error)


def in_words(error: MsdgsError | OSError) -> str:
    """The message of an error for people: a system's error as its file and cause."""
    if isinstance(error, MsdgsError) or not isinstance(error, OSError) or error.errno is None:
        return str(error)
    return reason(error) if error.filename is None else f"{error.filename}: {reason(error)}"


@contextmanager
def writing(file: Path, temporary: str | None = None, remedy: str = "") -> Iterator[None]:
    """Raise `WriteFailed` for errors of writing `file` in the block: those that name it, no file at all, or a path that
    contains the text `temporary`."""
    try:
        yield
    except OSError as error:
        named = str(error.filename or file)
        is_of_file = named == str(file) or (temporary is not None and temporary in named)
        if error.errno is None or isinstance(error, ConnectionError) or not is_of_file:
            raise
        raise WriteFailed(file, error, remedy) from error


@contextmanager
def scratch_file() -> Iterator[tuple[str, Callable[[], bytes]]]:
    """Yield a path for a library to write to and a function that reads it; in memory on Linux.

    Every system call may pass the interpreter to another thread, so there are few.
    """
    if hasattr(os, "memfd_create"):
        handle = os.memfd_create("image")
        try:
            yield f"/proc/self/fd/{handle}", lambda: _read_all(handle)
        finally:
            os.close(handle)
    else:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "image"
            yield str(path), path.read_bytes


def _read_all(handle: int) -> bytes:
    size = os.fstat(handle).st_size
    return b"".join(os.pread(handle, MAX_READ_BYTES, start) for start in range(0, size, MAX_READ_BYTES))


class Signature(NamedTuple):
    """What changes with the contents of a file."""

    path: Path
    modified: int  # ns
    size: int  # bytes
    inode: int


def signature(path: Path, status: os.stat_result | None = None) -> Signature:
    """Return the signature of a file, whose status is read if it isn't given."""
    status = status or os.stat(path)
    return Signature(path, status.st_mtime_ns, status.st_size, status.st_ino)


def move(source: Path, target: Path, *, replace: bool) -> None:
    """Move a file to another name in the same file system, as a whole.

    Raises `FileExistsError` if the name is taken and `replace` is false; file systems without hard links don't tell.
    """
    sync(source)
    if replace or not _linked(source, target):
        os.replace(source, target)
    else:
        source.unlink()
    sync(target.parent)


def _linked(source: Path, target: Path) -> bool:
    """Give a file another name; return whether the file system can."""
    try:
        os.link(source, target)
    except FileExistsError:
        raise
    except OSError:
        return False
    return True


def sync(path: Path) -> None:
    """Flush a file or folder to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
