"""COLMAP's `cameras.txt`, `images.txt` and `points3D.txt`: one record per line, comments after `#`."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from msdgs_train.datasets.colmap.model import ModelCamera, ModelImage, make_camera
from msdgs_train.datasets.common.readers import DatasetInvalid, read_bytes

LINE_END = re.compile(r"\r\n?|\n")


def read_cameras(file: Path) -> Iterator[tuple[int, ModelCamera]]:
    for number, line in _lines(file):
        if line:
            with _record(file, number, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS…"):
                camera_id, model, width, height, *parameters = line.split()
                size, values = (int(width), int(height)), tuple(map(float, parameters))
                yield int(camera_id), make_camera(file, f"line {number}", model, *size, values)


def read_images(file: Path) -> Iterator[ModelImage]:
    """Each image is a line, with or without a line of observations after it."""
    may_be_observations = False
    for number, line in _lines(file):
        if not line:
            continue
        if may_be_observations and _has_observations(line):
            may_be_observations = False
            continue
        with _record(file, number, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, or then X Y POINT3D_ID…"):
            _, *words, camera_id, name = line.split(maxsplit=9)
            pose = np.array(words, float).reshape(7)
            image = ModelImage(name, int(camera_id), pose[:4], pose[4:])
        may_be_observations = True
        yield image


def _has_observations(line: str) -> bool:
    """Whether a line is X Y POINT3D_ID again and again. Only its beginning and its end are read: it may be long."""
    words, last = line.split(maxsplit=12), line.rsplit(maxsplit=1)[-1]
    is_whole = len(words) > 12 or len(words) % 3 == 0
    return is_whole and all(map(_is_number, words[:12])) and all(map(_is_integer, (*words[2:12:3], last)))


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _is_integer(word: str) -> bool:
    return word.removeprefix("-").isdecimal()


def read_points(file: Path) -> Iterator[tuple[float, ...]]:
    for number, line in _lines(file):
        if line:
            with _record(file, number, "POINT3D_ID X Y Z R G B ERROR TRACK…"):
                _, x, y, z, red, green, blue, *_ = line.split(maxsplit=7)
                yield tuple(map(float, (x, y, z, red, green, blue)))


def _lines(file: Path) -> Iterator[tuple[int, str]]:
    """Yield lines with their numbers, without comments."""
    try:
        text = read_bytes(file).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DatasetInvalid(file, "file", f"is not text in UTF-8: byte {error.start} doesn't belong to it") from None
    for number, line in enumerate(LINE_END.split(text), start=1):
        if not line.lstrip().startswith("#"):
            yield number, line.strip()


@contextmanager
def _record(file: Path, number: int, expected: str) -> Iterator[None]:
    """Raise a `ValueError` in the block as `DatasetInvalid` that names the line and the expected words."""
    try:
        yield
    except ValueError:
        raise DatasetInvalid(file, f"line {number}", f"must be {expected}") from None
