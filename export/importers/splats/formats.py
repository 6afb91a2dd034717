"""Formats of one set of Gaussians: detection, and the reader of each."""

import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from export.importers.errors import ImportFailed
from export.importers.guard import read_guarded
from export.importers.splats.base import Splats
from export.importers.splats.ksplat import read_ksplat
from export.importers.splats.ply import read_ply
from export.importers.splats.sog import LEVELS, META, ZIP_PROBLEMS, read_sog, refused_levels
from export.importers.splats.splat import read_splat
from export.importers.splats.spz import read_spz

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
"""Formats that native code decompresses, in a subprocess; the others are read by NumPy."""


def splat_format(path: Path) -> str | None:
    """The format of a file, or of a SOG folder; None if it is none of `READERS`. Raises `ImportFailed`."""
    if path.name == LEVELS or (path / LEVELS).is_file():
        raise refused_levels(path)
    if path.is_dir():
        return "sog" if (path / META).is_file() else None
    with path.open("rb") as file:
        start = file.read(16)
    if start.startswith(b"ply"):
        return "ply"
    if start.startswith((b"NGSP", b"\x1f\x8b")):
        return "spz"
    if path.name == META:
        return "sog"
    try:
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                names = {name.rsplit("/", 1)[-1] for name in archive.namelist()}
            if LEVELS in names:
                raise refused_levels(path)
            return "sog" if META in names else None
    except ZIP_PROBLEMS:
        raise ImportFailed(path, "isn't a whole zip") from None
    suffix = path.suffix.lower()
    return suffix[1:] if suffix in (".splat", ".ksplat", ".sog", ".spz") else None


def read_splats(path: Path, file_format: str | None = None) -> Splats:
    """Read one set of Gaussians in `file_format`, by default the detected one. Raises `ImportFailed`."""
    try:
        file_format = file_format or splat_format(path)
        if file_format not in READERS:
            raise ImportFailed(path, f"isn't a file of one set of Gaussians: {', '.join(READERS)}")
        if file_format in UNPACKED:
            return Splats.from_arrays(read_guarded(read_arrays, path, file_format))
        return READERS[file_format](path)
    except OSError as error:
        raise ImportFailed(path, f"can't be read: {error.strerror or error}") from error


def read_arrays(path: Path, file_format: str) -> dict[str, np.ndarray]:
    """The result of a reader as arrays. Raises `ImportFailed`."""
    return READERS[file_format](path).to_arrays()
