"""Atomic writes: into a temporary folder beside the file, flushed to disk, then moved over the old file.

A process that is killed leaves its temporary folder. The next one that writes beside it removes it, unless it is locked
by a process that lives.
"""

import contextlib
import errno
import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from msdgs_serve.files import WriteFailed, sync, writing

PREFIX = ".msdgs-"
"""Of the names of temporary folders."""

LOCK = ".lock"
"""The file in a temporary folder that its process holds locked."""


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A path of the same name in a temporary folder; the file written there replaces `path` at the end of the block.

    If the block raises, or is interrupted by Ctrl-C, the file is removed and `path` is unchanged. Raises `WriteFailed`.
    """
    with temporary_folder(path.parent, path) as folder:
        temporary = folder / path.name
        yield temporary
        sync(temporary)
        os.replace(temporary, path)


def write_text(path: Path, text: str) -> None:
    """Write text as UTF-8, atomically. Raises `WriteFailed`."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


@contextlib.contextmanager
def temporary_folder(parent: Path, target: Path, remedy: str = "") -> Iterator[Path]:
    """A new folder in `parent`, removed at the end of the block; those that killed processes have left are, too.

    Errors of writing into it are raised as `WriteFailed` of `target`, with this remedy.
    """
    with writing(target, PREFIX, remedy):
        remove_abandoned(parent)
        folder = Path(tempfile.mkdtemp(prefix=PREFIX, dir=parent))
        try:
            with _locked(folder):
                yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)


@contextlib.contextmanager
def scratch_folder() -> Iterator[Path]:
    """A temporary folder where the system keeps such, for what isn't kept at all. Raises `WriteFailed`."""
    remedy = "The environment variable TMPDIR names another folder for temporary files"
    try:
        parent = Path(tempfile.gettempdir())
    except FileNotFoundError:
        problem = OSError(errno.EIO, "no folder for them has space and lets you write")
        raise WriteFailed("temporary files", problem, remedy) from None
    with temporary_folder(parent, parent, remedy) as folder:
        yield folder


def remove_abandoned(parent: Path) -> None:
    """Remove the temporary folders in `parent` that no process holds locked."""
    for lock in parent.glob(f"{PREFIX}*/{LOCK}"):
        with contextlib.suppress(OSError), lock.open("r+b") as file:  # another user's, or gone since
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(lock.parent, ignore_errors=True)


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold the lock of a temporary folder. Others see the lock once it is held: they ignore a folder without one."""
    unseen = folder / f"{LOCK}.new"
    with unseen.open("wb") as file:
        with contextlib.suppress(OSError):  # a file system without locks
            fcntl.flock(file, fcntl.LOCK_EX)
            unseen.rename(folder / LOCK)
        yield
