"""What clients may store: how many scenes, how many bytes, in all and each key, and how much of the disk is left."""

import errno
import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path

import anyio

from msdgs_serve.api.errors import RequestRejected
from msdgs_serve.api.settings import Settings
from msdgs_serve.store import SUFFIX

OPENED_AT_ONCE = 2
OWNER_SUFFIX = ".owner"
DISK_IS_FULL = (errno.ENOSPC, errno.EDQUOT)
MIB = 1 << 20


@dataclass(eq=False)
class Stored:
    """A scene in the folder for uploads, or on its way there."""

    name: str
    owner: str | None  # the key that sent it; None: the operator, or a client where there are no keys
    bytes: int = 0


class Uploads:
    """Counts what lies in the folder for uploads and what is on its way there. Safe to use from several threads.

    Whose key a scene came with is kept in a hidden file beside it.
    """

    def __init__(self, folder: Path | None, settings: Settings) -> None:
        self._folder = folder or Path()  # without one uploads are refused before
        self._settings = settings
        self._stored: dict[str, Stored] = {}
        self._coming: set[Stored] = set()
        self._lock = threading.Lock()
        self.opening = anyio.CapacityLimiter(OPENED_AT_ONCE)
        """Of threads that open what has come: more would wait for each other, and frames for a thread."""

    def scan(self) -> None:
        """OutputOptions at what is there; other processes may write into the folder too."""
        found: dict[str, Stored] = {}
        for file in self._folder.glob(f"*{SUFFIX}"):
            with suppress(OSError):  # it is gone meanwhile
                found[file.stem] = Stored(file.stem, self._owner(file.stem), file.stat().st_size)
        with self._lock:
            self._stored = found

    @contextmanager
    def room(self, name: str, owner: str | None) -> Iterator[Stored]:
        """Around an upload, after a `scan`. Raises `RequestRejected` (507) where it may not be stored, or the disk is full."""
        upload = Stored(name, owner)
        with self._lock:
            self._coming.add(upload)
        try:
            self.grow(upload, 0)
            yield upload
        except OSError as error:
            if error.errno not in DISK_IS_FULL:
                raise
            raise _no_room("disk_full", "The disk of the service is full.") from None
        finally:
            with self._lock:
                self._coming.discard(upload)

    def grow(self, upload: Stored, size: int) -> None:
        """So many bytes more have come. Raises `RequestRejected`: 413 for a file that is too large, 507 for all else."""
        limits = self._settings
        upload.bytes += size
        if upload.bytes > limits.max_scene_megabytes * MIB:
            detail = f"A scene file must be at most {limits.max_scene_megabytes} MiB."
            raise RequestRejected(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "large_body", detail, field="body")
        if shutil.disk_usage(self._folder).free < limits.min_free_megabytes * MIB + size:
            raise _no_room("disk_full", f"The service leaves {limits.min_free_megabytes} MiB of its disk free.")
        with self._lock:
            everything = [each for each in self._stored.values() if each.name != upload.name] + list(self._coming)
        _check(everything, limits.max_scenes, limits.max_scenes_megabytes, "The service")
        if upload.owner is not None:
            own = [each for each in everything if each.owner == upload.owner]
            _check(own, limits.max_key_scenes, limits.max_key_megabytes, "This key")

    def added(self, upload: Stored) -> None:
        """It has become a scene."""
        if upload.owner is None:
            self._owner_file(upload.name).unlink(missing_ok=True)
        else:
            self._owner_file(upload.name).write_text(upload.owner)
        with self._lock:
            self._stored[upload.name] = upload
            self._coming.discard(upload)

    def removed(self, name: str) -> None:
        """The scene is gone."""
        self._owner_file(name).unlink(missing_ok=True)
        with self._lock:
            self._stored.pop(name, None)

    def _owner(self, name: str) -> str | None:
        try:
            return self._owner_file(name).read_text()
        except (OSError, UnicodeDecodeError):
            return None

    def _owner_file(self, name: str) -> Path:
        return self._folder / f".{name}{OWNER_SUFFIX}"


def _check(scenes: list[Stored], most: int, megabytes: int, whose: str) -> None:
    if len(scenes) > most:
        raise _no_room("quota", f"{whose} has room for {most} scenes; delete one first.")
    if sum(each.bytes for each in scenes) > megabytes * MIB:
        raise _no_room("quota", f"{whose} has room for {megabytes} MiB of scenes; delete some first.")


def _no_room(kind: str, detail: str) -> RequestRejected:
    return RequestRejected(HTTPStatus.INSUFFICIENT_STORAGE, kind, detail, field="body")
