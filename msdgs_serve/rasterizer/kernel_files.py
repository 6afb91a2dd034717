"""numba's cache of compiled kernels: damaged files are replaced, read-only folders are copied to a writable one.

numba stores pickles beside the sources or under `NUMBA_CACHE_DIR`. By default a truncated file makes every call of its
kernel fail, and importing a kernel fails if no folder can be written.
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
"""Digits of the digest in the name of a file of machine code."""

logger = logging.getLogger("msdgs_serve")


class CheckedFiles(IndexDataCacheFile):
    """One kernel's files, each with the SHA-256 of its contents. A file that doesn't match is removed and recompiled.

    A file of machine code is named by its digest. numba's own names are numbers: two processes that store code for
    different types at the same time take the same number, and a call may run the code for other types.
    """

    def load(self, key: Any) -> Any:
        """Return the stored machine code, or None if it is missing or damaged."""
        try:
            return super().load(key)
        except Exception as error:  # unpickling damaged bytes may raise any exception
            self._wipe(error)
            return None

    def save(self, key: Any, data: Any) -> None:
        """Store machine code. If the disk is full or missing, log it: the next start compiles again."""
        try:
            self._save(key, data)
        except OSError as error:
            logger.warning("kernels can't be stored: %s", error.strerror)
        except Exception as error:
            self._wipe(error)
            self._save(key, data)

    def _save(self, key: Any, data: Any) -> None:
        """Write the data before the index that names it; if the sources have changed, remove the old data first."""
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
            raise ValueError("the digest doesn't match")
        return super()._load_data(name)  # pyright: ignore[reportAttributeAccessIssue]

    def _wipe(self, error: Exception) -> None:
        logger.warning("stored kernel %s is damaged (%s), it is compiled again", self._index_name, type(error).__name__)
        self._remove([Path(self._cache_path) / self._index_name, *self._data_files()])

    def _remove(self, files: list[Path]) -> None:
        for file in files:
            with contextlib.suppress(OSError):
                file.unlink()


def use_writable_folder(package: Path) -> bool:
    """Make sure that kernels of `package` can be stored. Return False if no folder can be written.

    If the usual folder is read-only (a container, an installation by root), its kernels are copied to a temporary
    folder of this process, so that precompiled kernels are used.
    """
    usual = Path(config.CACHE_DIR) if config.CACHE_DIR else package / "__pycache__"  # pyright: ignore
    if is_writable(usual):
        return True
    try:
        copy = Path(tempfile.mkdtemp(prefix="msdgs-kernels-"))  # mode 0700: files here are run as code by this process
    except OSError:
        return False
    atexit.register(shutil.rmtree, copy, ignore_errors=True)
    with contextlib.suppress(OSError):
        copy_kernels(usual if config.CACHE_DIR else package, copy, nested=not config.CACHE_DIR)  # pyright: ignore
    config.CACHE_DIR = str(copy)  # pyright: ignore[reportAttributeAccessIssue]
    return True


def is_writable(folder: Path) -> bool:
    """Whether files can be created in a folder; the folder is created if it is missing."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True


def copy_kernels(source: Path, target: Path, *, nested: bool) -> None:
    """Copy machine code to a folder in numba's layout; `nested`: from the `__pycache__` folders of a package."""
    if not nested:
        shutil.copytree(source, target, dirs_exist_ok=True)
        return
    for file in source.rglob("__pycache__/*.nb[ic]"):
        subfolder = UserProvidedCacheLocator.get_suitable_cache_subpath(str(file.parent.parent / "module.py"))
        (target / subfolder).mkdir(exist_ok=True)
        shutil.copy(file, target / subfolder)
