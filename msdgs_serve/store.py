"""The scenes on disk: found by name, opened when first asked for, reloaded when their file changes."""

import os
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from msdgs_serve.deformation import DeformationSession
from msdgs_serve.scene import InvalidInput, SceneFileInvalid, SceneNotFound

SUFFIX = ".onnx"
MAX_NAME_LENGTH = 200

Signature = tuple[Path, int, int, int]


@dataclass(frozen=True)
class SceneStatus:
    """What the store knows of a scene without opening it."""

    name: str
    loaded: bool  # whether some version of it is being served
    problem: str | None  # why the file as it is now can't be loaded; None before the first try


@dataclass
class _Entry:
    lock: threading.Lock = field(default_factory=threading.Lock)  # held by the thread that loads
    tried: Signature | None = None
    session: DeformationSession | None = None
    problem: SceneFileInvalid | None = None


class SceneStore:
    """Scenes in files and folders, named by the files' stems. Safe to use from several threads.

    Folders are looked at again with every call, so that files may come, change and go. A file that changes is loaded
    by the next call that asks for it, while other threads still get the scene as it was; a file that breaks is
    reported by `status` and the scene as it was stays.
    """

    def __init__(
        self, paths: Sequence[Path | str], open_scene: Callable[[Path], DeformationSession] = DeformationSession
    ) -> None:
        self._paths = [_checked(Path(path)) for path in paths]
        self._open_scene = open_scene
        self._entries: dict[str, _Entry] = {}
        self._lock = threading.Lock()
        by_name: dict[str, Path] = {}
        for file in self._scan():
            if by_name.setdefault(file.stem, file) != file:
                raise InvalidInput("paths", "scenes of different names", f"{by_name[file.stem]} and {file}")

    def names(self) -> list[str]:
        """Of all scenes, sorted; whether they can be opened is not known yet."""
        return sorted(self._files())

    def status(self, name: str) -> SceneStatus:
        """Raises `SceneNotFound`."""
        files = self._files()
        if name not in files:
            raise SceneNotFound(name, sorted(files))
        entry = self._entry(name)
        return SceneStatus(name, entry.session is not None, str(entry.problem) if entry.problem else None)

    def get(self, name: str) -> DeformationSession:
        """The scene, from its newest file that could be loaded.

        Raises:
            SceneNotFound: if there is no file of this name.
            SceneFileInvalid: if it breaks the contract and no earlier version of it is being served.
        """
        files = self._files()
        if name not in files:
            raise SceneNotFound(name, sorted(files))
        entry = self._entry(name)
        try:
            signature = _signature(files[name])
        except FileNotFoundError:
            raise SceneNotFound(name, sorted(set(files) - {name})) from None
        if entry.tried != signature and entry.lock.acquire(blocking=entry.session is None):
            try:
                if entry.tried != signature:
                    self._load(entry, signature)
            finally:
                entry.lock.release()
        if entry.session is None:
            assert entry.problem is not None
            raise entry.problem
        return entry.session

    def _load(self, entry: _Entry, signature: Signature) -> None:
        path = signature[0]
        try:
            entry.session, entry.problem = self._open_scene(path), None
        except SceneFileInvalid as error:
            entry.problem = error
        except OSError as error:
            entry.problem = SceneFileInvalid(str(path), "file", f"can't be read: {error.strerror}")
        entry.tried = signature

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


def _checked(path: Path) -> Path:
    if path.is_dir():
        return path
    if not path.is_file():
        raise InvalidInput("paths", f"{SUFFIX} files and folders of them", f"{path}, which does not exist")
    if path.suffix != SUFFIX:
        hint = "; `python export/to_onnx.py model.pt` turns a checkpoint into a scene" if path.suffix == ".pt" else ""
        raise InvalidInput("paths", f"{SUFFIX} files and folders of them", f"{path}{hint}")
    if not _servable_name(path.stem):
        raise InvalidInput("paths", "files with plain names", repr(path.name))
    return path


def _is_scene(file: Path) -> bool:
    return file.suffix == SUFFIX and _servable_name(file.stem) and file.is_file()


def _servable_name(name: str) -> bool:
    """Not hidden (files being written are), and printable text without separators."""
    return not name.startswith(".") and name.isprintable() and len(name) <= MAX_NAME_LENGTH and "\\" not in name


def _signature(path: Path) -> Signature:
    status = os.stat(path)
    return path, status.st_mtime_ns, status.st_size, status.st_ino
