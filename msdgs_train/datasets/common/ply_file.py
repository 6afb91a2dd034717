"""PLY files, text or binary: their header, and elements as NumPy arrays.

plyfile, which writes them, reads no comments but ASCII, and all rows of all elements. Here only the elements that are
asked for are read, after a check that the file is as long as its header states.
"""

import itertools
import mmap
import re
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

MAGIC = b"ply"
MAX_HEADER_BYTES = 1 << 18
MIN_TEXT_BYTES = 2
"""Bytes of the shortest number in a text file: a digit and a separator."""

ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
TYPES |= {"float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2"}
TYPES |= {"int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8"}
STRUCT_CODES = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I"}


class PlyInvalid(Exception):
    """A file isn't a whole PLY; the message is what is wrong with it, as the predicate of a sentence."""


@dataclass(frozen=True)
class Property:
    """A column of an element, or with `length` a list of any length in each row."""

    name: str
    type: str  # as in NumPy, without the byte order
    length: str | None = None  # type of a list's length


@dataclass(frozen=True)
class Element:
    """A table of the file."""

    name: str
    count: int  # rows
    properties: tuple[Property, ...]

    @property
    def has_lists(self) -> bool:
        return any(each.length is not None for each in self.properties)

    def min_bytes(self, is_text: bool) -> int:
        """The fewest bytes that its rows take."""
        if is_text:
            return max(MIN_TEXT_BYTES * self.count * len(self.properties) - 1, 0)  # no separator at the end
        return self.count * sum(int((each.length or each.type)[1:]) for each in self.properties)


class PlyFile:
    """A PLY file whose header is read. Raises `PlyInvalid`, and `OSError` if the file can't be read."""

    def __init__(self, path: Path) -> None:
        with path.open("rb") as stream:
            start = stream.read(MAX_HEADER_BYTES)
        end = re.search(rb"(?m)^end_header[ \t]*\r?\n", start)
        if not start.startswith(MAGIC) or end is None:
            raise PlyInvalid("isn't a whole PLY file: its header has no end")
        lines = [_decoded(line) for line in start[: end.start()].splitlines()]
        self._path, self._start = path, end.end()
        self._order = _byte_order(lines)
        self.elements = _elements(lines)
        self.comments = [words[1] for line in lines if (words := line.split(maxsplit=1))[:1] in _REMARKS and words[1:]]

    @property
    def is_text(self) -> bool:
        return not self._order

    def element(self, name: str) -> Element | None:
        """The element of this name; None if there is none."""
        return next((each for each in self.elements if each.name == name), None)

    def read(self, name: str) -> np.ndarray:
        """The rows of an element without lists, a structured array [count]; that of a binary file is mapped.

        Raises `PlyInvalid` if the file has no such element, or ends before it does.
        """
        number = next((i for i, each in enumerate(self.elements) if each.name == name), None)
        if number is None:
            names = ", ".join(each.name for each in self.elements)
            raise PlyInvalid(f"has no element `{name}`, only {names or 'none'}")
        element = self.elements[number]
        if element.has_lists:
            raise PlyInvalid(f"has lists in `{name}`; a splat or a cloud of points has none")
        skipped = self.elements[:number]
        size = self._path.stat().st_size
        needed = sum(each.min_bytes(self.is_text) for each in (*skipped, element))
        if needed > size - self._start:
            raise _cut_off(element, needed, size - self._start)
        return self._text(element, skipped) if self.is_text else self._binary(element, skipped, size)

    def _text(self, element: Element, skipped: tuple[Element, ...]) -> np.ndarray:
        with self._path.open(encoding="latin-1") as stream:
            stream.seek(self._start)
            rows = sum(each.count for each in skipped)
            lines = itertools.islice((line for line in stream if line.strip()), rows, rows + element.count)
            columns = len(element.properties)
            try:
                table = (
                    np.loadtxt(lines, np.float64, comments=None, ndmin=2) if element.count else np.empty((0, columns))
                )
            except ValueError:
                raise PlyInvalid(f"has a row of `{element.name}` that isn't {columns} numbers") from None
        if table.size and table.shape[1] != columns:
            raise PlyInvalid(f"has rows of {table.shape[1]} numbers for {columns} properties of `{element.name}`")
        if len(table) < element.count:
            raise PlyInvalid(f"is cut off: {element.count:,} rows of `{element.name}`, there are {len(table):,}")
        found = np.empty(element.count, [(each.name, each.type) for each in element.properties])
        with np.errstate(invalid="ignore", over="ignore"):
            for i, each in enumerate(element.properties):
                found[each.name] = table[:, i]
                if found[each.name].dtype.kind != "f" and (found[each.name] != table[:, i]).any():
                    raise PlyInvalid(f"has a number that `{each.name}` of `{element.name}` can't hold")
        return found

    def _binary(self, element: Element, skipped: tuple[Element, ...], size: int) -> np.ndarray:
        kind = np.dtype([(each.name, f"{self._order}{each.type}") for each in element.properties])
        if not element.count:
            return np.empty(0, kind)
        at = self._start
        for each in skipped:
            at = self._after_lists(each, at) if each.has_lists and each.count else at + each.min_bytes(is_text=False)
        if at + element.count * kind.itemsize > size:
            raise _cut_off(element, element.count * kind.itemsize, max(size - at, 0))
        return np.memmap(self._path, kind, "r", at, (element.count,))

    def _after_lists(self, element: Element, at: int) -> int:
        """The place in the file after an element with lists, which begins at a place."""
        sizes = [(each.length and STRUCT_CODES.get(each.length), int(each.type[1:])) for each in element.properties]
        with self._path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as contents:
            for _ in range(element.count):
                for code, size in sizes:
                    if code is None:
                        at += size
                    elif at + struct.calcsize(code) > len(contents):
                        raise _cut_off(element, at + struct.calcsize(code), len(contents))
                    else:
                        (count,) = struct.unpack_from(f"{self._order}{code}", contents, at)
                        at += struct.calcsize(code) + max(count, 0) * size
        return at


_REMARKS = (["comment"], ["obj_info"])


def _decoded(line: bytes) -> str:
    try:
        return line.decode("utf-8")
    except UnicodeDecodeError:
        return line.decode("latin-1")


def _byte_order(lines: list[str]) -> str:
    """As in NumPy; empty for text."""
    formats = [line.split() for line in lines if line.split()[:1] == ["format"]]
    if len(formats) != 1 or len(formats[0]) != 3 or formats[0][1] not in ORDERS:
        raise PlyInvalid(f"has no header line `format` with one of {', '.join(ORDERS)}")
    return ORDERS[formats[0][1]]


def _elements(lines: list[str]) -> tuple[Element, ...]:
    elements: list[tuple[str, int, list[Property]]] = []
    for line in lines:
        match line.split():
            case ["element", name, count] if re.fullmatch(r"[0-9]{1,18}", count, re.ASCII):
                elements.append((name, int(count), []))
            case ["property", "list", length, kind, name] if elements and {length, kind} <= TYPES.keys():
                if TYPES[length] not in STRUCT_CODES:
                    raise PlyInvalid(f"has a list whose length isn't an integer: {line[:80]!r}")
                elements[-1][2].append(Property(name, TYPES[kind], TYPES[length]))
            case ["property", kind, name] if elements and kind in TYPES:
                elements[-1][2].append(Property(name, TYPES[kind]))
            case ["element" | "property", *_]:
                raise PlyInvalid(f"has a header line that can't be read: {line[:80]!r}")
    for name, count, properties in elements:
        if count and not properties:
            raise PlyInvalid(f"has {count:,} rows of `{name}` without properties")
        names = [each.name for each in properties]
        if twice := next((each for each in names if names.count(each) > 1), None):
            raise PlyInvalid(f"has the property `{twice}` of `{name}` twice")
    return tuple(Element(name, count, tuple(properties)) for name, count, properties in elements)


def _cut_off(element: Element, needed: int, found: int) -> PlyInvalid:
    part = f"{element.count:,} rows of `{element.name}`"
    return PlyInvalid(f"is cut off: {part} needs {needed:,} bytes, there are {found:,}")
