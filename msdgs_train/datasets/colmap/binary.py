"""COLMAP's `cameras.bin`, `images.bin` and `points3D.bin`: a count followed by little-endian records."""

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from msdgs_train.datasets.colmap.model import MODEL_NAMES, ModelCamera, ModelImage, make_camera, parameter_names
from msdgs_train.datasets.common.readers import DatasetInvalid, read_bytes


def read_cameras(file: Path) -> Iterator[tuple[int, ModelCamera]]:
    stream = _Stream(file)
    for field in stream.records("cameras"):
        camera_id, number, width, height = stream.take("iiQQ", field)
        model = MODEL_NAMES[number] if 0 <= number < len(MODEL_NAMES) else f"model {number}"
        parameters = stream.take(f"{len(parameter_names(file, field, model))}d", field)
        yield camera_id, make_camera(file, field, model, width, height, parameters)


def read_images(file: Path) -> Iterator[ModelImage]:
    stream = _Stream(file)
    for field in stream.records("images"):
        _, *pose, camera_id = stream.take("i7di", field)
        name = stream.text(field)
        (observations,) = stream.take("Q", field)
        stream.skip(24 * observations, field)
        yield ModelImage(name, camera_id, np.array(pose[:4]), np.array(pose[4:]))


def read_points(file: Path) -> Iterator[tuple[float, ...]]:
    stream = _Stream(file)
    for field in stream.records("points3D"):
        _, *values, _, length = stream.take("Q3d3BdQ", field)
        stream.skip(8 * length, field)
        yield tuple(values)


class _Stream:
    """A little-endian file, read sequentially. `field` is named in errors."""

    def __init__(self, file: Path) -> None:
        self.file, self.content, self.offset = file, read_bytes(file), 0

    def records(self, kind: str) -> Iterator[str]:
        """Read the number of records; returns their names for error messages."""
        (count,) = self.take("Q", kind)
        return (f"{kind}[{index}]" for index in range(count))

    def take(self, layout: str, field: str) -> tuple:
        size = struct.calcsize("<" + layout)
        self.skip(size, field)
        return struct.unpack_from("<" + layout, self.content, self.offset - size)

    def text(self, field: str) -> str:
        """Read the string up to the next zero byte."""
        start, end = self.offset, self.content.find(b"\0", self.offset)
        self.skip((end if end >= 0 else len(self.content)) + 1 - start, field)
        return self.content[start:end].decode("utf-8", errors="replace")

    def skip(self, length: int, field: str) -> None:
        self.offset += length
        if self.offset > len(self.content):
            raise DatasetInvalid(self.file, field, f"is cut off: the file ends after {len(self.content)} bytes")
