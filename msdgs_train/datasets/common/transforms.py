"""`transforms*.json`: images with poses in OpenGL axes and intrinsics, in the layouts that descend from NeRF.

Cameras have the size of the stored image: if it is a downscaled copy of `w`×`h`, intrinsics are scaled.
"""

import math
from pathlib import Path

from msdgs_serve.scene import Camera, InvalidInput
from msdgs_train.datasets.common.images import EXTENSIONS, ImageSize, read_size
from msdgs_train.datasets.common.readers import JsonObject
from msdgs_train.datasets.common.scene_data import Frame, reduced

FIELDS = {"camera.fx": "fl_x", "camera.fy": "fl_y", "camera.width": "w", "camera.height": "h"}
"""The value of a frame that makes a field of its camera invalid; all other fields come from `transform_matrix`."""


def entries_of(content: JsonObject, may_be_empty: bool = False) -> list[JsonObject]:
    """Return the frames in the content of one JSON file, each with the values that the file gives for all frames.

    Only their type is checked. Raises `DatasetInvalid` naming file and field.
    """
    frames = content.get("frames")
    if not isinstance(frames, list) or not (frames or may_be_empty):
        raise content.invalid("frames", "must be a list" + " of one frame or more" * (not may_be_empty))
    for index, values in enumerate(frames):
        if not isinstance(values, dict):
            raise content.invalid(f"frames[{index}]", "must be a JSON object")
    return [
        JsonObject(content.file, {**content.values, **values}, f"frames[{index}].")
        for index, values in enumerate(frames)
    ]


def check_times(entries: list[JsonObject]) -> None:
    """Raise `DatasetInvalid` if some frames have a `time` and others don't."""
    without = [entry for entry in entries if "time" not in entry.values]
    if 0 < len(without) < len(entries):
        raise without[0].invalid("time", "is missing, though other frames have one")


def file_path(entry: JsonObject) -> str:
    """Return the frame's `file_path`. Raises `DatasetInvalid`."""
    name = entry.required("file_path")
    if not isinstance(name, str) or not name:
        raise entry.invalid("file_path", f"must be a file name, got {name!r}")
    return name


def read_frame(entry: JsonObject, size: int | None) -> Frame:
    """Read the frame, distortion ignored, for images `size` pixels wide; t = 0 if it has no `time`.

    Raises `DatasetInvalid` naming file and field, and `InvalidInput` for an unusable `size`.
    """
    image_path = _image_path(entry)
    camera = reduced(_camera(entry, read_size(image_path)), size, image_path)
    t = entry.number("time") if "time" in entry.values else 0.0
    return Frame(image_path.stem, camera, t, image_path)


def _image_path(entry: JsonObject) -> Path:
    path = entry.file.parent / file_path(entry)
    for candidate in (path, *(path.with_name(path.name + extension) for extension in EXTENSIONS)):
        if candidate.is_file():
            return candidate
    problem = f"names {path}, but there is no such file, with or without {', '.join(EXTENSIONS)}"
    raise entry.invalid("file_path", problem)


def _camera(entry: JsonObject, image: ImageSize) -> Camera:
    width, height = image
    if entry.get("w") is not None or entry.get("h") is not None:
        width, height = stated = ImageSize(round(entry.number("w")), round(entry.number("h")))
        if not stated.has_shape_of(image):
            raise entry.invalid("w", f"and h are {stated}, but the image is {image}")
    fx = entry.number("fl_x") if entry.get("fl_x") is not None else _focal_length(entry, "camera_angle_x", width)
    angle_y = entry.get("camera_angle_y")
    fy = entry.number("fl_y", fx if angle_y is None else _focal_length(entry, "camera_angle_y", height))
    cx, cy = entry.number("cx", width / 2), entry.number("cy", height / 2)
    matrix = entry.numbers("transform_matrix", 4, 4)
    try:
        return Camera.from_opengl(matrix, width, height, fx=fx, fy=fy, cx=cx, cy=cy).resized(*image)
    except InvalidInput as error:
        raise entry.invalid(FIELDS.get(error.field, "transform_matrix"), f"is not a valid camera: {error}") from None


def _focal_length(entry: JsonObject, key: str, length: int) -> float:
    """Return the focal length in pixels, from the field of view of `length` pixels."""
    if entry.get(key) is None:
        raise entry.invalid(key, "is missing, and so is fl_x")
    angle = entry.number(key)
    if not 0 < angle < math.pi:
        raise entry.invalid(key, f"must be in (0, π) radians, got {angle!r}")
    return 0.5 * length / math.tan(0.5 * angle)
