"""D-NeRF layout: `transforms_{train,val,test}.json` beside the images.

Each JSON has `camera_angle_x` (horizontal field of view, radians) and `frames`; each frame has `file_path` (with or
without extension, relative to the folder), `transform_matrix` (camera to world, OpenGL axes) and `time`. A frame's name
is its path without the split's folder. A scene whose frames have no `time` is static, t = 0. If a frame, or the file,
has `fl_x`, `fl_y`, `cx`, `cy`, `w`, `h` in pixels, these are used instead of the angle. The time range of the scene
runs from the first to the last frame of all splits.
"""

from dataclasses import replace
from pathlib import Path, PurePosixPath

from msdgs_train.datasets.common.readers import JsonObject, read_json
from msdgs_train.datasets.common.scene_data import SPLITS, Frame, SceneData
from msdgs_train.datasets.common.transforms import check_times, entries_of, file_path, read_frame

TRAIN_FILE = "transforms_train.json"
SCENE_HALF_SIZE = 1.3
"""Half the side of the cube that holds all D-NeRF scenes; Deformable-3D-Gaussians and 4DGaussians start with points
in it."""

DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")


def load_dnerf(folder: Path, size: int | None = None) -> SceneData:
    """Read the cameras, times and image sizes of a D-NeRF scene, as `load_scene` does; val and test may be missing."""
    entries = {split: _read_split(folder, split) for split in SPLITS}
    check_times([entry for split in SPLITS for entry in entries[split]])
    splits = {split: [_frame(entry, split, size) for entry in entries[split]] for split in SPLITS}
    return SceneData(splits, SCENE_HALF_SIZE, has_nominal_size=True)


def _read_split(folder: Path, split: str) -> list[JsonObject]:
    file = folder / f"transforms_{split}.json"
    if split != "train" and not file.exists():
        return []
    return entries_of(read_json(file), may_be_empty=split != "train")


def _frame(entry: JsonObject, split: str, size: int | None) -> Frame:
    for key in DISTORTION:
        if entry.get(key):
            raise entry.invalid(key, "must be 0: undistort the images first")
    frame = read_frame(entry, size)
    path = PurePosixPath(file_path(entry))
    folders = () if path.is_absolute() else path.parts[:-1]
    if folders[:1] == (split,):
        folders = folders[1:]
    return replace(frame, name="_".join([*folders, frame.name]))
