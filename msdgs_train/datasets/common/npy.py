"""Tables of numbers in `.npy` files."""

from pathlib import Path

import numpy as np

from msdgs_train.datasets.common.scene_data import DatasetInvalid


def read_table(file: Path, columns: int) -> np.ndarray:
    """[M, columns] float64, finite; M may be 0. Raises `DatasetInvalid` naming file and row."""
    try:
        with file.open("rb") as stream:
            table = np.lib.format.read_array(stream, allow_pickle=False)
    except OSError as error:
        raise DatasetInvalid(file, "file", f"can't be read: {error.strerror or error}") from None
    except ValueError as error:
        raise DatasetInvalid(file, "file", f"is no NumPy array: {error}") from None
    if table.dtype.kind not in "fiu" or table.shape[1:] != (columns,):
        raise DatasetInvalid(file, "file", f"must hold real numbers in shape M×{columns}")
    good = np.isfinite(table).all(axis=1)
    if not good.all():
        raise DatasetInvalid(file, f"row {int(np.argmin(good))}", "must be finite, got NaN or infinity")
    return table.astype(np.float64)
