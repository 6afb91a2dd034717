"""COLMAP's `cameras.txt`, `images.txt` and `points3D.txt`: one record per line, comments after `#`."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from msdgs_train.datasets.colmap.model import ModelCamera, ModelImage, make_camera
from msdgs_train.datasets.common.readers import DatasetInvalid, read_bytes


def read_cameras(file: Path) -> Iterator[tuple[int, ModelCamera]]:
    for number, line in _lines(file):
        if line:
            with _record(file, number, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS…"):
                camera_id, model, width, height, *parameters = line.split()
                size, values = (int(width), int(height)), tuple(map(float, parameters))
                yield int(camera_id), make_camera(file, f"line {number}", model, *size, values)


def read_images(file: Path) -> Iterator[ModelImage]:
    lines = _lines(file)
    for number, line in lines:
        if line:
            with _record(file, number, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then a line of observations"):
                _, *words, camera_id, name = line.split(maxsplit=9)
                pose = np.array(words, float).reshape(7)
                image = ModelImage(name, int(camera_id), pose[:4], pose[4:])
            next(lines, None)
            yield image


def read_points(file: Path) -> Iterator[tuple[float, ...]]:
    for number, line in _lines(file):
        if line:
            with _record(file, number, "POINT3D_ID X Y Z R G B ERROR TRACK…"):
                _, x, y, z, red, green, blue, *_ = line.split(maxsplit=7)
                yield tuple(map(float, (x, y, z, red, green, blue)))


def _lines(file: Path) -> Iterator[tuple[int, str]]:
    """Yield lines with their numbers, without comments; empty ones are kept: an image may have no observations."""
    try:
        text = read_bytes(file).decode()
    except UnicodeDecodeError as error:
        raise DatasetInvalid(file, "file", f"is not text: {error}") from None
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.startswith("#"):
            yield number, line.strip()


@contextmanager
def _record(file: Path, number: int, expected: str) -> Iterator[None]:
    """Raise a `ValueError` in the block as `DatasetInvalid` that names the line and the expected words."""
    try:
        yield
    except ValueError:
        raise DatasetInvalid(file, f"line {number}", f"must be {expected}") from None
