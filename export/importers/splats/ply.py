"""PLY files of INRIA's trainer, with properties in any order, and SuperSplat's compressed PLY files."""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from plyfile import PlyData, PlyElement, PlyListProperty, PlyParseError

from export.importers.errors import ImportFailed, cut_off
from export.importers.splats.base import Splats, sigmoid, smallest_three, splats
from msdgs_serve.scene.spherical_harmonics import SH_C0, SH_DEGREES

MAGIC = b"ply"
MAX_HEADER_BYTES = 1 << 16
CHUNK = 256
"""Gaussians that share the ranges of one row of `chunk`."""

MIN_TEXT_BYTES = 2
"""Bytes of the shortest number in a text file: a digit and a separator."""

RENDER_MODE = "SplatRenderMode:"
"""Begins Brush's comment on anti-aliasing, which goes on with `mip` or `default`."""

_SIZES = {"char": 1, "uchar": 1, "short": 2, "ushort": 2, "int": 4, "uint": 4, "float": 4, "double": 8}
_SIZES |= {"int8": 1, "uint8": 1, "int16": 2, "uint16": 2, "int32": 4, "uint32": 4, "float32": 4, "float64": 8}


def read_ply(file: Path) -> Splats:
    """Read a PLY file. Raises `ImportFailed` naming its error."""
    _check_sizes(file)
    try:
        contents = PlyData.read(str(file), mmap="r")
    except (PlyParseError, ValueError, UnicodeDecodeError, EOFError, OverflowError) as error:
        raise ImportFailed(file, f"isn't a whole PLY file: {error}") from error
    elements = {element.name: element for element in contents.elements}
    if "vertex" not in elements:
        raise ImportFailed(file, f"has no element `vertex`, only {', '.join(elements) or 'none'}")
    if "packed_position" in elements["vertex"].data.dtype.names:
        read = _compressed(file, elements)
    else:
        read = _inria(file, elements["vertex"])
    return replace(read, antialiasing=_antialiasing(contents.comments))


def _antialiasing(comments: Sequence[str]) -> str:
    """`mip` if Brush's or Postshot's comment says so, the last one if there are several."""
    found = "dilate"
    for comment in comments:
        match comment.lower().split():
            case [name, mode] if name == RENDER_MODE.lower():
                found = "mip" if mode == "mip" else "dilate"
            case ["antialiased", flag]:
                found = "mip" if flag == "1" else "dilate"
    return found


class _Element(NamedTuple):
    name: str
    count: int
    bytes_per_row: int
    columns: int


def _check_sizes(file: Path) -> None:
    """Raise `ImportFailed` if the file is shorter than its header states, before memory of that size is allocated."""
    with file.open("rb") as stream:
        start = stream.read(MAX_HEADER_BYTES)
    end = re.search(rb"(?m)^end_header\r?\n", start)
    if not start.startswith(MAGIC) or end is None:
        raise ImportFailed(file, "isn't a whole PLY file: its header has no end")
    lines = start[: end.end()].decode("ascii", "replace").splitlines()
    binary = any(re.match(r"format\s+binary", line) for line in lines)
    body = file.stat().st_size - end.end()
    for element in _elements(file, lines):
        needed = element.count * (element.bytes_per_row if binary else MIN_TEXT_BYTES * element.columns) - (not binary)
        if needed > body:
            raise cut_off(file, f"{element.count:,} rows of `{element.name}`", needed, body)
        body -= needed


def _elements(file: Path, lines: list[str]) -> list[_Element]:
    elements: list[_Element] = []
    for line in lines:
        words = line.split()
        if words[:1] == ["element"]:
            if len(words) != 3 or not re.fullmatch(r"[0-9]{1,18}", words[2], re.ASCII):
                raise ImportFailed(file, f"has a header line that can't be read: {line[:80]!r}")
            elements.append(_Element(words[1], int(words[2]), 0, 0))
        elif words[:1] == ["property"]:
            if not elements or len(words) != 3 or words[1] not in _SIZES:
                raise ImportFailed(file, f"has a property that no splat has: {line[:80]!r}")
            last = elements[-1]
            elements[-1] = last._replace(bytes_per_row=last.bytes_per_row + _SIZES[words[1]], columns=last.columns + 1)
    for element in elements:
        if element.count and not element.columns:
            raise ImportFailed(file, f"has {element.count:,} rows of `{element.name}` without properties")
    return elements


def _inria(file: Path, vertex: PlyElement) -> Splats:
    columns = _Columns(file, vertex)
    dc = columns.stack("f_dc_", 3)
    rest = _rest(file, columns, "f_rest_", columns.read)
    return splats(
        file,
        columns.named("x", "y", "z"),
        columns.stack("scale_", 3),
        columns.stack("rot_", 4),
        sigmoid(columns.read("opacity")),
        np.concatenate([dc[:, None], rest], axis=1),
    )


def _compressed(file: Path, elements: dict[str, PlyElement]) -> Splats:
    """Positions 11-10-11 bits and scales within ranges of 256 Gaussians, colors and opacities 8 bits each."""
    if "chunk" not in elements:
        raise ImportFailed(file, "is a compressed PLY without its element `chunk`")
    vertex, chunk = _Columns(file, elements["vertex"]), _Columns(file, elements["chunk"])
    count = len(elements["vertex"].data)
    of = np.arange(count) // CHUNK
    if len(elements["chunk"].data) * CHUNK < count:
        raise ImportFailed(file, f"has {len(elements['chunk'].data):,} rows of `chunk` for {count:,} Gaussians")

    def within(low: str, high: str, parts: np.ndarray) -> np.ndarray:
        first, last = (chunk.named(*(f"{end}{axis}" for axis in low[-3:]))[of] for end in (low[:-3], high[:-3]))
        return first * (1 - parts) + last * parts

    colors = _bits(vertex.packed("packed_color"), (24, 8), (16, 8), (8, 8), (0, 8))
    rgb = within("min_rgb", "max_rgb", colors[:, :3]) if chunk.has("min_r") else colors[:, :3]
    packed = vertex.packed("packed_rotation")
    small = (_bits(packed, (20, 10), (10, 10), (0, 10)) - 0.5) * np.sqrt(2)
    sh = ((rgb - 0.5) / SH_C0)[:, None]
    if "sh" in elements:
        bands = _Columns(file, elements["sh"])
        if len(elements["sh"].data) != count:
            raise ImportFailed(file, f"has {len(elements['sh'].data):,} rows of `sh` for {count:,} Gaussians")
        sh = np.concatenate([sh, _rest(file, bands, "f_rest_", lambda name: _byte_sh(bands.read(name)))], axis=1)
    eleven = ((21, 11), (11, 10), (0, 11))
    return splats(
        file,
        within("min_xyz", "max_xyz", _bits(vertex.packed("packed_position"), *eleven)),
        within("min_scale_xyz", "max_scale_xyz", _bits(vertex.packed("packed_scale"), *eleven)),
        smallest_three(small, packed >> 30),
        colors[:, 3],
        sh,
    )


def _bits(packed: np.ndarray, *fields: tuple[int, int]) -> np.ndarray:
    """[N, F] values in [0, 1] of fields given as (first bit, number of bits)."""
    return np.stack([((packed >> first) & (2**size - 1)) / (2**size - 1) for first, size in fields], axis=1)


def _byte_sh(stored: np.ndarray) -> np.ndarray:
    parts = np.where(stored <= 0, 0, np.where(stored >= 255, 1, (stored + 0.5) / 256))
    return (parts - 0.5) * 8


def _rest(file: Path, columns: "_Columns", prefix: str, read) -> np.ndarray:  # noqa: ANN001
    """[N, C − 1, 3] SH above degree 0, from columns that are sorted by channel."""
    count = sum(re.fullmatch(prefix + r"[0-9]+", name) is not None for name in columns.names)
    if count % 3 or count // 3 + 1 not in SH_DEGREES:
        raise ImportFailed(file, f"has {count} of `{prefix}…`; 0, 9, 24 or 45 make whole degrees")
    values = [read(f"{prefix}{i}") for i in range(count)]
    if not values:
        return np.empty((columns.rows, 0, 3))
    return np.stack(values, axis=1).reshape(columns.rows, 3, count // 3).transpose(0, 2, 1)


class _Columns:
    """The properties of one element by name."""

    def __init__(self, file: Path, element: PlyElement) -> None:
        if any(isinstance(each, PlyListProperty) for each in element.properties):
            raise ImportFailed(file, f"has lists in `{element.name}`; a splat has none")
        self._file, self._element = file, element
        self.names = element.data.dtype.names or ()
        self.rows = len(element.data)

    def has(self, name: str) -> bool:
        return name in self.names

    def read(self, name: str) -> np.ndarray:
        """One column as float64. Raises `ImportFailed` if it is missing."""
        with np.errstate(invalid="ignore"):  # signaling NaN in damaged files
            return self._column(name).astype(np.float64)

    def packed(self, name: str) -> np.ndarray:
        column = self._column(name)
        if column.dtype.kind != "u" or column.dtype.itemsize != 4:
            raise ImportFailed(self._file, f"`{name}` is {column.dtype}, not uint")
        return column.astype(np.uint32)

    def named(self, *names: str) -> np.ndarray:
        return np.stack([self.read(name) for name in names], axis=1)

    def stack(self, prefix: str, count: int) -> np.ndarray:
        return self.named(*(f"{prefix}{i}" for i in range(count)))

    def _column(self, name: str) -> np.ndarray:
        if not self.has(name):
            content = "a cloud of points without Gaussians" if not self.has("opacity") else "not a whole splat"
            raise ImportFailed(self._file, f"`{self._element.name}` has no property `{name}`; it is {content}")
        return np.asarray(self._element.data[name])
