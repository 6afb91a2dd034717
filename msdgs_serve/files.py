"""Files that other processes read and write too: whether they changed, moves that are complete after a crash, and
memory as a file."""

import errno
import os
import resource
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

MAX_READ_BYTES = 1 << 30
"""Limit of bytes per read, below that of any system."""


@contextmanager
def scratch_file() -> Iterator[tuple[str, Callable[[], bytes]]]:
    """Yield a path for a library to write to and a function that reads it; in memory on Linux.

    Every system call may pass the interpreter to another thread, so there are few.
    """
    if hasattr(os, "memfd_create"):
        handle = os.memfd_create("image")
        try:
            yield f"/proc/self/fd/{handle}", lambda: _read_all(handle)
        except Exception:
            _require_whole(handle)
            raise
        finally:
            os.close(handle)
    else:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "image"
            yield str(path), path.read_bytes


def _read_all(handle: int) -> bytes:
    size = _require_whole(handle)
    return b"".join(os.pread(handle, MAX_READ_BYTES, start) for start in range(0, size, MAX_READ_BYTES))


def _require_whole(handle: int) -> int:
    """Return a file's size. Raises `OSError` if the system has cut it off there, which libraries don't notice or name
    otherwise."""
    size = os.fstat(handle).st_size
    if size == resource.getrlimit(resource.RLIMIT_FSIZE)[0]:
        raise OSError(errno.EFBIG, os.strerror(errno.EFBIG))
    return size


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
