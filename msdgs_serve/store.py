"""The scenes on disk: found by name, opened when first asked for, swapped when their file changes."""

import logging
import os
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from msdgs_serve.deformation import DeformationSession
from msdgs_serve.framing import Framing, framing
from msdgs_serve.scene import InvalidInput, MsdgsError, SceneFileInvalid, SceneNotFound

SUFFIX = ".onnx"
INCOMING_PREFIX = ".incoming-"
MAX_NAME_LENGTH = 200
OPEN_TRIES = 5

logger = logging.getLogger("msdgs_serve")

Signature = tuple[Path, int, int, int]


class SceneExists(MsdgsError):
    """There is a scene of this name, and it was not to be replaced."""


@dataclass(frozen=True)
class ServedScene:
    """One version of a scene, in memory."""

    name: str
    session: DeformationSession

    @property
    def sha256(self) -> str:
        """Of its file."""
        return self.session.sha256

    @cached_property
    def framing(self) -> Framing:
        """How it is seen where a request says nothing; needed for each."""
        return framing(self.session.scene.metadata)


@dataclass(frozen=True)
class SceneStatus:
    """What the store knows of a scene without opening it."""

    name: str
    loaded: bool  # whether some version of it is being served
    problem: SceneFileInvalid | None  # why the file as it is now can't be loaded; None before the first try


@dataclass
class _Entry:
    lock: threading.Lock = field(default_factory=threading.Lock)  # held by the thread that loads
    tried: Signature | None = None
    served: ServedScene | None = None
    problem: SceneFileInvalid | None = None


class SceneStore:
    """Scenes in files and folders, named by the files' stems. Safe to use from several threads.

    Folders are looked at again with every call, so that files may come, change and go. A file that changes is loaded
    by `refresh`, while others still get the scene as it was; a file that breaks is reported by `status` and the scene
    as it was stays.
    """

    def __init__(
        self, paths: Sequence[Path | str], open_scene: Callable[[Path], DeformationSession] = DeformationSession
    ) -> None:
        self._paths = [_checked(Path(path)) for path in paths]
        self._open_scene = open_scene
        self._entries: dict[str, _Entry] = {}
        self._lock = threading.Lock()
        self._writing = threading.Lock()  # held while files are put in or taken out
        by_name: dict[str, Path] = {}
        for file in self._scan():
            if by_name.setdefault(file.stem, file) != file:
                raise InvalidInput("paths", "scenes of different names", f"{by_name[file.stem]} and {file}")

    @property
    def folder(self) -> Path | None:
        """Where scenes are added and removed: the first folder among the paths."""
        return next((path for path in self._paths if path.is_dir()), None)

    def names(self) -> list[str]:
        """Of all scenes, sorted; whether they can be opened is not known yet."""
        return sorted(self._files())

    def file(self, name: str) -> Path:
        """Where a scene lies, for what may lie beside it. Raises `SceneNotFound`."""
        return self._file(name)

    def status(self, name: str) -> SceneStatus:
        """Raises `SceneNotFound`."""
        self._file(name)
        return self._status(name)

    def statuses(self) -> list[SceneStatus]:
        """Of all scenes, sorted by name."""
        return [self._status(name) for name in self.names()]

    def get(self, name: str) -> ServedScene:
        """The scene as it was last loaded; the first call for it loads it.

        Raises:
            SceneNotFound: if there is no file of this name.
            SceneFileInvalid: if it breaks the contract and no earlier version of it is being served.
        """
        file = self._file(name)
        entry = self._entry(name)
        if entry.served is None:
            self._update(entry, file)
        if entry.served is None:
            raise entry.problem.again() if entry.problem else SceneNotFound(name, [])
        return entry.served

    def refresh(self) -> None:
        """Load anew what changed on disk since it was loaded or tried. Scenes nobody asked for yet stay closed."""
        for name, file in self._files().items():
            with self._lock:
                entry = self._entries.get(name)
            if entry is not None:
                self._update(entry, file)

    def incoming(self, token: str) -> Path:
        """Where the file of a scene to be added is written first; no scene yet, as its name is hidden."""
        return self._writable_folder() / f"{INCOMING_PREFIX}{token}"

    def clear_incoming(self) -> None:
        """Remove what a process that died left of files to be added."""
        for file in self._writable_folder().glob(f"{INCOMING_PREFIX}*"):
            file.unlink(missing_ok=True)

    def add(self, name: str, incoming: Path, *, replace: bool = False) -> ServedScene:
        """Open a file from `incoming`, and make it the scene `name` if it is one. All or nothing.

        Raises:
            InvalidInput: if the name isn't a plain one.
            SceneExists: if there is one and it was not to be replaced.
            SceneFileInvalid: if the file breaks the contract.
        """
        if not is_servable_name(name) or "/" in name:
            raise InvalidInput("name", f"plain text of at most {MAX_NAME_LENGTH} letters, no separators", repr(name))
        target = self._writable_folder() / f"{name}{SUFFIX}"
        with self._writing:
            present = self._files().get(name, target)
            if present != target or (present.exists() and not replace):
                raise SceneExists(f"there is a scene `{name}` already")
            session = self._open(incoming)
            _write_through(incoming)
            entry = self._entry(name)
            with entry.lock:
                os.replace(incoming, target)
                _write_through(target.parent)
                entry.served, entry.problem = ServedScene(name, session), None
                entry.tried = _signature(target)
            return entry.served

    def remove(self, name: str) -> None:
        """Delete a scene's file; who draws it at this moment is not disturbed.

        Raises `SceneNotFound`, and `InvalidInput` for a scene that lies elsewhere.
        """
        folder = self._writable_folder()
        with self._writing:
            file = self._file(name)
            if file.parent != folder:
                raise InvalidInput("name", "that of a scene in the folder for uploads", name)
            file.unlink(missing_ok=True)
            _write_through(folder)

    def _status(self, name: str) -> SceneStatus:
        entry = self._entry(name)
        return SceneStatus(name, entry.served is not None, entry.problem)

    def _writable_folder(self) -> Path:
        if self.folder is None:
            raise InvalidInput(
                "paths", "with a folder, as scenes are added to one", [str(path) for path in self._paths]
            )
        return self.folder

    def _file(self, name: str) -> Path:
        """Looked for by its name alone: every request does this, and a folder may hold any number of scenes."""
        if is_servable_name(name) and "/" not in name:
            for path in self._paths:
                file = path / f"{name}{SUFFIX}" if path.is_dir() else path
                if file.stem == name and file.is_file():
                    return file
        raise SceneNotFound(name, self.names())

    def _update(self, entry: _Entry, file: Path) -> None:
        """Load `file` where it isn't what was tried last; one thread does, those that have a scene don't wait."""
        try:
            signature = _signature(file)
        except FileNotFoundError:
            return
        if entry.tried == signature or not entry.lock.acquire(blocking=entry.served is None):
            return
        try:
            if entry.tried != signature:
                self._load(entry, file, signature)
        finally:
            entry.lock.release()

    def _load(self, entry: _Entry, file: Path, signature: Signature) -> None:
        try:
            entry.served, entry.problem = ServedScene(file.stem, self._open(file)), None
        except SceneFileInvalid as error:
            entry.problem = error.again()
        except OSError as error:
            entry.problem = SceneFileInvalid(file.name, "file", f"can't be read: {error.strerror}")
        except Exception as error:  # one file, whatever is in it, doesn't stop the others from being served
            logger.exception("%s can't be opened", file)
            entry.problem = SceneFileInvalid(file.name, "file", f"can't be opened: {type(error).__name__}")
        entry.tried = signature

    def _open(self, file: Path) -> DeformationSession:
        """The scene in a file; of one version, though the file may change meanwhile."""
        for _ in range(OPEN_TRIES):
            before = _signature(file)
            session = self._open_scene(file)
            if _signature(file) == before:
                return session
        raise SceneFileInvalid(file.name, "file", "changes while it is read")

    def _entry(self, name: str) -> _Entry:
        with self._lock:
            return self._entries.setdefault(name, _Entry())

    def _files(self) -> dict[str, Path]:
        """Name → file; scenes whose file is gone are forgotten."""
        files: dict[str, Path] = {}
        for file in self._scan():
            files.setdefault(file.stem, file)
        with self._lock:
            for name in self._entries.keys() - files.keys():
                del self._entries[name]
        return files

    def _scan(self) -> list[Path]:
        found: list[Path] = []
        for path in self._paths:
            if path.is_dir():
                found += sorted(file for file in path.iterdir() if _is_scene(file))
            elif path.is_file():
                found.append(path)
        return found


def is_servable_name(name: str) -> bool:
    """Not hidden (files being written are), and printable text without separators."""
    return bool(name) and name[0] != "." and name.isprintable() and len(name) <= MAX_NAME_LENGTH and "\\" not in name


def _checked(path: Path) -> Path:
    if path.is_dir():
        return path
    if not path.is_file():
        raise InvalidInput("paths", f"{SUFFIX} files and folders of them", f"{path}, which does not exist")
    if path.suffix != SUFFIX:
        hint = "; `python export/to_onnx.py model.pt` turns a checkpoint into a scene" if path.suffix == ".pt" else ""
        raise InvalidInput("paths", f"{SUFFIX} files and folders of them", f"{path}{hint}")
    if not is_servable_name(path.stem):
        raise InvalidInput("paths", "files with plain names", repr(path.name))
    return path


def _is_scene(file: Path) -> bool:
    return file.suffix == SUFFIX and is_servable_name(file.stem) and file.is_file()


def _signature(path: Path) -> Signature:
    status = os.stat(path)
    return path, status.st_mtime_ns, status.st_size, status.st_ino


def _write_through(path: Path) -> None:
    """Onto the disk, so that a loss of power doesn't undo it."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
