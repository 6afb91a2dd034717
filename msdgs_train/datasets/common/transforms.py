"""`transforms*.json`: images with poses in OpenGL axes and intrinsics, in the layouts that descend from NeRF.

Cameras have the size of the stored image: if it is a downscaled copy of `w`×`h`, intrinsics are scaled.
"""

import math
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from msdgs_serve.scene import Camera, InvalidInput
from msdgs_train.datasets.common.images import EXTENSIONS, ImageSize
from msdgs_train.datasets.common.readers import read_json
from msdgs_train.datasets.common.scene_data import DatasetInvalid, Frame, image_size, reduced


class Entry(NamedTuple):
    """A frame as it is in the JSON file."""

    file: Path
    index: int
    values: dict[str, Any]
    shared: dict[str, Any]  # top-level values, for all frames

    def invalid(self, key: str, problem: str) -> DatasetInvalid:
        return DatasetInvalid(self.file, f"frames[{self.index}].{key}", problem)

    def get(self, key: str) -> Any:
        """The frame's own value, or else the file's; None if neither has one."""
        return self.values.get(key, self.shared.get(key))

    def has(self, key: str) -> bool:
        return self.get(key) is not None

    def number(self, key: str) -> float:
        """A finite number of the frame or of the file. Raises `DatasetInvalid`."""
        value = self.get(key)
        if value is None:
            raise self.invalid(key, "is missing")
        if not _is_finite_number(value):
            raise self.invalid(key, f"must be a finite number, got {value!r}")
        return float(value)

    def file_path(self) -> str:
        """The frame's `file_path`. Raises `DatasetInvalid`."""
        name = self.values.get("file_path")
        if not isinstance(name, str) or not name:
            raise self.invalid("file_path", "is missing" if name is None else f"must be a file name, got {name!r}")
        return name


def read_entries(file: Path, may_be_empty: bool = False) -> list[Entry]:
    """The frames of one JSON file; only their type is checked. Raises `DatasetInvalid` naming file and field."""
    content = read_json(file)
    frames = content.get("frames")
    if not isinstance(frames, list) or not (frames or may_be_empty):
        raise DatasetInvalid(file, "frames", "must be a list" + " of one frame or more" * (not may_be_empty))
    for index, values in enumerate(frames):
        if not isinstance(values, dict):
            raise DatasetInvalid(file, f"frames[{index}]", "must be a JSON object")
    return [Entry(file, index, values, content) for index, values in enumerate(frames)]


def check_times(entries: list[Entry]) -> None:
    """Raise `DatasetInvalid` if some frames have a `time` and others don't."""
    without = [entry for entry in entries if "time" not in entry.values]
    if without and len(without) < len(entries):
        raise without[0].invalid("time", "is missing, though other frames have one")


def read_frame(entry: Entry, size: int | None) -> Frame:
    """The frame, distortion ignored, for images `size` pixels wide; t = 0 if it has no `time`.

    Raises `DatasetInvalid` naming file and field, and `InvalidInput` for an unusable `size`.
    """
    image_path = _image_path(entry)
    camera = reduced(_camera(entry, image_size(image_path)), size, image_path)
    t = entry.number("time") if "time" in entry.values else 0.0
    return Frame(image_path.stem, camera, t, image_path)


def _image_path(entry: Entry) -> Path:
    path = entry.file.parent / entry.file_path()
    for candidate in (path, *(path.with_name(path.name + extension) for extension in EXTENSIONS)):
        if candidate.is_file():
            return candidate
    raise entry.invalid(
        "file_path", f"names {path}, but there is no such file, with or without {', '.join(EXTENSIONS)}"
    )


def _camera(entry: Entry, image: ImageSize) -> Camera:
    width, height = _stated_size(entry, image)
    fx = entry.number("fl_x") if entry.has("fl_x") else _focal_length(entry, "camera_angle_x", width)
    default_fy = _focal_length(entry, "camera_angle_y", height) if entry.has("camera_angle_y") else fx
    fy, cx, cy = (
        entry.number(key) if entry.has(key) else default
        for key, default in (("fl_y", default_fy), ("cx", width / 2), ("cy", height / 2))
    )
    try:
        return Camera.from_opengl(_matrix(entry), width, height, fx=fx, fy=fy, cx=cx, cy=cy).resized(*image)
    except InvalidInput as error:
        raise entry.invalid(_KEYS.get(error.field, "transform_matrix"), f"is not a valid camera: {error}") from None


_KEYS = {"camera.fx": "fl_x", "camera.fy": "fl_y", "camera.width": "w", "camera.height": "h"}


def _stated_size(entry: Entry, image: ImageSize) -> ImageSize:
    """The size that the intrinsics belong to: `w` and `h`, or else the image's own."""
    if not (entry.has("w") or entry.has("h")):
        return image
    stated = ImageSize(round(entry.number("w")), round(entry.number("h")))
    if not stated.has_shape_of(image):
        raise entry.invalid("w", f"and h are {stated}, but the image is {image}")
    return stated


def _focal_length(entry: Entry, key: str, length: int) -> float:
    """In pixels, from the field of view of `length` pixels."""
    angle = entry.get(key)
    if angle is None:
        raise DatasetInvalid(entry.file, key, f"is missing, and frames[{entry.index}] has no fl_x")
    if not (_is_finite_number(angle) and 0 < angle < math.pi):
        raise DatasetInvalid(entry.file, key, f"must be in (0, π) radians, got {angle!r}")
    return 0.5 * length / math.tan(0.5 * angle)


def _matrix(entry: Entry) -> np.ndarray:
    value = entry.values.get("transform_matrix")
    if value is None:
        raise entry.invalid("transform_matrix", "is missing")
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise entry.invalid("transform_matrix", "must be 4×4 numbers") from None
    if matrix.shape != (4, 4):
        raise entry.invalid("transform_matrix", f"must be 4×4 numbers, got shape {matrix.shape}")
    return matrix


def _is_finite_number(value: object) -> bool:
    largest = sys.float_info.max
    return isinstance(value, int | float) and not isinstance(value, bool) and -largest <= value <= largest
