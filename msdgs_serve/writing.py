"""Writing files as a whole: into a temporary folder beside the file, flushed to disk, then moved over the old file.

A process that is killed leaves its temporary folder. The next one that writes beside it removes it, unless it is locked
by a process that lives. Errors name the file and the remedy.
"""

import errno
import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

from msdgs_serve.files import sync
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

PREFIX = ".msdgs-"
"""Of the names of temporary folders."""

LOCK = ".lock"
"""The file in a temporary folder that its process holds locked."""


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
    if isinstance(error, MsdgsError) or error.errno is None:
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


def move_all(moves: Sequence[tuple[Path, Path]]) -> None:
    """Move files and folders from the first to the second path, in the same file system: all of them, or none."""
    try:
        for source, target in moves:
            os.replace(source, target)
    except BaseException:
        for source, target in reversed(moves):
            if not source.exists():
                os.replace(target, source)
        raise


@contextmanager
def made_folder(path: Path) -> Iterator[None]:
    """Make a folder and those above it, if there are none. They go again if the block raises and leaves them empty."""
    new = [each for each in (path, *path.parents) if not each.exists()]
    with writing(path):
        path.mkdir(parents=True, exist_ok=True)
    try:
        yield
    except BaseException:
        with suppress(OSError):
            for each in new:
                each.rmdir()
        raise


@contextmanager
def temporary_folder(parent: Path, target: Path, remedy: str = "") -> Iterator[Path]:
    """A new folder in `parent`, removed at the end of the block; those that killed processes have left are, too.

    Errors of writing into it are raised as `WriteFailed` of `target`, with this remedy.
    """
    with writing(target, PREFIX, remedy):
        remove_abandoned(parent.absolute())
        folder = Path(tempfile.mkdtemp(prefix=PREFIX, dir=parent))
        try:
            with _locked(folder):
                yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)


@contextmanager
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


@cache
def remove_abandoned(parent: Path) -> None:
    """Remove the temporary folders in `parent` that no process holds locked, once a process."""
    for lock in parent.glob(f"{PREFIX}*/{LOCK}"):
        with suppress(OSError), lock.open("r+b") as file:  # another user's, or gone since
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(lock.parent, ignore_errors=True)


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold the lock of a temporary folder. Others see the lock once it is held: they ignore a folder without one."""
    unseen = folder / f"{LOCK}.new"
    with unseen.open("wb") as file:
        with suppress(OSError):  # a file system without locks
            fcntl.flock(file, fcntl.LOCK_EX)
            unseen.rename(folder / LOCK)
        yield
