"""Photographs with cameras and times, read from the layouts in which other people publish them. One file a format."""

from pathlib import Path

from msdgs_train.datasets.dnerf import TRAIN_FILE, load_dnerf
from msdgs_train.datasets.images import composite
from msdgs_train.datasets.scene_data import DatasetInvalid, Frame, SceneData

__all__ = ["DatasetInvalid", "Frame", "SceneData", "composite", "load_scene"]


def load_scene(path: Path | str, size: int | None = None) -> SceneData:
    """Read the dataset in folder `path`, whatever its layout.

    `size` is the width in pixels that photographs are reduced to, height in proportion. Pixels are read later, by
    `Frame.load_rgba`. Raises `DatasetInvalid` naming file and field, and `InvalidInput` where `size` can't be.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise DatasetInvalid(folder, "folder", "does not exist" if not folder.exists() else "is a file")
    if (folder / TRAIN_FILE).exists():
        return load_dnerf(folder, size)
    raise DatasetInvalid(folder, "folder", f"is in no known layout: D-NeRF's has {TRAIN_FILE}")
