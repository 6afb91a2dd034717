"""`transforms*.json`: images with poses in OpenGL axes and intrinsics, in the layouts that descend from NeRF.

Cameras have the size of the stored image: if it is a downscaled copy of `w`×`h`, intrinsics are scaled. The distortion
`k1`, `k2`, `p1`, `p2`, `k3` is OpenCV's; `Frame.load_rgba` removes it by bilinear interpolation, to a pinhole camera
with the same intrinsics. `transforms_fields` has all fields.
"""

import math
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np

from msdgs_serve.scene import Camera, InvalidInput
from msdgs_train.datasets.common.distortion import Distortion, checked_distortion
from msdgs_train.datasets.common.images import EXTENSIONS, ImageSize, other_shape, read_size
from msdgs_train.datasets.common.intrinsics import check_resolution, contradiction
from msdgs_train.datasets.common.masks import checked_mask, dynamic_mask
from msdgs_train.datasets.common.paths import find_file, not_found, posix
from msdgs_train.datasets.common.ply_points import read_ply_points
from msdgs_train.datasets.common.readers import JsonObject, unread_fields
from msdgs_train.datasets.common.scene_data import SPLITS, Frame, reduced
from msdgs_train.datasets.common.transforms_fields import TRANSFORMS_FIELDS, check_fields

FIELDS = {"camera.fx": "fl_x", "camera.fy": "fl_y", "camera.width": "w", "camera.height": "h"}
"""The value of a frame that makes a field of its camera invalid; all other fields come from `transform_matrix`."""


SPLIT_KEYS = {split: f"{split}_filenames" for split in SPLITS}


class TransformsFile(NamedTuple):
    """What one JSON file holds."""

    content: JsonObject
    entries: list[JsonObject]  # each frame, with the values that the file gives for all frames
    frames: list[Frame]  # in the same order
    warnings: tuple[str, ...]


def read_frames(content: JsonObject, entries: list[JsonObject], size: int | None) -> TransformsFile:
    """Read the frames of one file, for images `size` pixels wide.

    Raises `DatasetInvalid` naming file and field, and `InvalidInput` for an unusable `size`.
    """
    frames = [_read_frame(entry, size) for entry in entries]
    names = dict.fromkeys(name for entry in entries for name in entry.values)
    warnings = (*unread_fields(content.file, TRANSFORMS_FIELDS, names), *_contradictions(content, frames))
    return TransformsFile(content, entries, frames, warnings)


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
    shared = {key: value for key, value in content.values.items() if key != "frames"}
    return [JsonObject(content.file, {**shared, **values}, f"frames[{index}].") for index, values in enumerate(frames)]


def check_times(entries: list[JsonObject]) -> None:
    """Raise `DatasetInvalid` if some frames have a `time` and others don't."""
    without = [entry for entry in entries if "time" not in entry.values]
    if 0 < len(without) < len(entries):
        raise without[0].invalid("time", "is missing, though other frames have one")


def file_path(entry: JsonObject) -> PurePosixPath:
    """Return the frame's `file_path`. Raises `DatasetInvalid`."""
    name = entry.required("file_path")
    if not isinstance(name, str) or not posix(name).name:
        raise entry.invalid("file_path", f"must be a file name, got {name!r}")
    return posix(name)


def named(file: TransformsFile, without: str = "") -> list[Frame]:
    """Return the frames, each named by its path without extension, and without the folder `without` if that is the
    first."""
    return [
        replace(frame, name="_".join([*_folders(entry, without), frame.image_path.stem]))
        for entry, frame in zip(file.entries, file.frames, strict=True)
    ]


def _folders(entry: JsonObject, without: str) -> list[str]:
    path, folder = file_path(entry), entry.file.parent.absolute()
    if path.is_absolute():
        path = path.relative_to(folder) if path.is_relative_to(folder) else PurePosixPath(path.name)
    folders = [part for part in path.parts[:-1] if part != ".."]
    return folders[1:] if folders[:1] == [without] else folders


def read_points(content: JsonObject) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Read the points and their colors from `ply_file_path`; None if there are none."""
    if content.get("ply_file_path") is None:
        return None, None
    return read_ply_points(_named_file(content, "ply_file_path"))


def _read_frame(entry: JsonObject, size: int | None) -> Frame:
    check_fields(entry)
    distortion = Distortion(*(entry.number(key, 0.0) for key in Distortion._fields))
    image_path = _named_file(entry, "file_path", EXTENSIONS)
    stored = read_size(image_path)
    camera = reduced(_camera(entry, stored, image_path), size, image_path)
    t = entry.number("time") if "time" in entry.values else 0.0
    distortion = checked_distortion(distortion, camera, entry.file, f"{entry.prefix}k1")
    mask = dynamic_mask(image_path) if entry.get("mask_path") is None else _named_file(entry, "mask_path")
    mask = None if mask is None else checked_mask(mask, stored, image_path)
    return Frame(image_path.stem, camera, t, image_path, distortion, mask, states_size=_states_size(entry))


def _contradictions(content: JsonObject, frames: list[Frame]) -> list[str]:
    """The first contradiction of the file; angles for all frames may differ from the focal lengths of each."""
    own = content.values["frames"]
    levels = [content] * bool(frames)
    levels += [JsonObject(content.file, values, f"frames[{index}].") for index, values in enumerate(own)]
    cameras = [frame.camera for frame in (*frames[:1], *frames)]
    found = (contradiction(values, camera) for values, camera in zip(levels, cameras, strict=True))
    return [text for text in found if text][:1]


def _named_file(entry: JsonObject, key: str, endings: tuple[str, ...] = ()) -> Path:
    name, folder = entry.required(key), entry.file.parent
    if not isinstance(name, str) or not posix(name).name:
        raise entry.invalid(key, f"must be a file name, got {name!r}")
    found = find_file(folder, name, endings)
    if found is None:
        tried = f", with or without {', '.join(endings)}" if endings else ""
        raise entry.invalid(key, f"names {name!r}, but {not_found(folder, name)}{tried}")
    return found


def _camera(entry: JsonObject, image: ImageSize, image_path: Path) -> Camera:
    width, height = image
    if _states_size(entry):
        width, height = stated = ImageSize(round(entry.number("w")), round(entry.number("h")))
        if not stated.has_shape_of(image):
            raise entry.invalid("w", f"and h are {stated}, {other_shape(stated, image_path)}")
    fx, fy = _focal_length(entry, "x", width), _focal_length(entry, "y", height)
    fx, fy = fy if fx is None else fx, fx if fy is None else fy
    if fx is None or fy is None:
        raise entry.invalid("camera_angle_x", "is missing, and so is fl_x")
    cx, cy = entry.number("cx", width / 2), entry.number("cy", height / 2)
    if not _states_size(entry):
        check_resolution(entry, cx, cy, image)
    matrix = entry.numbers("transform_matrix", 4, 4)
    try:
        camera = Camera.from_opengl(matrix, width, height, fx=fx, fy=fy, cx=cx, cy=cy)
        return camera.resized(*image)
    except InvalidInput as error:
        raise entry.invalid(FIELDS.get(error.field, "transform_matrix"), f"is not a valid camera: {error}") from None


def _states_size(entry: JsonObject) -> bool:
    return entry.get("w") is not None or entry.get("h") is not None


def _focal_length(entry: JsonObject, axis: str, length: int) -> float | None:
    """Return the focal length in pixels, maybe from the field of view of `length` pixels; None if there is neither."""
    if entry.get(f"fl_{axis}") is not None:
        return entry.number(f"fl_{axis}")
    for key, unit, unit_name in (
        (f"camera_angle_{axis}", math.pi, "π) radians"),
        (f"{axis}_fov", 180.0, "180) degrees"),
    ):
        if entry.get(key) is not None:
            angle = entry.number(key)
            if not 0 < angle < unit:
                raise entry.invalid(key, f"must be in (0, {unit_name}, got {angle!r}")
            return 0.5 * length / math.tan(0.5 * angle * math.pi / unit)
    return None
