"""nerfstudio layout: one `transforms.json` beside the images.

The JSON has `frames`; each has `file_path` (relative to the folder), `transform_matrix` (camera to world, OpenGL axes)
and maybe `time`, which may be outside [0, 1]. A scene whose frames have no `time` is static, t = 0. `fl_x`, `fl_y`,
`cx`, `cy`, `w`, `h` in pixels, or else `camera_angle_x` in radians, are given per frame or for all; pixel centers are
at half-integers, as in `Camera`. `camera_model` and the distortion `k1`, `k2`, `p1`, `p2`, `k3` likewise: they are
OpenCV's, and `Frame.load_rgba` removes the distortion by bilinear interpolation, to a pinhole camera with the same
intrinsics. `mask_path`, depths, `applied_transform` and nerfstudio's own centering and scaling are ignored: the world
is the one that `transform_matrix` and the points in `ply_file_path` share.

`train_filenames`, `val_filenames` and `test_filenames` name the splits; a frame in none of them is ignored.
Without them the first frame, in the order of names, and every 8th after it are test frames.
"""

from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from msdgs_train.datasets.common.distortion import Distortion
from msdgs_train.datasets.common.extent import scene_half_size
from msdgs_train.datasets.common.ply_points import read_ply_points
from msdgs_train.datasets.common.scene_data import SPLITS, DatasetInvalid, Frame, SceneData, hold_out
from msdgs_train.datasets.common.transforms import Entry, check_times, read_entries, read_frame

TRANSFORMS_FILE = "transforms.json"
CAMERA_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")


def load_nerfstudio(folder: Path | str, size: int | None = None) -> SceneData:
    """Read the cameras, times, splits and sparse points of a nerfstudio scene.

    `size` is the width of the images in pixels. Raises `DatasetInvalid` naming file and field, and `InvalidInput` for
    an unusable `size`.
    """
    file = Path(folder) / TRANSFORMS_FILE
    entries = sorted(read_entries(file), key=Entry.file_path)
    check_times(entries)
    shared = entries[0].shared
    frames = [_frame(entry, size) for entry in entries]
    splits = _splits(file, shared, [PurePosixPath(entry.file_path()) for entry in entries], frames)
    used = [frame for split in SPLITS for frame in splits[split]]
    times = [frame.t for frame in used]
    points, colors = _points(file, shared)
    extent = scene_half_size(points, [frame.camera for frame in used])
    return SceneData(splits, (min(times), max(times)), extent, points, colors)


def _frame(entry: Entry, size: int | None) -> Frame:
    distortion = _distortion(entry)
    frame = read_frame(entry, size)
    if distortion is not None and distortion.folds(frame.camera):
        raise entry.invalid("k1", f"and the rest of {distortion} map two points to one: undistort the images first")
    name = "_".join(PurePosixPath(entry.file_path()).with_suffix("").parts)
    return replace(frame, name=name, distortion=distortion)


def _distortion(entry: Entry) -> Distortion | None:
    model = entry.get("camera_model") or "OPENCV"
    if model not in CAMERA_MODELS:
        raise entry.invalid("camera_model", f"must be one of {', '.join(CAMERA_MODELS)}, got {model!r}")
    if entry.get("is_fisheye"):
        raise entry.invalid("is_fisheye", "must be false: undistort fisheye images first")
    if entry.has("k4") and entry.number("k4") != 0:
        raise entry.invalid("k4", "must be 0: undistort the images first")
    distortion = Distortion(*(entry.number(key) if entry.has(key) else 0.0 for key in Distortion._fields))
    return distortion if any(distortion) else None


def _splits(
    file: Path, shared: dict[str, Any], paths: list[PurePosixPath], frames: list[Frame]
) -> dict[str, list[Frame]]:
    if not any(f"{split}_filenames" in shared for split in SPLITS):
        return hold_out(frames)
    splits = {}
    for split in SPLITS:
        names = _names(file, shared, f"{split}_filenames", set(paths))
        splits[split] = [frame for path, frame in zip(paths, frames, strict=True) if path in names]
    if not splits["train"]:
        raise DatasetInvalid(file, "train_filenames", "must name one frame or more if other splits are listed")
    return splits


def _names(file: Path, shared: dict[str, Any], key: str, known: set[PurePosixPath]) -> set[PurePosixPath]:
    names = shared.get(key, [])
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise DatasetInvalid(file, key, "must be a list of file names")
    for index, name in enumerate(names):
        if PurePosixPath(name) not in known:
            raise DatasetInvalid(file, f"{key}[{index}]", f"names {name}, which is the file_path of no frame")
    return {PurePosixPath(name) for name in names}


def _points(file: Path, shared: dict[str, Any]) -> tuple[np.ndarray | None, np.ndarray | None]:
    name = shared.get("ply_file_path")
    if name is None:
        return None, None
    if not isinstance(name, str) or not (file.parent / name).is_file():
        raise DatasetInvalid(file, "ply_file_path", f"names {name!r}, but there is no such file")
    points, colors = read_ply_points(file.parent / name)
    return (points, colors) if len(points) else (None, None)
