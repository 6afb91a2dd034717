"""Scenes on disk: found by name, loaded at the first request, reloaded when their file changes."""

import logging
import math
import os
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from dataclasses import replace as replaced
from functools import cached_property
from pathlib import Path
from typing import BinaryIO

import numpy as np

from msdgs_serve.deformation import DeformationSession
from msdgs_serve.files import Signature, move, sync
from msdgs_serve.files import signature as signature_of
from msdgs_serve.framing import Framing, framing
from msdgs_serve.scene import InvalidInput, MsdgsError, SceneFileInvalid, SceneNotFound
from msdgs_serve.scene.metadata import SceneMetadata
from msdgs_serve.scene_names import MAX_NAME_BYTES, SUFFIX, checked, is_servable_name

INCOMING_PREFIX = ".incoming-"
INCOMING_SECONDS = 3600.0
"""Age at which temporary files of uploads are removed."""
MAX_OPEN_ATTEMPTS = 5
RETRY_SECONDS = 10.0
"""Interval of attempts to load a file that failed for a cause outside of it."""
TEMPORARY = (OSError, MemoryError)
"""Errors that may not occur again, although the file doesn't change."""

logger = logging.getLogger("msdgs_serve")


class SceneExists(MsdgsError):
    """A scene of this name exists, and the request doesn't allow to replace it."""


@dataclass(frozen=True)
class ServedScene:
    """One version of a scene, in memory."""

    name: str
    session: DeformationSession
    signature: Signature  # of the file

    @property
    def sha256(self) -> str:
        """SHA-256 of the scene file."""
        return self.session.sha256

    @cached_property
    def bytes(self) -> int:
        """Memory of its Gaussians, and of its graph about: the size of the file."""
        arrays = (value for value in vars(self.session.scene).values() if isinstance(value, np.ndarray))
        return self.signature.size + sum(array.nbytes for array in arrays)

    @cached_property
    def framing(self) -> Framing:
        """The default view; cached, as every request needs it."""
        return framing(self.session.scene.metadata)

    @cached_property
    def metadata(self) -> SceneMetadata:
        """The scene's metadata, with bounds and cameras in the user's world."""
        return self.session.scene.metadata.in_world()


@dataclass(frozen=True)
class SceneContents:
    """The open file of a loaded scene, which stays whole if it is replaced or deleted meanwhile."""

    name: str
    sha256: str
    file: BinaryIO
    signature: Signature

    @property
    def size(self) -> int:
        """Bytes of the file."""
        return self.signature.size

    @property
    def is_unchanged(self) -> bool:
        """Whether no program has written into the file since it was loaded."""
        return signature_of(self.signature.path, os.fstat(self.file.fileno())) == self.signature


@dataclass(frozen=True)
class SceneStatus:
    """State of a scene, known without loading it."""

    name: str
    loaded: bool  # whether a version of it is in memory
    problem: SceneFileInvalid | None  # why the current file can't be loaded; None before the first attempt


@dataclass
class _Entry:
    lock: threading.Lock = field(default_factory=threading.Lock)  # held while loading
    tried: Signature | None = None
    served: ServedScene | None = None
    problem: SceneFileInvalid | None = None
    retry_at: float = math.inf  # when the same file is tried again

    def is_tried(self, signature: Signature) -> bool:
        """Whether there is no reason to load the file of this signature now."""
        return self.tried == signature and time.monotonic() < self.retry_at


class SceneStore:
    """Scenes in files and folders, named by the files' stems. Safe to use from several threads.

    Folders are listed again by every call, so that files may come, change and go. `refresh` reloads changed files;
    meanwhile requests get the old version, and keep it if the new file is invalid, which `status` reports. A file that
    can't be read is tried again.

    Scenes are added to and removed from `folder`, the first of the paths, whose files never hide those of others.

    Above `max_bytes` in all, the least recently used scene is unloaded, and loads again at the next request. An old
    version whose new file is invalid stays, and so does the last scene.
    """

    def __init__(
        self,
        paths: Sequence[Path | str],
        open_scene: Callable[[Path], DeformationSession] = DeformationSession,
        max_bytes: int = sys.maxsize,
    ) -> None:
        self._paths = [checked(Path(path)) for path in paths]
        self.folder = next((path for path in self._paths if path.is_dir()), None)
        self._paths.sort(key=lambda path: path == self.folder)
        self._open_scene, self._max_bytes = open_scene, max_bytes
        self._entries: dict[str, _Entry] = {}  # the one requested last comes last
        self._lock = threading.Lock()
        self._writing = threading.Lock()  # held while files are added or removed
        self._hidden: set[Path] = set()  # files whose names others have
        by_name: dict[str, Path] = {}
        for file in self._scan():
            if by_name.setdefault(file.stem, file) != file and file.parent != self.folder:
                raise InvalidInput("paths", "scenes of different names", f"{by_name[file.stem]} and {file}")

    def names(self) -> list[str]:
        """Return the names of all scenes, sorted, without opening them."""
        return sorted(self._files())

    def file(self, name: str) -> Path:
        """Find a scene's file, without listing folders: every request does this. Raises `SceneNotFound`."""
        if is_servable_name(name) and "/" not in name:
            for path in self._paths:
                file = path / f"{name}{SUFFIX}" if path.is_dir() else path
                if file.stem == name and file.is_file():
                    return file
        raise SceneNotFound(name, self.names())

    def status(self, name: str) -> SceneStatus:
        """Return the state of a scene. Raises `SceneNotFound`."""
        self.file(name)
        return self._status(name)

    def statuses(self) -> list[SceneStatus]:
        """Return the states of all scenes, sorted by name."""
        return [self._status(name) for name in self.names()]

    def get(self, name: str) -> ServedScene:
        """Return the scene as it was last loaded; the first call loads it, and one after it was unloaded.

        Raises:
            SceneNotFound: if there is no file of this name.
            SceneFileInvalid: if it violates the contract and no earlier version is loaded.
        """
        file = self.file(name)
        entry = self._entry(name)
        served = entry.served
        if served is None:
            served = self._update(entry, file)
            self._make_room()
        if served is None:
            raise entry.problem.again() if entry.problem else SceneNotFound(name, [])
        return served

    def open(self, name: str) -> SceneContents | None:
        """Open the file of the version that `get` returns; return None if it has changed and isn't reloaded yet.

        Raises `SceneNotFound`, and `SceneFileInvalid` if the file violates the contract, also if an earlier version of
        it is loaded.
        """
        served, path = self.get(name), self.file(name)
        if problem := self._entry(name).problem:
            raise problem.again()
        try:
            contents = SceneContents(name, served.sha256, path.open("rb"), served.signature)
        except FileNotFoundError:
            raise SceneNotFound(name, self.names()) from None
        if contents.is_unchanged:
            return contents
        contents.file.close()
        return None

    def refresh(self) -> None:
        """Reload files that changed since the last attempt or are due for another. Scenes that weren't requested are
        not loaded."""
        for name, file in self._files().items():
            with self._lock:
                entry = self._entries.get(name)
            if entry is not None and entry.tried is not None:
                self._update(entry, file)
        self._make_room()

    def incoming(self, token: str) -> Path:
        """Return a hidden temporary path for the file of a scene to be added."""
        return self._writable_folder() / f"{INCOMING_PREFIX}{token}"

    def clear_incoming(self) -> None:
        """Remove old temporary files, which a process has left."""
        for file in self._writable_folder().glob(f"{INCOMING_PREFIX}*"):
            with suppress(OSError):  # the upload ended meanwhile
                if file.stat().st_mtime < time.time() - INCOMING_SECONDS:
                    file.unlink()

    def target(self, name: str, *, replace: bool = False) -> Path:
        """Return the path of a scene to be added. Raises `InvalidInput` and `SceneExists` as `add`."""
        if not is_servable_name(name) or "/" in name:
            raise InvalidInput(
                "name", f"printable text of at most {MAX_NAME_BYTES} bytes without separators", repr(name)
            )
        target = self._writable_folder() / f"{name}{SUFFIX}"
        present = self._files().get(name, target)
        if present != target or (present.exists() and not replace):
            raise _exists(name)
        return target

    def add(self, name: str, incoming: Path, *, replace: bool = False) -> ServedScene:
        """Open a file from `incoming`, and if it is valid, move it atomically to the scene `name`.

        Raises:
            InvalidInput: if the name isn't valid.
            SceneExists: if the scene exists and `replace` is false.
            SceneFileInvalid: if the file violates the contract.
        """
        with self._writing:
            target = self.target(name, replace=replace)
            scene = self._open(incoming, name)
            entry = self._entry(name)
            with entry.lock:
                try:
                    move(incoming, target, replace=replace)
                except FileExistsError:  # another process was faster
                    raise _exists(name) from None
                entry.tried = signature_of(target)
                scene.session.path = target
                entry.served = served = replaced(scene, signature=entry.tried)
                entry.problem, entry.retry_at = None, math.inf
            self._make_room()
            return served

    def remove(self, name: str) -> None:
        """Delete a scene's file. Renders in progress are finished.

        Raises `SceneNotFound`, and `InvalidInput` for a scene in another folder.
        """
        folder = self._writable_folder()
        with self._writing:
            file = self.file(name)
            own = folder / file.name  # may be hidden by `file`
            if file != own and not own.exists():
                raise InvalidInput("name", "that of a scene in the folder for uploads", name)
            own.unlink(missing_ok=True)
            sync(folder)

    def _status(self, name: str) -> SceneStatus:
        with self._lock:
            entry = self._entries.get(name, _Entry())
        return SceneStatus(name, entry.served is not None, entry.problem)

    def _writable_folder(self) -> Path:
        if self.folder is None:
            raise InvalidInput(
                "paths", "paths with a folder, to which scenes are added", [str(path) for path in self._paths]
            )
        return self.folder

    def _update(self, entry: _Entry, file: Path) -> ServedScene | None:
        """Load `file` if it changed since the last attempt or is due for another, and return the version that is
        served. Other threads wait only if there is none."""
        try:
            signature = signature_of(file)
        except FileNotFoundError:
            return entry.served
        served = entry.served
        if (served and entry.is_tried(signature)) or not entry.lock.acquire(blocking=served is None):
            return served
        try:
            if not entry.is_tried(signature):
                self._load(entry, file, signature)
            return entry.served
        finally:
            entry.lock.release()

    def _make_room(self) -> None:
        with self._lock:  # threads that hold an entry's lock don't wait for this one
            loaded = [entry for entry in self._entries.values() if entry.served]
            total = sum(entry.served.bytes for entry in loaded if entry.served)
            for entry in loaded[:-1]:
                if total <= self._max_bytes:
                    return
                if entry.lock.acquire(blocking=False):
                    if entry.served and entry.problem is None:
                        total -= entry.served.bytes
                        entry.tried = entry.served = None
                    entry.lock.release()

    def _load(self, entry: _Entry, file: Path, signature: Signature) -> None:
        entry.retry_at = math.inf
        try:
            entry.served, entry.problem = self._open(file, file.stem), None
        except SceneFileInvalid as error:
            entry.problem = error.again()
            if isinstance(error.__cause__, TEMPORARY):
                entry.retry_at = time.monotonic() + RETRY_SECONDS
        except TEMPORARY as error:
            reason = getattr(error, "strerror", None) or "memory is short"
            entry.problem = SceneFileInvalid(file.name, "file", f"can't be read: {reason}")
            entry.retry_at = time.monotonic() + RETRY_SECONDS
        except Exception as error:  # one file must not keep others from being served
            logger.exception("%s can't be opened", file)
            entry.problem = SceneFileInvalid(file.name, "file", f"can't be opened: {type(error).__name__}")
        entry.tried = signature

    def _open(self, file: Path, name: str) -> ServedScene:
        """Open the scene in a file, again if the file changes meanwhile."""
        for _ in range(MAX_OPEN_ATTEMPTS):
            before = signature_of(file)
            session = self._open_scene(file)
            if signature_of(file) == before:
                return ServedScene(name, session, before)
        raise SceneFileInvalid(file.name, "file", "changes while it is being read")

    def _entry(self, name: str) -> _Entry:
        with self._lock:
            entry = self._entries[name] = self._entries.pop(name, None) or _Entry()
        return entry

    def _files(self) -> dict[str, Path]:
        """Return the files by scene name, and drop scenes whose file was removed."""
        files: dict[str, Path] = {}
        found = self._scan()
        for file in found:
            files.setdefault(file.stem, file)
        hidden = set(found) - set(files.values())
        with self._lock:
            for file in hidden - self._hidden:
                logger.warning("%s is not served, as %s has its name", file, files[file.stem])
            self._hidden = hidden
            for name in self._entries.keys() - files.keys():
                del self._entries[name]
        return files

    def _scan(self) -> list[Path]:
        found: list[Path] = []
        for path in self._paths:
            if path.is_dir():
                found += sorted(
                    f for f in path.iterdir() if f.suffix == SUFFIX and is_servable_name(f.stem) and f.is_file()
                )
            elif path.is_file():
                found.append(path)
        return found


def _exists(name: str) -> SceneExists:
    return SceneExists(f"the scene `{name}` exists already")
