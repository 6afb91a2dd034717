"""JSON objects and tables of numbers, read with errors that name the file."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from msdgs_train.datasets.common.scene_data import DatasetInvalid


def read_json(file: Path) -> dict[str, Any]:
    """The object in a JSON file. Raises `DatasetInvalid` if there is none."""
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise DatasetInvalid(file, "file", f"can't be read: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise DatasetInvalid(file, "file", f"is not JSON: {error}") from None
    if not isinstance(content, dict):
        raise DatasetInvalid(file, "file", "must hold a JSON object")
    return content


def read_table(file: Path, columns: int) -> np.ndarray:
    """[M, columns] float64, finite, from a `.npy` file; M may be 0. Raises `DatasetInvalid` naming file and row."""
    try:
        with file.open("rb") as stream:
            table = np.lib.format.read_array(stream, allow_pickle=False)
    except OSError as error:
        raise DatasetInvalid(file, "file", f"can't be read: {error.strerror or error}") from None
    except ValueError as error:
        raise DatasetInvalid(file, "file", f"is not a NumPy array: {error}") from None
    if table.dtype.kind not in "fiu" or table.shape[1:] != (columns,):
        raise DatasetInvalid(file, "file", f"must hold real numbers in shape M×{columns}")
    good = np.isfinite(table).all(axis=1)
    if not good.all():
        raise DatasetInvalid(file, f"row {int(np.argmin(good))}", "must be finite, got NaN or infinity")
    return table.astype(np.float64)
