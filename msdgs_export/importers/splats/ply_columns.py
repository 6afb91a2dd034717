"""The properties of an element of a PLY by name."""

import re
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from msdgs_export.importers.errors import ImportFailed
from msdgs_serve.scene.spherical_harmonics import SH_DEGREES
from msdgs_train.datasets.common.ply_file import PlyFile, PlyInvalid
from msdgs_train.datasets.common.ply_points import white_of

PREFIX = re.compile(r"(scalar_)+", re.IGNORECASE)
"""CloudCompare's, before the names of all properties but positions, normals and colors."""
MAX_FRACTION = 2.0
"""Of colors as float: spherical harmonics may be somewhat brighter than white."""


class Columns:
    """The properties of one element. Raises `ImportFailed` for a property that is missing when it is read."""

    def __init__(self, file: Path, element: str, data: np.ndarray) -> None:
        self._file, self._element, self._data = file, element, data
        stored = data.dtype.names or ()
        plain = {each: PREFIX.sub("", each, count=1) if PREFIX.match(each) else each for each in stored}
        self._stored = {name: each for each, name in plain.items()} | {
            each: each for each in stored if plain[each] == each
        }
        self.rows = len(data)

    @classmethod
    def of(cls, file: Path, contents: PlyFile, element: str) -> "Columns":
        """The properties of an element of a file. Raises `ImportFailed`."""
        try:
            return cls(file, element, contents.read(element))
        except PlyInvalid as error:
            raise ImportFailed(file, str(error)) from None

    def parts(self, rows: int) -> Iterator["Columns"]:
        """The same in parts of so many rows, at least one. Each part of a mapped file is mapped anew: pages that were
        read count as memory of the process until they are unmapped."""
        for start in range(0, max(self.rows, 1), rows):
            data = self._data[start : start + rows]
            if isinstance(self._data, np.memmap):
                at = self._data.offset + start * data.itemsize
                data = np.memmap(self._file, data.dtype, "r", at, data.shape)
            yield Columns(self._file, self._element, data)

    @property
    def names(self) -> list[str]:
        return list(self._stored)

    def has(self, *names: str) -> bool:
        return all(name in self._stored for name in names)

    def read(self, name: str) -> np.ndarray:
        """One column as float64."""
        with np.errstate(invalid="ignore"):  # signaling NaN in damaged files
            return self._column(name).astype(np.float64)

    def packed(self, name: str) -> np.ndarray:
        """A column of 32 bits."""
        column = self._column(name)
        if column.dtype.kind != "u" or column.dtype.itemsize != 4:
            raise ImportFailed(self._file, f"`{name}` is {column.dtype}, not uint")
        return column.astype(np.uint32)

    def fraction(self, name: str) -> np.ndarray:
        """A column as float64; integers are divided by the largest of their type, of 32 bits by that of the first type
        that holds them. Raises `ImportFailed` for floats that are numbers of bytes."""
        kind, values = self._column(name).dtype, self.read(name)
        if kind.kind != "f":
            return values / (white_of(values) if kind.itemsize == 4 else np.iinfo(kind).max)
        if (values > MAX_FRACTION).any():
            raise ImportFailed(self._file, f"`{name}` is up to {values.max():g}; as float, colors are from 0 to 1")
        return values

    def named(self, *names: str) -> np.ndarray:
        return np.stack([self.read(name) for name in names], axis=1)

    def stack(self, prefix: str, count: int) -> np.ndarray:
        """[N, count] of numbered columns."""
        return self.named(*(f"{prefix}{i}" for i in range(count)))

    def count(self, prefix: str) -> int:
        """The number of columns that are a prefix and a number."""
        return sum(re.fullmatch(prefix + r"[0-9]+", name) is not None for name in self.names)

    def _column(self, name: str) -> np.ndarray:
        if not self.has(name):
            content = "a cloud of points without Gaussians" if not self.has("opacity") else "not a whole splat"
            raise ImportFailed(self._file, f"`{self._element}` has no property `{name}`; it is {content}")
        return np.asarray(self._data[self._stored[name]])


def rest_of(file: Path, columns: Columns, read: Callable[[str], np.ndarray]) -> np.ndarray:
    """[N, C − 1, 3] SH above degree 0, from columns that are sorted by channel."""
    count = columns.count("f_rest_")
    if count == 72:
        raise ImportFailed(file, "has SH of degree 4; up to 3 can be read: write it with fewer")
    if count % 3 or count // 3 + 1 not in SH_DEGREES:
        raise ImportFailed(file, f"has {count} of `f_rest_…`; 0, 9, 24 or 45 make whole degrees")
    if not count:
        return np.empty((columns.rows, 0, 3))
    values = [read(f"f_rest_{i}") for i in range(count)]
    return np.stack(values, axis=1).reshape(columns.rows, 3, count // 3).transpose(0, 2, 1)
