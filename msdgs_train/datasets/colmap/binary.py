"""COLMAP's `cameras.bin`, `images.bin` and `points3D.bin`: a count followed by little-endian records."""

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from msdgs_train.datasets.colmap.model import (
    MODEL_NAMES,
    PARAMETERS,
    ModelCamera,
    ModelImage,
    check_model,
    make_camera,
)
from msdgs_train.datasets.common.scene_data import DatasetInvalid


class _Bytes:
    """A little-endian file, read sequentially."""

    def __init__(self, file: Path) -> None:
        self.file = file
        try:
            self.content = file.read_bytes()
        except OSError as error:
            raise DatasetInvalid(file, "file", f"can't be read: {error.strerror}") from None
        self.offset = 0

    def take(self, layout: str, field: str) -> tuple:
        end = self.offset + struct.calcsize("<" + layout)
        self._require(end, field)
        values = struct.unpack_from("<" + layout, self.content, self.offset)
        self.offset = end
        return values

    def text(self, field: str) -> str:
        """The string up to the next zero byte."""
        end = self.content.find(b"\0", self.offset)
        self._require(end if end >= 0 else len(self.content) + 1, field)
        text = self.content[self.offset : end].decode("utf-8", errors="replace")
        self.offset = end + 1
        return text

    def skip(self, length: int, field: str) -> None:
        self._require(self.offset + length, field)
        self.offset += length

    def _require(self, end: int, field: str) -> None:
        if end > len(self.content):
            raise DatasetInvalid(self.file, field, f"is cut off: the file ends after {len(self.content)} bytes")


def read_cameras(file: Path) -> Iterator[tuple[int, ModelCamera]]:
    stream = _Bytes(file)
    (count,) = stream.take("Q", "cameras")
    for index in range(count):
        field = f"cameras[{index}]"
        camera_id, model, width, height = stream.take("iiQQ", field)
        name = MODEL_NAMES[model] if 0 <= model < len(MODEL_NAMES) else f"model {model}"
        check_model(file, field, name)
        parameters = stream.take(f"{len(PARAMETERS[name])}d", field)
        yield camera_id, make_camera(file, field, name, width, height, parameters)


def read_images(file: Path) -> Iterator[ModelImage]:
    stream = _Bytes(file)
    (count,) = stream.take("Q", "images")
    for index in range(count):
        field = f"images[{index}]"
        _, *pose, camera_id = stream.take("i7di", field)
        name = stream.text(field)
        (observations,) = stream.take("Q", field)
        stream.skip(24 * observations, field)
        yield ModelImage(name, camera_id, np.array(pose[:4]), np.array(pose[4:]))


def read_points(file: Path) -> Iterator[tuple[float, ...]]:
    stream = _Bytes(file)
    (count,) = stream.take("Q", "points3D")
    for index in range(count):
        field = f"points3D[{index}]"
        _, *values, _, length = stream.take("Q3d3BdQ", field)
        stream.skip(8 * length, field)
        yield tuple(values)
