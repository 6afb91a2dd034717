"""nerfstudio layout: one `transforms.json` beside the images.

The JSON has `frames`; each has `file_path` (relative to the folder), `transform_matrix` (camera to world, OpenGL axes)
and maybe `time`, in any unit. A scene whose frames have no `time` is static, t = 0. `fl_x`, `fl_y`,
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

import numpy as np

from msdgs_train.datasets.common.distortion import Distortion, checked_distortion
from msdgs_train.datasets.common.extent import scene_half_size
from msdgs_train.datasets.common.ply_points import read_ply_points
from msdgs_train.datasets.common.readers import JsonObject, read_json
from msdgs_train.datasets.common.scene_data import SPLITS, Frame, SceneData, hold_out
from msdgs_train.datasets.common.transforms import check_times, entries_of, file_path, read_frame

TRANSFORMS_FILE = "transforms.json"
SPLIT_KEYS = {split: f"{split}_filenames" for split in SPLITS}
CAMERA_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")


def load_nerfstudio(folder: Path, size: int | None = None) -> SceneData:
    """Read the cameras, times, splits and sparse points of a nerfstudio scene, as `load_scene` does."""
    content = read_json(folder / TRANSFORMS_FILE)
    entries = sorted(entries_of(content), key=file_path)
    check_times(entries)
    frames = [_frame(entry, size) for entry in entries]
    is_split = any(key in content.values for key in SPLIT_KEYS.values())
    paths = [PurePosixPath(file_path(entry)) for entry in entries]
    splits = _listed_splits(content, paths, frames) if is_split else hold_out(frames)
    points, colors = _points(content)
    half_size = scene_half_size(points, [frame.camera for split in SPLITS for frame in splits[split]])
    return SceneData(splits, half_size, points, colors, unsplit=None if is_split else frames)


def _frame(entry: JsonObject, size: int | None) -> Frame:
    model = entry.get("camera_model") or "OPENCV"
    if model not in CAMERA_MODELS:
        raise entry.invalid("camera_model", f"must be one of {', '.join(CAMERA_MODELS)}, got {model!r}")
    if entry.get("is_fisheye"):
        raise entry.invalid("is_fisheye", "must be false: undistort fisheye images first")
    if entry.number("k4", 0.0) != 0:
        raise entry.invalid("k4", "must be 0: undistort the images first")
    distortion = Distortion(*(entry.number(key, 0.0) for key in Distortion._fields))
    frame = read_frame(entry, size)
    name = "_".join(PurePosixPath(file_path(entry)).with_suffix("").parts)
    distortion = checked_distortion(distortion, frame.camera, entry.file, f"{entry.prefix}k1")
    return replace(frame, name=name, distortion=distortion)


def _listed_splits(content: JsonObject, paths: list[PurePosixPath], frames: list[Frame]) -> dict[str, list[Frame]]:
    splits, known = {}, set(paths)
    for split, key in SPLIT_KEYS.items():
        names = [PurePosixPath(name) for name in content.names(key)] if key in content.values else []
        for index, name in enumerate(names):
            if name not in known:
                raise content.invalid(f"{key}[{index}]", f"names {name}, which is the file_path of no frame")
        chosen = set(names)
        splits[split] = [frame for path, frame in zip(paths, frames, strict=True) if path in chosen]
    if not splits["train"]:
        raise content.invalid("train_filenames", "must name one frame or more if other splits are listed")
    return splits


def _points(content: JsonObject) -> tuple[np.ndarray | None, np.ndarray | None]:
    name = content.get("ply_file_path")
    if name is None:
        return None, None
    if not isinstance(name, str) or not (content.file.parent / name).is_file():
        raise content.invalid("ply_file_path", f"names {name!r}, but there is no such file")
    return read_ply_points(content.file.parent / name)
