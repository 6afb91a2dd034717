"""Files of a dataset, read with errors that name the file and the field."""

import io
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from msdgs_serve.scene import MsdgsError
from msdgs_serve.scene.fields import FieldTable

MAX_NAMES = 12
"""Fields that one warning names."""


class DatasetInvalid(MsdgsError):
    """A dataset is incomplete or inconsistent; `file` and `field` name the place."""

    def __init__(self, file: Path | str, field: str, problem: str) -> None:
        super().__init__(f"{file}: `{field}` {problem}")
        self.file = str(file)
        self.field = field
        self.problem = problem


class JsonObject(NamedTuple):
    """An object in a JSON file. All methods but `get` raise `DatasetInvalid` for values that are missing or invalid."""

    file: Path
    values: Mapping[str, Any]
    prefix: str = ""  # put before the keys in error messages

    def invalid(self, key: str, problem: str) -> DatasetInvalid:
        """Return the error for an invalid value."""
        return DatasetInvalid(self.file, self.prefix + key, problem)

    def get(self, key: str) -> Any:
        """Return the value; None if there is none."""
        return self.values.get(key)

    def required(self, key: str) -> Any:
        """Return the value, which is required."""
        value = self.get(key)
        if value is None:
            raise self.invalid(key, "is missing")
        return value

    def numbers(self, key: str, *shape: int) -> np.ndarray:
        """Return finite float64 numbers of this shape."""
        value = self.required(key)
        try:
            array = np.array(value)
        except ValueError:  # rows of different lengths
            array = np.array(None)
        if array.dtype.kind not in "fiu" or array.shape != shape or not np.isfinite(array).all():
            expected = f"{'×'.join(map(str, shape))} finite numbers" if shape else "a finite number"
            raise self.invalid(key, f"must be {expected}, got {repr(value)[:100]}")
        return array.astype(np.float64)

    def number(self, key: str, default: float | None = None) -> float:
        """Return a finite number; `default`, if given, replaces a missing one."""
        return default if default is not None and self.get(key) is None else float(self.numbers(key))

    def names(self, key: str) -> list[str]:
        """Return a list of names."""
        value = self.required(key)
        if not isinstance(value, list) or not all(isinstance(name, str | int) for name in value):
            raise self.invalid(key, "must be a list of names")
        return [str(name) for name in value]

    def child(self, key: str) -> "JsonObject":
        """Return an object inside this one."""
        value = self.required(key)
        if not isinstance(value, dict):
            raise self.invalid(key, "must be a JSON object")
        return JsonObject(self.file, value, f"{self.prefix}{key}.")


def read_bytes(file: Path) -> bytes:
    """Read the content of a file. Raises `DatasetInvalid` if it can't be read."""
    try:
        return file.read_bytes()
    except OSError as error:
        raise DatasetInvalid(file, "file", f"can't be read: {error.strerror}") from None


def read_json(file: Path) -> JsonObject:
    """Read the object in a JSON file. Raises `DatasetInvalid` if there is none."""
    try:
        content = json.loads(read_bytes(file))
    except json.JSONDecodeError as error:
        raise DatasetInvalid(file, "file", f"is not JSON: line {error.lineno}, column {error.colno}") from None
    except (ValueError, RecursionError):
        raise DatasetInvalid(file, "file", "is not JSON") from None
    if not isinstance(content, dict):
        raise DatasetInvalid(file, "file", "must hold a JSON object")
    return JsonObject(file, content)


def read_table(file: Path, columns: int) -> np.ndarray:
    """Read [M, columns] finite numbers from a `.npy` file; M may be 0. Raises `DatasetInvalid` naming file and row."""
    try:
        table = np.lib.format.read_array(io.BytesIO(read_bytes(file)), allow_pickle=False)
    except ValueError:
        raise DatasetInvalid(file, "file", "is not a NumPy array of numbers, or is cut off") from None
    if table.dtype.kind not in "fiu" or table.shape[1:] != (columns,):
        got = f"{table.dtype} in shape {'×'.join(map(str, table.shape))}"
        raise DatasetInvalid(file, "file", f"must hold real numbers in shape M×{columns}, got {got}")
    return finite_rows(file, "row {}", table)


def unread_fields(file: Path, table: FieldTable, names: Iterable[str]) -> list[str]:
    """A warning that names those fields of a file that are in no table; none if there are none."""
    unlisted = table.unlisted(names)
    if not unlisted:
        return []
    are = "is not a known field" if len(unlisted) == 1 else "are not known fields"
    shown = ", ".join(f"`{name}`" for name in unlisted[:MAX_NAMES]) + ", …" * (len(unlisted) > MAX_NAMES)
    return [f"{file}: {shown} {are} of {table.format}, and not read: check that nothing depends on it"]


def finite_rows(file: Path, field: str, table: np.ndarray) -> np.ndarray:
    """Return `table` as float64. Raises `DatasetInvalid` for a row that isn't finite; `field` formats its number."""
    bad = ~np.isfinite(table).all(axis=1)
    if bad.any():
        raise DatasetInvalid(file, field.format(int(bad.argmax())), "must be finite")
    return table.astype(np.float64)
