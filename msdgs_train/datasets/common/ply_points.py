"""Sparse points from `.ply` files, text or binary."""

from pathlib import Path

import numpy as np

from msdgs_train.datasets.common.ply_file import PlyFile, PlyInvalid
from msdgs_train.datasets.common.readers import DatasetInvalid, finite_rows

WHITES = (2**8 - 1, 2**16 - 1, 2**32 - 1)
"""Largest values of integer colors, the first that holds all of a file's, since types are often larger than needed."""
POSITION, COLOR = ("x", "y", "z"), ("red", "green", "blue")


def read_ply_points(file: Path) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Read points, [M, 3] float64 in the axes and units of the file, and their colors, [M, 3] float64 in [0, 1].

    Both are None if the file has no points, colors also if its vertices have no red, green and blue. Integer colors are
    divided by the first of `WHITES` that none is above. Raises `DatasetInvalid` naming file and field.
    """
    try:
        vertices = PlyFile(file).read("vertex")
    except OSError as error:
        raise DatasetInvalid(file, "file", f"can't be read: {error.strerror}") from None
    except PlyInvalid as error:
        raise DatasetInvalid(file, "file", str(error)) from None
    for name in POSITION:
        if name not in (vertices.dtype.names or ()) or vertices.dtype[name].kind not in "fiu":
            raise DatasetInvalid(file, f"property {name}", "is missing or not a number")
    points = finite_rows(file, "vertex[{}]", _columns(vertices, POSITION))
    return (points, _colors(file, vertices)) if len(points) else (None, None)


def white_of(colors: np.ndarray) -> int:
    """The first of `WHITES` that no color is above."""
    return next((white for white in WHITES if colors.max(initial=0) <= white), WHITES[-1])


def _columns(vertices: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    return np.stack([vertices[name].astype(np.float64) for name in names], axis=1)


def _colors(file: Path, vertices: np.ndarray) -> np.ndarray | None:
    kinds = vertices.dtype
    if not all(name in (kinds.names or ()) and kinds[name].kind in "fiu" for name in COLOR):
        return None
    colors = _columns(vertices, COLOR)
    if any(kinds[name].kind in "iu" for name in COLOR):
        colors /= white_of(colors)
    if not ((colors >= 0) & (colors <= 1)).all():
        raise DatasetInvalid(file, "property red", "green and blue must be in [0, 1], or integers of 0 and more")
    return colors
