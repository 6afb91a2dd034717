"""D-NeRF layout: `transforms_{train,val,test}.json` beside the photographs.

Each JSON has `camera_angle_x` (horizontal field of view, radians) and `frames`; each frame has `file_path` (with or
without extension, relative to the folder), `transform_matrix` (camera to world, OpenGL axes) and `time`. A scene whose
frames have no `time` is static, t = 0. Where a frame, or the file, has `fl_x`, `fl_y`, `cx`, `cy`, `w`, `h` in pixels,
they are used instead of the angle. The time range of the scene runs from the first to the last frame of all splits.
"""

import json
import math
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from msdgs_serve.scene import Camera, InvalidInput
from msdgs_train.datasets.images import EXTENSIONS, ImageSize, ImageUnreadable, read_size
from msdgs_train.datasets.scene_data import SPLITS, DatasetInvalid, Frame, SceneData

TRAIN_FILE = "transforms_train.json"
HALF_EXTENT = 1.3
"""Of the cube that all D-NeRF scenes fit in; Deformable-3D-Gaussians and 4DGaussians begin with points in it."""

DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")


def load_dnerf(folder: Path | str, size: int | None = None) -> SceneData:
    """Read the cameras, times and image sizes of a D-NeRF scene; val and test may be missing.

    `size` is the width in pixels that photographs are reduced to. Raises `DatasetInvalid` naming file and field.
    """
    folder = Path(folder)
    if size is not None and size < 1:
        raise InvalidInput("size", "a width of 1 pixel or more", size)
    entries = {split: _read_entries(folder / f"transforms_{split}.json", split) for split in SPLITS}
    _check_times(entries)
    splits = {split: [_frame(entry, size) for entry in entries[split]] for split in SPLITS}
    times = [frame.t for frames in splits.values() for frame in frames]
    return SceneData(splits, (min(times), max(times)), HALF_EXTENT)


class _Entry(NamedTuple):
    """A frame as the JSON has it."""

    file: Path
    index: int
    values: dict[str, Any]
    shared: dict[str, Any]  # what the file says for all frames

    def invalid(self, key: str, problem: str) -> DatasetInvalid:
        return DatasetInvalid(self.file, f"frames[{self.index}].{key}", problem)

    def get(self, key: str) -> Any:
        return self.values.get(key, self.shared.get(key))

    def has(self, key: str) -> bool:
        return self.get(key) is not None

    def number(self, key: str) -> float:
        value = self.get(key)
        if value is None:
            raise self.invalid(key, "is missing")
        if not _is_finite_number(value):
            raise self.invalid(key, f"must be a finite number, got {value!r}")
        return float(value)


def _read_entries(file: Path, split: str) -> list[_Entry]:
    if not file.exists() and split != "train":
        return []
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise DatasetInvalid(file, "file", f"can't be read: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise DatasetInvalid(file, "file", f"is not JSON: {error}") from None
    if not isinstance(content, dict):
        raise DatasetInvalid(file, "file", "must hold a JSON object")
    frames = content.get("frames")
    if not isinstance(frames, list) or (not frames and split == "train"):
        raise DatasetInvalid(file, "frames", "must be a list" + " of one frame or more" * (split == "train"))
    for index, values in enumerate(frames):
        if not isinstance(values, dict):
            raise DatasetInvalid(file, f"frames[{index}]", "must be a JSON object")
    return [_Entry(file, index, values, content) for index, values in enumerate(frames)]


def _check_times(entries: dict[str, list[_Entry]]) -> None:
    everything = [entry for split in entries.values() for entry in split]
    without = [entry for entry in everything if "time" not in entry.values]
    if without and len(without) < len(everything):
        raise without[0].invalid("time", "is missing, though other frames have one")


def _frame(entry: _Entry, size: int | None) -> Frame:
    image_path = _image_path(entry)
    try:
        photograph = read_size(image_path)
    except ImageUnreadable as error:
        raise DatasetInvalid(image_path, "image", f"can't be read: {error}") from None
    camera = _camera(entry, photograph)
    if size is not None and size != photograph.width:
        if size > photograph.width:
            raise InvalidInput("size", f"at most {photograph.width}, the width of {image_path}", size)
        camera = camera.resized(size, max(1, round(photograph.height * size / photograph.width)))
    t = entry.number("time") if "time" in entry.values else 0.0
    return Frame(image_path.stem, camera, t, image_path)


def _image_path(entry: _Entry) -> Path:
    name = entry.values.get("file_path")
    if not isinstance(name, str) or not name:
        raise entry.invalid("file_path", "is missing" if name is None else f"must be a file name, got {name!r}")
    path = entry.file.parent / name
    for candidate in (path, *(path.with_name(path.name + extension) for extension in EXTENSIONS)):
        if candidate.is_file():
            return candidate
    raise entry.invalid(
        "file_path", f"names {path}, but there is no such file, with or without {', '.join(EXTENSIONS)}"
    )


def _camera(entry: _Entry, photograph: ImageSize) -> Camera:
    """In pixels of the photograph as it is stored, which may be a reduced copy of what the JSON describes."""
    for key in DISTORTION:
        if entry.get(key):
            raise entry.invalid(key, "must be 0: photographs have to be undistorted first")
    width, height = _stated_size(entry, photograph)
    fx = entry.number("fl_x") if entry.has("fl_x") else _focal_length(entry, width)
    fy, cx, cy = (
        entry.number(key) if entry.has(key) else default
        for key, default in (("fl_y", fx), ("cx", width / 2), ("cy", height / 2))
    )
    try:
        return Camera.from_opengl(_matrix(entry), width, height, fx=fx, fy=fy, cx=cx, cy=cy).resized(*photograph)
    except InvalidInput as error:
        raise entry.invalid(_KEYS.get(error.field, "transform_matrix"), f"is no camera: {error}") from None


_KEYS = {"camera.fx": "fl_x", "camera.fy": "fl_y", "camera.width": "w", "camera.height": "h"}


def _stated_size(entry: _Entry, photograph: ImageSize) -> ImageSize:
    """The size that the intrinsics are about: `w` and `h`, or else the photograph's own."""
    if not (entry.has("w") or entry.has("h")):
        return photograph
    stated = ImageSize(round(entry.number("w")), round(entry.number("h")))
    if min(stated) < 1 or abs(stated.width * photograph.height / (stated.height * photograph.width) - 1) > 0.01:
        told, found = ("×".join(map(str, size)) for size in (stated, photograph))
        raise entry.invalid("w", f"and h are {told}, but the photograph is {found}")
    return stated


def _focal_length(entry: _Entry, width: int) -> float:
    angle = entry.shared.get("camera_angle_x")
    if angle is None:
        raise DatasetInvalid(entry.file, "camera_angle_x", f"is missing, and frames[{entry.index}] has no fl_x")
    if not (_is_finite_number(angle) and 0 < angle < math.pi):
        raise DatasetInvalid(entry.file, "camera_angle_x", f"must be in (0, π) radians, got {angle!r}")
    return 0.5 * width / math.tan(0.5 * angle)


def _matrix(entry: _Entry) -> np.ndarray:
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
