"""Formats of one set of Gaussians: detection, and the reader of each."""

import tempfile
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from msdgs_export.importers.errors import ImportFailed
from msdgs_export.importers.guard import read_guarded
from msdgs_export.importers.splats.base import Splats
from msdgs_export.importers.splats.ksplat import read_ksplat
from msdgs_export.importers.splats.sog import LEVELS, META, ZIP_PROBLEMS, read_sog, refused_levels
from msdgs_export.importers.splats.splat import read_splat
from msdgs_export.importers.splats.spz import read_spz
from msdgs_export.importers.splats.unpack import GZIP, OTHERS, ZIP, gzip_start, splat_in_zip, unpack
from msdgs_serve.scene.foreign import LFS_POINTER, START_BYTES, is_lfs_pointer


def read_ply(path: Path) -> Splats:
    """`ply.read_ply`, imported when it is called: it imports numba, which takes longer than to read most files."""
    from msdgs_export.importers.splats import ply

    return ply.read_ply(path)


READERS: dict[str, Callable[[Path], Splats]] = {
    "ply": read_ply,
    "spz": read_spz,
    "spz:unturned": partial(read_spz, converted=False),
    "sog": read_sog,
    "splat": read_splat,
    "ksplat": read_ksplat,
}
"""Readers by name of the format."""

UNPACKED = {"spz", "spz:unturned", "sog"}
"""Formats that native code decompresses, in a subprocess, as zips and gzips of the others; these are read by NumPy."""

SNIFFED = 16
"""Bytes at the start of a file by which its format is known."""


def splat_format(path: Path) -> str | None:
    """The format of a file, or of a SOG folder; None if it is none of `READERS`. Raises `ImportFailed`."""
    if path.name == LEVELS or (path / LEVELS).is_file():
        raise refused_levels(path)
    if path.is_dir():
        return "sog" if (path / META).is_file() else None
    refuse_pointer(path)
    with path.open("rb") as file:
        start = file.read(SNIFFED)
    if kind := next((kind for magic, kind in OTHERS.items() if start.startswith(magic)), None):
        raise ImportFailed(path, f"is a {kind} archive: unpack it first")
    if start.startswith(GZIP):
        start, name = gzip_start(path, SNIFFED), path.with_suffix("").name
        return _by_start(start, name) or "spz"  # whose reader says what is wrong
    if path.name == META:
        return "sog"
    names = _zip_names(path, start)
    if any(name.rsplit("/", 1)[-1] == LEVELS for name in names):
        raise refused_levels(path)
    if any(name.rsplit("/", 1)[-1] == META for name in names):
        return "sog"
    return _by_start(start, splat_in_zip(path, names) or path.name)


def refuse_pointer(path: Path) -> None:
    """Raise `ImportFailed` if a file, or one of a SOG folder, is only a pointer of Git LFS."""
    for file in (path / META, *sorted(path.glob("*.webp"))) if path.is_dir() else [path]:
        if file.is_file():
            with file.open("rb") as stream:
                if is_lfs_pointer(stream.read(START_BYTES)):
                    raise ImportFailed(file, LFS_POINTER)


def read_splats(path: Path, file_format: str | None = None) -> Splats:
    """Read one set of Gaussians in `file_format`, by default the detected one. Raises `ImportFailed`."""
    try:
        refuse_pointer(path)
        file_format = file_format or splat_format(path)
        if file_format not in READERS:
            raise ImportFailed(path, f"isn't a file of one set of Gaussians: {', '.join(READERS)}")
        if _is_packed(path, file_format):
            with tempfile.TemporaryDirectory(prefix="msdgs-unpack-") as folder:
                return Splats.from_arrays(read_guarded(read_packed, path, file_format, folder))
        if file_format in UNPACKED:
            return Splats.from_arrays(read_guarded(read_arrays, path, file_format))
        return READERS[file_format](path)
    except OSError as error:
        raise ImportFailed(path, f"can't be read: {error.strerror or error}") from error


def read_arrays(path: Path, file_format: str) -> dict[str, np.ndarray]:
    """The result of a reader as arrays. Raises `ImportFailed`."""
    return READERS[file_format](path).to_arrays()


def read_packed(path: Path, file_format: str, folder: str) -> dict[str, np.ndarray]:
    """As `read_arrays`, of a splat in a zip or gzip, which is unpacked into a folder. Raises `ImportFailed`."""
    file = unpack(path, Path(folder))
    try:
        refuse_pointer(file)
        return read_arrays(file, file_format)
    except ImportFailed as error:
        raise ImportFailed(path, f"in it, {file.name}: {error.problem}") from None


def _by_start(start: bytes, name: str) -> str | None:
    """The format of a file that begins so, or by its name if its first bytes don't tell."""
    if start.startswith(b"ply"):
        return "ply"
    if start.startswith(b"NGSP"):
        return "spz"
    suffix = Path(name).suffix.lower()[1:]
    return suffix if suffix in READERS else None


def _zip_names(path: Path, start: bytes) -> list[str]:
    """The names in a zip; none of other files."""
    try:
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                return archive.namelist()
    except ZIP_PROBLEMS:
        raise ImportFailed(path, "isn't a whole zip: its list of files can't be read") from None
    if start.startswith(ZIP):
        raise ImportFailed(path, "isn't a whole zip: it is cut off")
    return []


def _is_packed(path: Path, file_format: str) -> bool:
    """Whether a splat is in a zip or gzip that isn't part of its format."""
    if path.is_dir() or path.name == META:
        return False
    with path.open("rb") as file:
        start = file.read(SNIFFED)
    if start.startswith(GZIP):
        return not file_format.startswith("spz")
    return start.startswith(ZIP) and file_format != "sog"
