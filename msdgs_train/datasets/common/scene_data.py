"""What every dataset is turned into: frames with a camera and a time each, in splits."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from msdgs_serve.scene import Camera, InvalidInput, MsdgsError
from msdgs_train.datasets.common.distortion import Distortion, undistort
from msdgs_train.datasets.common.images import ImageSize, ImageUnreadable, read_rgba, read_size, resize_area

SPLITS = ("train", "val", "test")
HELD_OUT = 8
"""Where a dataset names no test frames, every 8th is one, as in Mip-NeRF 360 and 3D Gaussian Splatting."""


class DatasetInvalid(MsdgsError):
    """A dataset lacks something, or says what can't be true; `file` and `field` say where."""

    def __init__(self, file: Path | str, field: str, problem: str) -> None:
        super().__init__(f"{file}: `{field}` {problem}")
        self.file = str(file)
        self.field = field


@dataclass(frozen=True)
class Frame:
    """One image: where it was taken, when, and where its pixels are."""

    name: str
    camera: Camera  # a pinhole of the size that `load_rgba` returns
    t: float
    image_path: Path
    distortion: Distortion | None = None  # of the lens, which the file still shows and `load_rgba` takes out

    def load_rgba(self) -> np.ndarray:
        """[height, width, 4] uint8, sRGB with straight alpha, undistorted and reduced to the camera's size.

        Raises `DatasetInvalid` where the file can't be read.
        """
        try:
            rgba = read_rgba(self.image_path)
        except ImageUnreadable as error:
            raise DatasetInvalid(self.image_path, "image", f"can't be read: {error}") from None
        if self.distortion is not None:
            height, width, _ = rgba.shape
            rgba = undistort(rgba, self.camera.resized(width, height), self.distortion)
        return resize_area(rgba, self.camera.width, self.camera.height)


@dataclass(frozen=True)
class SceneData:
    """A dataset ready for training. World axes are the dataset's own; cameras are OpenCV."""

    splits: dict[str, list[Frame]]  # "train" has one frame or more; "val" and "test" may be empty
    time_range: tuple[float, float]  # first and last time of any frame of any split; equal in a static scene
    scene_half_size: float  # half the side of the cube around the origin that the scene fills, in scene units
    points: np.ndarray | None = None  # [M, 3] float64, sparse surface points in world axes, scene units
    point_colors: np.ndarray | None = None  # [M, 3] float64 sRGB in [0, 1]; None where `points` have no colors


def image_size(path: Path) -> ImageSize:
    """The size that an image's header states. Raises `DatasetInvalid` where it can't be read."""
    try:
        return read_size(path)
    except ImageUnreadable as error:
        raise DatasetInvalid(path, "image", f"can't be read: {error}") from None


def reduced(camera: Camera, size: int | None, image_path: Path) -> Camera:
    """`camera` for images `size` pixels wide, height in proportion; as it is if `size` is None.

    Raises `InvalidInput` where `size` is not in [1, width of the image].
    """
    if size is None or size == camera.width:
        return camera
    if size < 1:
        raise InvalidInput("size", "a width of 1 pixel or more", size)
    if size > camera.width:
        raise InvalidInput("size", f"at most {camera.width}, the width of {image_path}", size)
    return camera.resized(size, max(1, round(camera.height * size / camera.width)))


def hold_out(frames: list[Frame]) -> dict[str, list[Frame]]:
    """Splits in which the first and every 8th frame after it are for testing; a single frame is for training."""
    test = frames[::HELD_OUT] if len(frames) > 1 else []
    train = [frame for index, frame in enumerate(frames) if index % HELD_OUT or not test]
    return {"train": train, "val": [], "test": test}
