"""Sparse points from `.ply` files: text or binary, with the vertices as the first element."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from msdgs_train.datasets.common.scene_data import DatasetInvalid

_NAMES = {
    "i1": ("char", "int8"),
    "u1": ("uchar", "uint8"),
    "i2": ("short", "int16"),
    "u2": ("ushort", "uint16"),
    "i4": ("int", "int32"),
    "u4": ("uint", "uint32"),
    "f4": ("float", "float32"),
    "f8": ("double", "float64"),
}
_TYPES = {name: kind for kind, names in _NAMES.items() for name in names}
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_POSITION, _COLOR = ("x", "y", "z"), ("red", "green", "blue")


class PlyPoints(NamedTuple):
    """Points in the axes and units of the file."""

    points: np.ndarray  # [M, 3] float64, finite
    colors: np.ndarray | None  # [M, 3] float64 in [0, 1]; None if the file has no red, green and blue


def read_ply_points(file: Path) -> PlyPoints:
    """Read `x y z` and, if present, `red green blue` of the vertices; other properties are ignored.

    Integer colors are divided by the largest value of their type. Raises `DatasetInvalid` naming file and field.
    """
    try:
        content = file.read_bytes()
    except OSError as error:
        raise DatasetInvalid(file, "file", f"can't be read: {error.strerror}") from None
    header, end, body = content.partition(b"end_header")
    if not content.startswith(b"ply") or not end:
        raise DatasetInvalid(file, "file", "is not a PLY file: it must begin with `ply` and have a line `end_header`")
    encoding, count, row = _parse_header(file, header.decode("ascii", errors="replace"))
    body = body.partition(b"\n")[2]
    vertices = _from_text(file, body, count, row) if encoding == "ascii" else _from_bytes(file, body, count, row)
    points = _columns(vertices, _POSITION)
    bad = ~np.isfinite(points).all(axis=1)
    if bad.any():
        raise DatasetInvalid(file, f"vertex[{int(bad.argmax())}]", "must be finite")
    return PlyPoints(points, _colors(file, vertices, row))


def _parse_header(file: Path, header: str) -> tuple[str, int, np.dtype]:
    """The encoding, the number of vertices and their type."""
    encoding, elements, fields = "", [], []
    for line in header.splitlines():
        match line.split():
            case ["format", name, _]:
                encoding = name
            case ["element", *words]:
                elements.append(words)
            case ["property", kind, name] if len(elements) == 1 and kind in _TYPES:
                fields.append((name, _TYPES[kind]))
            case ["property", *words] if len(elements) == 1:
                raise DatasetInvalid(file, "property", f"of a vertex must be a number, got {' '.join(words)}")
    if encoding not in _ORDERS:
        raise DatasetInvalid(file, "format", f"must be one of {', '.join(_ORDERS)}, got {encoding!r}")
    match elements[:1]:
        case [["vertex", number]] if number.isdecimal():
            count = int(number)
        case _:
            raise DatasetInvalid(file, "element", f"must be vertex and a number first, got {elements[:1]}")
    names = [name for name, _ in fields]
    if len(set(names)) < len(names):
        raise DatasetInvalid(file, "property", f"names must differ, got {' '.join(names)}")
    for name in _POSITION:
        if name not in names:
            raise DatasetInvalid(file, f"property {name}", "is missing")
    return encoding, count, np.dtype([(name, _ORDERS[encoding] + kind) for name, kind in fields])


def _from_text(file: Path, body: bytes, count: int, row: np.dtype) -> np.ndarray:
    """The fields of `row`, all as float64, so that no value is rounded or wraps around."""
    names = row.names or ()
    words = body.split()[: count * len(names)]
    if len(words) < count * len(names):
        raise _too_few(file, len(words) // len(names), count)
    try:
        values = np.array([float(word) for word in words])
    except ValueError as error:
        raise DatasetInvalid(file, "vertex", f"must be {len(names)} numbers: {error}") from None
    return values.view([(name, "f8") for name in names])


def _from_bytes(file: Path, body: bytes, count: int, row: np.dtype) -> np.ndarray:
    if len(body) < count * row.itemsize:
        raise _too_few(file, len(body) // row.itemsize, count)
    return np.frombuffer(body[: count * row.itemsize], row)


def _too_few(file: Path, found: int, count: int) -> DatasetInvalid:
    return DatasetInvalid(file, "vertex", f"is cut off: the header says {count}, the file holds {found}")


def _columns(vertices: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    return np.stack([vertices[name].astype(np.float64) for name in names], axis=1)


def _colors(file: Path, vertices: np.ndarray, row: np.dtype) -> np.ndarray | None:
    if not set(_COLOR) <= set(row.names or ()):
        return None
    largest = [np.iinfo(row[name]).max if row[name].kind in "iu" else 1.0 for name in _COLOR]
    colors = _columns(vertices, _COLOR) / largest
    if not ((colors >= 0) & (colors <= 1)).all():
        raise DatasetInvalid(file, "property red", "green and blue must be in [0, 1], or integers of 0 and more")
    return colors
