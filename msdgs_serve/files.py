"""Files that other processes read and write too: whether they changed, and moves that are complete after a crash."""

import os
from pathlib import Path
from typing import NamedTuple


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
