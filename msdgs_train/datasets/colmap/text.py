"""COLMAP's `cameras.txt`, `images.txt` and `points3D.txt`: one record per line, comments after `#`."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from msdgs_train.datasets.colmap.model import ModelCamera, ModelImage, check_model, make_camera
from msdgs_train.datasets.common.scene_data import DatasetInvalid


def _lines(file: Path) -> Iterator[tuple[int, str]]:
    """Lines with their numbers, without comments; empty lines are kept, since an image may have no observations."""
    try:
        text = file.read_text(encoding="utf-8")
    except OSError as error:
        raise DatasetInvalid(file, "file", f"can't be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise DatasetInvalid(file, "file", f"is not text: {error}") from None
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.startswith("#"):
            yield number, line.strip()


def read_cameras(file: Path) -> Iterator[tuple[int, ModelCamera]]:
    for number, line in _lines(file):
        if not line:
            continue
        field = f"line {number}"
        words = line.split()
        if len(words) < 4:
            raise DatasetInvalid(file, field, "must be CAMERA_ID MODEL WIDTH HEIGHT PARAMS…")
        check_model(file, field, words[1])
        try:
            camera_id, width, height = (int(words[i]) for i in (0, 2, 3))
            parameters = tuple(float(word) for word in words[4:])
        except ValueError as error:
            raise DatasetInvalid(file, field, f"must be CAMERA_ID MODEL WIDTH HEIGHT PARAMS…: {error}") from None
        yield camera_id, make_camera(file, field, words[1], width, height, parameters)


def read_images(file: Path) -> Iterator[ModelImage]:
    lines = _lines(file)
    for number, line in lines:
        if not line:
            continue
        words = line.split(maxsplit=9)
        try:
            pose = np.array([float(word) for word in words[1:8]])
            _, camera_id, name = int(words[0]), int(words[8]), words[9]
        except (ValueError, IndexError):
            wanted = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, followed by a line of its observations"
            raise DatasetInvalid(file, f"line {number}", f"must be {wanted}") from None
        next(lines, None)
        yield ModelImage(name, camera_id, pose[:4], pose[4:])


def read_points(file: Path) -> Iterator[tuple[float, ...]]:
    for number, line in _lines(file):
        if not line:
            continue
        try:
            values = tuple(float(word) for word in line.split(maxsplit=7)[1:7])
        except ValueError:
            values = ()
        if len(values) < 6:
            raise DatasetInvalid(file, f"line {number}", "must be POINT3D_ID X Y Z R G B ERROR TRACK…")
        yield values
