"""Machine code on disk: files that are cut off or changed are compiled anew, folders that can't be written are copied.

numba keeps pickles beside the sources, or under `NUMBA_CACHE_DIR`. As it comes, one truncated file makes every call
of its kernel fail, and where no folder can be written importing a kernel fails.
"""

import atexit
import contextlib
import hashlib
import logging
import shutil
import tempfile
from pathlib import Path
from typing import Any

from numba.core import config
from numba.core.caching import IndexDataCacheFile, UserProvidedCacheLocator

DIGEST_BYTES = hashlib.sha256().digest_size
NAME_DIGITS = 16
"""Of a file of machine code."""

logger = logging.getLogger("msdgs_serve")


class CheckedFiles(IndexDataCacheFile):
    """One kernel's files, each with the SHA-256 of its contents. What doesn't match is wiped, then made anew.

    Machine code lies under the digest of itself. numba numbers its files: of two processes that store code for other
    types at the same time both take the same number, and a call may run the code of other types.
    """

    def load(self, key: Any) -> Any:
        """The stored machine code; None where there is none that is whole."""
        try:
            return super().load(key)
        except Exception as error:  # unpickling foreign bytes raises nearly anything
            self._wipe(error)
            return None

    def save(self, key: Any, data: Any) -> None:
        """Store machine code; a disk that is full or gone costs the next start its time, not this call its answer."""
        try:
            self._save(key, data)
        except OSError as error:
            logger.warning("kernels can't be stored: %s", error.strerror)
        except Exception as error:
            self._wipe(error)
            self._save(key, data)

    def _save(self, key: Any, data: Any) -> None:
        """The data before the index that names it; where the sources have changed, what was stored before goes."""
        known: dict[Any, str] = self._load_index()  # pyright: ignore[reportAttributeAccessIssue]
        if not known:
            self._remove(self._data_files())
        name = self._data_name(hashlib.sha256(self._dump(data)).hexdigest()[:NAME_DIGITS])
        self._save_data(name, data)  # pyright: ignore[reportAttributeAccessIssue]
        self._save_index(known | {key: name})  # pyright: ignore[reportAttributeAccessIssue]

    def _data_name(self, digest: str) -> str:
        return self._index_name.removesuffix("nbi") + f"{digest}.nbc"

    def _data_files(self) -> list[Path]:
        return list(Path(self._cache_path).glob(self._data_name("*")))

    def _dump(self, obj: Any) -> bytes:
        payload = super()._dump(obj)  # pyright: ignore[reportAttributeAccessIssue]
        return payload + hashlib.sha256(payload).digest()  # pickle reads no further than its own end

    def _load_data(self, name: str) -> Any:
        stored = (Path(self._cache_path) / name).read_bytes()
        payload, digest = stored[:-DIGEST_BYTES], stored[-DIGEST_BYTES:]
        if hashlib.sha256(payload).digest() != digest:
            raise ValueError("its digest is another")
        return super()._load_data(name)  # pyright: ignore[reportAttributeAccessIssue]

    def _wipe(self, error: Exception) -> None:
        logger.warning("stored kernel %s is damaged (%s), it is compiled anew", self._index_name, type(error).__name__)
        self._remove([Path(self._cache_path) / self._index_name, *self._data_files()])

    def _remove(self, files: list[Path]) -> None:
        for file in files:
            with contextlib.suppress(OSError):
                file.unlink()


def use_writable_folder(package: Path) -> bool:
    """Make sure that kernels of `package` can be stored; False where nothing can be written at all.

    Where the usual folder is read-only (a container, an installation by root), what it holds is copied to a folder of
    this process, so that what was compiled beforehand is used.
    """
    usual = Path(config.CACHE_DIR) if config.CACHE_DIR else package / "__pycache__"  # pyright: ignore
    if is_writable(usual):
        return True
    try:
        copy = Path(tempfile.mkdtemp(prefix="msdgs-kernels-"))  # mode 0700: who writes here runs code in this process
    except OSError:
        return False
    atexit.register(shutil.rmtree, copy, ignore_errors=True)
    with contextlib.suppress(OSError):
        copy_kernels(usual if config.CACHE_DIR else package, copy, nested=not config.CACHE_DIR)  # pyright: ignore
    config.CACHE_DIR = str(copy)  # pyright: ignore[reportAttributeAccessIssue]
    return True


def is_writable(folder: Path) -> bool:
    """Whether a file can be made there; the folder itself is made where it is missing."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True


def copy_kernels(source: Path, target: Path, *, nested: bool) -> None:
    """Copy machine code to a folder of numba's layout; from `__pycache__` folders below a package where `nested`."""
    if not nested:
        shutil.copytree(source, target, dirs_exist_ok=True)
        return
    for file in source.rglob("__pycache__/*.nb[ic]"):
        room = UserProvidedCacheLocator.get_suitable_cache_subpath(str(file.parent.parent / "module.py"))
        (target / room).mkdir(exist_ok=True)
        shutil.copy(file, target / room)
