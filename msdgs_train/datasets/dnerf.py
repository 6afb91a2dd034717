"""D-NeRF layout: `transforms_{train,val,test}.json` beside the images.

Each JSON has `camera_angle_x` (horizontal field of view, radians) and `frames`; each frame has `file_path` (with or
without extension, relative to the folder), `transform_matrix` (camera to world, OpenGL axes) and `time`. A frame's name
is its path without the split's folder. A scene whose frames have no `time` is static, t = 0. All other fields are
those of nerfstudio's `transforms.json`, with the same meaning; points are those of the training file. The time range of
the scene runs from the first to the last frame of all splits.
"""

from pathlib import Path

from msdgs_train.datasets.common.extent import scene_half_size
from msdgs_train.datasets.common.readers import JsonObject, read_json
from msdgs_train.datasets.common.scene_data import SPLITS, SceneData
from msdgs_train.datasets.common.transforms import (
    SPLIT_KEYS,
    check_times,
    entries_of,
    named,
    read_frames,
    read_points,
)

TRAIN_FILE = "transforms_train.json"
SCENE_HALF_SIZE = 1.3
"""Half the side of the cube that holds all D-NeRF scenes; Deformable-3D-Gaussians and 4DGaussians start with points
in it."""


def load_dnerf(folder: Path, size: int | None = None) -> SceneData:
    """Read the cameras, times and image sizes of a D-NeRF scene, as `load_scene` does; val and test may be missing."""
    contents = {split: content for split in SPLITS if (content := _content(folder, split)) is not None}
    entries = {split: entries_of(content, may_be_empty=split != "train") for split, content in contents.items()}
    check_times([entry for split in contents for entry in entries[split]])
    files = {split: read_frames(content, entries[split], size) for split, content in contents.items()}
    splits = {split: named(files[split], without=split) if split in files else [] for split in SPLITS}
    points, colors = read_points(contents["train"])
    half_size = SCENE_HALF_SIZE if points is None else scene_half_size(points, [])
    warnings = tuple(text for file in files.values() for text in file.warnings)
    return SceneData(splits, half_size, points, colors, warnings=warnings, has_nominal_size=points is None)


def _content(folder: Path, split: str) -> JsonObject | None:
    file = folder / f"transforms_{split}.json"
    if split != "train" and not file.exists():
        return None
    content = read_json(file)
    for key in SPLIT_KEYS.values():
        if content.get(key):
            raise content.invalid(key, "names a split, but here each split has a file: name this one transforms.json")
    return content
