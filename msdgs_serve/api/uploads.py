"""Quotas of uploaded scenes: numbers and bytes, in all and per API key, and free disk space."""

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
from msdgs_serve.scene_names import SUFFIX

OPENED_AT_ONCE = 2
OWNER_SUFFIX = ".owner"
DISK_IS_FULL = (errno.ENOSPC, errno.EDQUOT)
MIB = 1 << 20


@dataclass(eq=False)
class Stored:
    """A scene in the folder for uploads, or an upload in progress."""

    name: str
    owner: str | None  # the API key of the upload; None: the operator, or a client without a key
    bytes: int = 0


class Uploads:
    """Counts scenes in the folder for uploads and uploads in progress. Safe to use from several threads.

    The owner of a scene is stored in a hidden file beside it.
    """

    def __init__(self, folder: Path | None, settings: Settings) -> None:
        self._folder = folder or Path()  # without a folder uploads are rejected earlier
        self._settings = settings
        self._stored: dict[str, Stored] = {}
        self._incoming: set[Stored] = set()
        self._lock = threading.Lock()
        self.opening = anyio.CapacityLimiter(OPENED_AT_ONCE)
        """Limits the threads that open uploads: more would slow each other and the renders down."""

    def scan(self) -> None:
        """Read the folder, into which other processes may write too."""
        found: dict[str, Stored] = {}
        for file in self._folder.glob(f"*{SUFFIX}"):
            with suppress(OSError):  # it was removed meanwhile
                found[file.stem] = Stored(file.stem, self._owner(file.stem), file.stat().st_size)
        with self._lock:
            self._stored = found

    @contextmanager
    def receiving(self, name: str, owner: str | None) -> Iterator[Stored]:
        """Count an upload in the context, after `scan`.

        Raises `RequestRejected`: 507 for quotas and full disks, 503 if its file is removed meanwhile.
        """
        upload = Stored(name, owner)
        with self._lock:
            self._incoming.add(upload)
        try:
            self.grow(upload, 0)
            yield upload
        except FileNotFoundError:
            if not self._folder.is_dir():
                raise
            detail = "The file was removed while it was received: send it again."
            raise RequestRejected(HTTPStatus.SERVICE_UNAVAILABLE, "lost_upload", detail, retry_after=1) from None
        except OSError as error:
            if error.errno not in DISK_IS_FULL:
                raise
            raise _storage_full("disk_full", "The disk of the service is full.") from None
        finally:
            with self._lock:
                self._incoming.discard(upload)

    def grow(self, upload: Stored, size: int) -> None:
        """Count received bytes. Raises `RequestRejected`: 413 for a file that is too large, 507 for quotas."""
        limits = self._settings
        upload.bytes += size
        if upload.bytes > limits.max_scene_megabytes * MIB:
            detail = f"A scene file must be at most {limits.max_scene_megabytes} MiB."
            raise RequestRejected(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "large_body", detail, field="body")
        if shutil.disk_usage(self._folder).free < limits.min_free_megabytes * MIB + size:
            raise _storage_full("disk_full", f"The service keeps {limits.min_free_megabytes} MiB of its disk free.")
        with self._lock:
            everything = [each for each in self._stored.values() if each.name != upload.name] + list(self._incoming)
        _check(everything, limits.max_scenes, limits.max_scenes_megabytes, "The service")
        if upload.owner is not None:
            own = [each for each in everything if each.owner == upload.owner]
            _check(own, limits.max_key_scenes, limits.max_key_megabytes, "This key")

    def added(self, upload: Stored) -> None:
        """Record that an upload was added as a scene."""
        if upload.owner is None:
            self._owner_file(upload.name).unlink(missing_ok=True)
        else:
            self._owner_file(upload.name).write_text(upload.owner)
        with self._lock:
            self._stored[upload.name] = upload
            self._incoming.discard(upload)

    def removed(self, name: str) -> None:
        """Record that a scene was deleted, unless another has its name by now."""
        if (self._folder / f"{name}{SUFFIX}").exists():
            return
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


def _check(scenes: list[Stored], limit: int, megabytes: int, owner: str) -> None:
    if len(scenes) > limit:
        raise _storage_full("quota", f"{owner} may store {limit} scenes; delete one first.")
    if sum(each.bytes for each in scenes) > megabytes * MIB:
        raise _storage_full("quota", f"{owner} may store {megabytes} MiB of scenes; delete some first.")


def _storage_full(kind: str, detail: str) -> RequestRejected:
    return RequestRejected(HTTPStatus.INSUFFICIENT_STORAGE, kind, detail, field="body")
