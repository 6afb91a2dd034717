"""SOG version 2: a folder, or a zip of it, with meta.json and lossless WebP textures of one pixel per Gaussian."""

import json
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from msdgs_export.importers.errors import AS_PLY, ImportFailed
from msdgs_export.importers.splats.base import Splats, Stored, parts_of, smallest_three, splats
from msdgs_export.importers.splats.webp import read_texture
from msdgs_serve.scene.fields import FieldTable

FIELDS = FieldTable(
    "SOG",
    {
        "version": "applied",
        "count": "applied",
        "antialias": "applied",
        "model": "applied",
        "asset": "harmless",
        "extras": "harmless",
        "means.mins": "applied",
        "means.maxs": "applied",
        "means.files": "applied",
        "scales.codebook": "applied",
        "scales.files": "applied",
        "quats.files": "applied",
        "sh0.codebook": "applied",
        "sh0.files": "applied",
        "shN.count": "applied",
        "shN.bands": "applied",
        "shN.codebook": "applied",
        "shN.files": "applied",
    },
)
"""Fields of meta.json. The format's own description lets later versions add fields without a new number."""

PARTS = ("means", "scales", "quats", "sh0", "shN")
META = "meta.json"
LEVELS = "lod-meta.json"
"""Marks a SOG of several levels of detail, each of many pieces, which is streamed while it is shown."""

MAX_META_BYTES = 1 << 24
MAX_GAUSSIANS = 1 << 26
"""Gaussians in one file: a texture has at most 16,383 pixels per side."""

SLACK = 1 << 13
"""Extra pixels of a texture, whose sides are nearly equal multiples of four."""

COEFFICIENTS = {1: 3, 2: 8, 3: 15}
"""SH coefficients per channel above degree 0, by number of bands."""

ENTRIES_PER_ROW = 64
"""Entries of the palette of SH in a row of its texture."""

ZIP_PROBLEMS = (
    zipfile.BadZipFile,
    zlib.error,
    EOFError,
    RuntimeError,
    UnicodeDecodeError,  # names of files
    OverflowError,  # offsets beyond 2⁶³
)
"""Errors of zipfile for damaged files."""


def read_sog(path: Path) -> Splats:
    """Read a SOG folder, its meta.json or a zip. Raises `ImportFailed`."""
    if path.is_dir() or path.name == META:
        folder = path if path.is_dir() else path.parent
        made = _decoded(path, lambda name, most: _from_folder(path, folder / name, most))
        if not (folder.resolve().parent / LEVELS).is_file():
            return made
        return replace(made, warnings=(*made.warnings, f"it is a piece of the streamed SOG of the {LEVELS} above it"))
    try:
        with zipfile.ZipFile(path) as archive:
            return _decoded(path, lambda name, most: _from_zip(path, archive, name, most))
    except ZIP_PROBLEMS:
        raise ImportFailed(path, "isn't a whole zip") from None


def refused_levels(path: Path) -> ImportFailed:
    """The error for a streamed SOG."""
    convert = f"splat-transform -L 0 {LEVELS} scene.sog"
    return ImportFailed(
        path, f"is a streamed SOG ({LEVELS}); PlayCanvas' splat-transform makes one file of it: {convert}"
    )


def _from_folder(path: Path, file: Path, most: int) -> bytes:
    try:
        size = file.stat().st_size
        if size > most:
            raise ImportFailed(path, f"its {file.name} has {size:,} bytes, at most {most:,} are allowed")
        return file.read_bytes()
    except OSError as error:
        raise ImportFailed(path, f"lacks {file.name}: {error.strerror}") from error


def _from_zip(path: Path, archive: zipfile.ZipFile, name: str, most: int) -> bytes:
    found = [entry for entry in archive.infolist() if entry.filename.rsplit("/", 1)[-1] == name]
    if len(found) != 1:
        raise ImportFailed(path, f"holds {len(found)} files named {name}, not one")
    if found[0].compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ImportFailed(path, f"its {name} is packed by a method that SOG doesn't use: {found[0].compress_type}")
    if found[0].file_size > most:
        raise ImportFailed(path, f"its {name} has {found[0].file_size:,} bytes, at most {most:,} are allowed")
    with archive.open(found[0]) as member:
        contents = member.read(most + 1)
    if len(contents) > most:
        raise ImportFailed(path, f"its {name} unpacks to more bytes than its size")
    return contents


class _Meta:
    """The values of meta.json, checked when they are read."""

    def __init__(self, path: Path, contents: bytes) -> None:
        self._path = path
        try:
            self._values = json.loads(contents)
        except json.JSONDecodeError as error:
            place = f"line {error.lineno}, column {error.colno}"
            raise ImportFailed(path, f"its {META} isn't JSON from {place} on") from None
        except (ValueError, RecursionError):
            raise ImportFailed(path, f"its {META} isn't JSON") from None
        if not isinstance(self._values, dict):
            raise self.wrong("", "an object")

    def wrong(self, name: str, expected: str) -> ImportFailed:
        return ImportFailed(self._path, f"its {META}: `{name}` must be {expected}")

    def get(self, name: str) -> Any:
        """The value at a dotted name; None if there is none."""
        value = self._values
        for part in name.split("."):
            value = value.get(part) if isinstance(value, dict) else None
        return value

    def names(self) -> list[str]:
        """The names of all fields, dotted within the parts that have textures."""
        parts = {name: value for name, value in self._values.items() if name in PARTS and isinstance(value, dict)}
        inner = [f"{name}.{field}" for name, part in parts.items() for field in part]
        return [name for name in self._values if name not in parts] + inner

    def whole(self, name: str, most: int) -> int:
        value = self.get(name)
        if type(value) is not int or not 1 <= value <= most:
            raise self.wrong(name, f"a whole number from 1 to {most:,}")
        return value

    def numbers(self, name: str, count: int) -> np.ndarray:
        value = self.get(name)
        good = isinstance(value, list) and len(value) == count
        if not good or not all(type(each) in (int, float) and abs(each) < 1e300 for each in value):
            raise self.wrong(name, f"a list of {count} numbers")
        return np.array(value, np.float64)

    def files(self, name: str, count: int) -> list[str]:
        value = self.get(f"{name}.files")
        if not isinstance(value, list) or len(value) != count or not all(_is_plain(each) for each in value):
            raise self.wrong(f"{name}.files", f"a list of {count} names of files beside it")
        return value


def _is_plain(name: Any) -> bool:
    return isinstance(name, str) and bool(name) and not set(name) & set("/\\\0") and name not in (".", "..")


def _decoded(path: Path, read: Callable[[str, int], bytes]) -> Splats:
    """The Gaussians of a SOG. `read` returns a file's bytes, given its name and its maximum size."""
    meta = _Meta(path, read(META, MAX_META_BYTES))
    if meta.get("version") != 2:
        problem = "of version 1" if meta.get("version") is None else f"of version {meta.get('version')}"
        raise ImportFailed(path, f"is SOG {problem}; version 2 can be read; {AS_PLY}")
    count = meta.whole("count", MAX_GAUSSIANS)

    def texture(name: str, least: int) -> np.ndarray:
        pixels = least + least // 8 + SLACK
        shown = read_texture(path, name, read(name, 8 * pixels), pixels)
        if len(shown) < least:
            raise ImportFailed(path, f"its texture {name} has {len(shown):,} pixels for {least:,} numbers")
        return shown[:least]

    low, high = (texture(name, count) for name in meta.files("means", 2))
    first, last = meta.numbers("means.mins", 3), meta.numbers("means.maxs", 3)
    scales, colors, quats = (texture(meta.files(name, 1)[0], count) for name in ("scales", "sh0", "quats"))
    of_scales, of_colors = (meta.numbers(f"{name}.codebook", 256) for name in ("scales", "sh0"))
    entries, labels = np.empty((1, 0, 3)), np.zeros(count, np.uint16)
    if meta.get("shN") is not None:
        entries, labels = _harmonics(path, meta, count, texture)

    def part(rows: slice) -> Stored:
        steps = low[rows, :3].astype(np.int64) | high[rows, :3].astype(np.int64) << 8
        logs = first + (last - first) * steps / 65535
        with np.errstate(over="ignore"):
            means = np.sign(logs) * np.expm1(np.abs(logs))
        sh = np.concatenate([of_colors[colors[rows, None, :3]], entries[labels[rows]]], axis=1)
        return Stored(means, of_scales[scales[rows, :3]], _quats(quats[rows]), colors[rows, 3] / 255, sh)

    antialiasing, warnings = _model(meta)
    warnings += [f"{META} has `{name}`, which isn't known and is left out" for name in FIELDS.unlisted(meta.names())]
    return splats(path, count, map(part, parts_of(count)), antialiasing, tuple(warnings))


def _model(meta: _Meta) -> tuple[str, list[str]]:
    """The anti-aliasing, and a warning for Gaussians that were trained to be drawn in another way."""
    antialias, model = meta.get("antialias"), meta.get("model")
    if antialias not in (None, True, False):
        raise meta.wrong("antialias", "true or false")
    if model not in (None, "default", "antialiased", "2dgs"):
        return "dilate", [f"{META} has the unknown `model` {model!r}, which is drawn as `default`"]
    flat = ["the Gaussians are 2D (`model` 2dgs) and are drawn as 3D ones that are nearly flat"]
    return "mip" if antialias or model == "antialiased" else "dilate", flat if model == "2dgs" else []


def _quats(stored: np.ndarray) -> np.ndarray:
    """[N, 4] wxyz: three components in bytes, and 252 plus the index of the largest in the fourth."""
    small = (stored[:, :3] / 255 - 0.5) * np.sqrt(2)
    quats = smallest_three(small, stored[:, 3].astype(np.int64) - 252)
    quats[stored[:, 3] < 252] = (1, 0, 0, 0)  # as in other readers
    return quats


def _harmonics(
    path: Path, meta: _Meta, count: int, texture: Callable[[str, int], np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """SH above degree 0 of a palette, [P, C − 1, 3], and the entry of each Gaussian, [N]. A palette's bytes are indices
    into a codebook."""
    bands = meta.whole("shN.bands", 3)
    palette = meta.whole("shN.count", 1 << 16)
    centroids, labels = meta.files("shN", 2)
    wide = ENTRIES_PER_ROW * COEFFICIENTS[bands]
    entries = texture(centroids, wide * -(-palette // ENTRIES_PER_ROW))[:, :3].reshape(-1, COEFFICIENTS[bands], 3)
    stored = texture(labels, count).astype(np.uint16)
    label = stored[:, 0] | stored[:, 1] << 8
    if label.max() >= palette:
        raise ImportFailed(path, f"a Gaussian has SH entry {label.max():,} of a palette of {palette:,}")
    return meta.numbers("shN.codebook", 256)[entries], label
