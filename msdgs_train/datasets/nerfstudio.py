"""nerfstudio layout: one `transforms.json` beside the images.

The JSON has `frames`; each has `file_path` (relative to the folder), `transform_matrix` (camera to world, OpenGL axes)
and maybe `time`, in any unit. Frames without `time` have those of `times.json` (`times_file`); without that file the
scene is static, t = 0. `fl_x`, `fl_y`, `cx`, `cy`, `w`, `h` in pixels, or else `camera_angle_x` in radians, are given
per frame or for all; pixel centers are at half-integers, as in `Camera`. `camera_model` and distortion likewise.
`mask_path` is an image that is black where pixels don't count. Depths, `applied_transform` and nerfstudio's own
centering and scaling have no effect: the world is the one that `transform_matrix` and the points in `ply_file_path`
share.

`train_filenames`, `val_filenames` and `test_filenames` name the splits; a frame in none of them is ignored.
Without them the first frame, in the order of names, and every 8th after it are test frames.
"""

from pathlib import Path

from msdgs_train.datasets.common.extent import scene_half_size
from msdgs_train.datasets.common.images import EXTENSIONS
from msdgs_train.datasets.common.paths import find_file
from msdgs_train.datasets.common.readers import JsonObject, read_json
from msdgs_train.datasets.common.scene_data import SPLITS, Frame, SceneData, hold_out
from msdgs_train.datasets.common.times_file import with_stored_times
from msdgs_train.datasets.common.transforms import (
    SPLIT_KEYS,
    check_times,
    entries_of,
    file_path,
    named,
    read_frames,
    read_points,
)

TRANSFORMS_FILE = "transforms.json"


def load_nerfstudio(folder: Path, size: int | None = None) -> SceneData:
    """Read the cameras, times, splits and sparse points of a nerfstudio scene, as `load_scene` does."""
    content = read_json(folder / TRANSFORMS_FILE)
    entries = sorted(entries_of(content), key=file_path)
    check_times(entries)
    read = read_frames(content, entries, size)
    frames = named(read)
    if "time" not in entries[0].values:
        frames = with_stored_times(frames, folder)
    is_split = any(key in content.values for key in SPLIT_KEYS.values())
    splits = _listed_splits(content, frames) if is_split else hold_out(frames)
    points, colors = read_points(content)
    half_size = scene_half_size(points, [frame.camera for split in SPLITS for frame in splits[split]])
    unsplit = None if is_split else frames
    return SceneData(splits, half_size, points, colors, unsplit, read.warnings)


def _listed_splits(content: JsonObject, frames: list[Frame]) -> dict[str, list[Frame]]:
    splits, known = {}, {frame.image_path for frame in frames}
    for split, key in SPLIT_KEYS.items():
        names = content.names(key) if key in content.values else []
        chosen = [find_file(content.file.parent, name, EXTENSIONS) for name in names]
        for index, path in enumerate(chosen):
            if path not in known:
                raise content.invalid(f"{key}[{index}]", f"names {names[index]}, which is the file_path of no frame")
        splits[split] = [frame for frame in frames if frame.image_path in set(chosen)]
    if not splits["train"]:
        raise content.invalid("train_filenames", "must name one frame or more if other splits are listed")
    return splits
