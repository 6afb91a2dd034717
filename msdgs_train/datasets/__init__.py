"""Images with cameras and times, read from published dataset layouts: one file per format."""

from dataclasses import replace
from pathlib import Path

from msdgs_train.datasets.colmap.loader import SPARSE, load_colmap
from msdgs_train.datasets.common.images import composite
from msdgs_train.datasets.common.intrinsics import check_intrinsics
from msdgs_train.datasets.common.orientations import orientation_warnings
from msdgs_train.datasets.common.readers import DatasetInvalid
from msdgs_train.datasets.common.scene_data import Frame, SceneData
from msdgs_train.datasets.common.times import NAMES, timed
from msdgs_train.datasets.common.times_file import TIMES_FILE
from msdgs_train.datasets.dnerf import TRAIN_FILE, load_dnerf
from msdgs_train.datasets.hypernerf import DATASET_FILE, load_hypernerf
from msdgs_train.datasets.nerfstudio import TRANSFORMS_FILE, load_nerfstudio
from msdgs_train.datasets.neu3d import MARKERS, load_neu3d

__all__ = ["DatasetInvalid", "Frame", "SceneData", "composite", "load_scene"]

LAYOUTS = (
    ("D-NeRF", (TRAIN_FILE,), load_dnerf),
    ("nerfstudio", (TRANSFORMS_FILE,), load_nerfstudio),
    ("HyperNeRF", (DATASET_FILE,), load_hypernerf),
    ("Neu3D", MARKERS, load_neu3d),
    ("COLMAP", (SPARSE,), load_colmap),
)
"""Name, marker files and reader of each layout; COLMAP is tried last, since other layouts contain its files too."""


def load_scene(
    path: Path | str, size: int | None = None, llffhold: int = 0, time_from: str | None = None, masks: bool = True
) -> SceneData:
    """Read the dataset in folder `path`, detecting its layout.

    `size` is the width in pixels that images are reduced to, height in proportion; the others are those of
    `DataConfig`. Times are in [0, 1]. Pixels are read later, by `Frame.load_rgba`. Raises `DatasetInvalid` naming file
    and field, and `InvalidInput` for an unusable `size`, `llffhold` or `time_from`.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise DatasetInvalid(folder, "folder", "does not exist" if not folder.exists() else "is a file")
    for layout, markers, load in LAYOUTS:
        if all(any(folder.glob(marker)) for marker in markers):
            has_times = load is not load_colmap or (folder / TIMES_FILE).is_file()
            own = None if has_times else NAMES  # COLMAP stores no times
            read = replace(load(folder, size), layout=layout)
            scene = timed(read, folder, own if time_from is None else time_from).in_unit_time()
            scene = replace(
                scene, warnings=(*scene.warnings, *check_intrinsics(scene, folder), *orientation_warnings(scene))
            )
            scene = scene if masks else scene.without_masks()
            return scene.split_again(llffhold) if llffhold else scene
    known = ", ".join(f"{name}'s has {' and '.join(markers)}" for name, markers, _ in LAYOUTS)
    raise DatasetInvalid(folder, "folder", f"is in no known layout: {known}")
