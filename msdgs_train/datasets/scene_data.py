"""What every dataset is turned into: frames with a camera and a time each, in splits."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from msdgs_serve.scene import Camera, MsdgsError
from msdgs_train.datasets.images import ImageUnreadable, read_rgba, resize_area

SPLITS = ("train", "val", "test")


class DatasetInvalid(MsdgsError):
    """A dataset lacks something, or says what can't be true; `file` and `field` say where."""

    def __init__(self, file: Path | str, field: str, problem: str) -> None:
        super().__init__(f"{file}: `{field}` {problem}")
        self.file = str(file)
        self.field = field


@dataclass(frozen=True)
class Frame:
    """One photograph: where it was taken, when, and where its pixels are."""

    name: str
    camera: Camera  # of the size that `load_rgba` returns
    t: float
    image_path: Path

    def load_rgba(self) -> np.ndarray:
        """[height, width, 4] uint8, sRGB with straight alpha, reduced to the camera's size."""
        try:
            rgba = read_rgba(self.image_path)
        except ImageUnreadable as error:
            raise DatasetInvalid(self.image_path, "image", f"can't be read: {error}") from None
        return resize_area(rgba, self.camera.width, self.camera.height)


@dataclass(frozen=True)
class SceneData:
    """A dataset ready for training. World axes are the dataset's own; cameras are OpenCV."""

    splits: dict[str, list[Frame]]  # "train" has one frame or more; "val" and "test" may be empty
    time_range: tuple[float, float]  # first and last time of any frame of any split; equal in a static scene
    half_extent: float  # half the side of the cube around the origin that the scene fills, in scene units
    points: np.ndarray | None = None  # [M, 3] float64, sparse surface points in world axes, scene units
    point_colors: np.ndarray | None = None  # [M, 3] float64 sRGB in [0, 1]; None where `points` have no colours
