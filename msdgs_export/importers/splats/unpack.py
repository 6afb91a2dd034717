"""Splat files inside a zip, such as Luma's, or a gzip: their detection, and unpacking within limits."""

import gzip
import zipfile
import zlib
from pathlib import Path
from typing import IO

from msdgs_export.importers.errors import ImportFailed
from msdgs_export.importers.splats.sog import ZIP_PROBLEMS

GZIP, ZIP = b"\x1f\x8b\x08", b"PK\x03\x04"
SUFFIXES = (".ply", ".spz", ".splat", ".ksplat", ".sog")

MAX_FACTOR, MIN_LIMIT = 64, 1 << 22
"""An archive unpacks to so many times its own bytes at most; splats to 10 times, if many of their numbers are 0."""

PIECE = 1 << 20
METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)

OTHERS = {b"7z\xbc\xaf": "7z", b"Rar!": "RAR", b"\x28\xb5\x2f\xfd": "Zstandard", b"BZh": "bzip2", b"\xfd7zXZ": "xz"}
"""First bytes of archives that aren't read, and their names."""


def splat_in_zip(path: Path, names: list[str]) -> str | None:
    """The only splat among the names of a zip, None if there is none. Raises `ImportFailed` naming several."""
    found = [name for name in names if name.lower().endswith(SUFFIXES) and _is_shown(name)]
    if len(found) > 1:
        shown = ", ".join(found[:4]) + (f" and {len(found) - 4} more" * (len(found) > 4))
        raise ImportFailed(path, f"holds {len(found)} splats: {shown}; unpack it and choose one, or a folder of frames")
    return found[0] if found else None


def gzip_start(path: Path, size: int) -> bytes:
    """The first bytes of a gzip's contents. Raises `ImportFailed`."""
    try:
        with gzip.open(path) as stream:
            return stream.read(size)
    except (zlib.error, EOFError, gzip.BadGzipFile):
        raise ImportFailed(path, "isn't a whole gzip file") from None


def unpack(path: Path, folder: Path) -> Path:
    """Write the splat of a zip or gzip into a folder. Raises `ImportFailed`."""
    limit = max(MAX_FACTOR * path.stat().st_size, MIN_LIMIT)
    try:
        if not zipfile.is_zipfile(path):
            with gzip.open(path) as stream:
                return _written(path, stream, folder / path.with_suffix("").name, limit)
        with zipfile.ZipFile(path) as archive:
            name = splat_in_zip(path, archive.namelist())
            if name is None:
                raise ImportFailed(path, f"holds no {', '.join(SUFFIXES)}")
            entry = archive.getinfo(name)
            if entry.flag_bits & 1:
                raise ImportFailed(path, f"its {name} is encrypted; unpack it first")
            if entry.compress_type not in METHODS:
                raise ImportFailed(path, f"its {name} is packed by method {entry.compress_type}; unpack it first")
            with archive.open(entry) as stream:
                return _written(path, stream, folder / Path(name).name, limit)
    except (*ZIP_PROBLEMS, gzip.BadGzipFile):
        raise ImportFailed(path, "isn't a whole archive: it can't be unpacked") from None


def _is_shown(name: str) -> bool:
    """Whether it isn't what macOS and others add, such as `__MACOSX/._splat.ply`."""
    parts = name.replace("\\", "/").split("/")
    return not parts[-1].startswith(".") and "__MACOSX" not in parts


def _written(path: Path, stream: IO[bytes] | gzip.GzipFile, target: Path, limit: int) -> Path:
    with target.open("wb") as file:
        while piece := stream.read(PIECE):
            file.write(piece)
            if file.tell() > limit:
                raise ImportFailed(path, f"unpacks to more than {limit:,} bytes, {MAX_FACTOR} times its own: unpack it")
    return target
