"""The common form of all datasets: splits of frames, each with a camera and a time."""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from msdgs_serve.scene import Camera, InvalidInput
from msdgs_train.datasets.common.distortion import Distortion, undistort
from msdgs_train.datasets.common.images import read_rgba, resize_area

SPLITS = ("train", "val", "test")
HELD_OUT = 8
"""Every 8th frame is a test frame if a dataset names none, as in Mip-NeRF 360 and 3D Gaussian Splatting."""


@dataclass(frozen=True)
class Frame:
    """One image with its camera, its time and its file."""

    name: str
    camera: Camera  # a pinhole of the size that `load_rgba` returns
    t: float
    image_path: Path
    distortion: Distortion | None = None  # of the stored image; `load_rgba` removes it

    @property
    def files(self) -> tuple[Path, ...]:
        """The files that its pixels are read from."""
        return (self.image_path,)

    def load_rgba(self) -> np.ndarray:
        """Read [height, width, 4] uint8, sRGB with straight alpha, undistorted and downscaled to the camera's size.

        Raises `DatasetInvalid` if the file can't be read.
        """
        rgba = read_rgba(self.image_path)
        if self.distortion is not None:
            height, width, _ = rgba.shape
            rgba = undistort(rgba, self.camera.resized(width, height), self.distortion)
        return self.downscale(rgba)

    def downscale(self, rgba: np.ndarray) -> np.ndarray:
        """Downscale an image of this frame without distortion, uint8 [H, W, 4], to the camera's size."""
        return resize_area(rgba, self.camera.width, self.camera.height)

    def halved(self) -> "Frame":
        """The same frame at half the width and height, rounded down but at least 1."""
        width, height = (max(side // 2, 1) for side in (self.camera.width, self.camera.height))
        return replace(self, camera=self.camera.resized(width, height))


@dataclass(frozen=True)
class SceneData:
    """A dataset ready for training. World axes are those of the dataset; cameras are OpenCV."""

    splits: dict[str, list[Frame]]  # "train" has one frame or more; "val" and "test" may be empty
    scene_half_size: float  # half the side of the cube around the origin that holds the scene, in scene units
    points: np.ndarray | None = None  # [M, 3] float64, sparse surface points in world axes, scene units
    point_colors: np.ndarray | None = None  # [M, 3] float64 sRGB in [0, 1]; None if `points` have no colors
    unsplit: list[Frame] | None = None  # all frames in their order, if the dataset itself names no splits
    warnings: tuple[str, ...] = ()  # what a user should know about the files, each one sentence with its remedy

    @cached_property
    def time_range(self) -> tuple[float, float]:
        """First and last time of the frames of all splits; equal in a static scene."""
        times = [frame.t for frames in self.splits.values() for frame in frames]
        return min(times), max(times)

    def in_unit_time(self) -> "SceneData":
        """The same scene; if times outside [0, 1] occur, all are scaled to it: layers take float32, and expect that."""
        first, last = self.time_range
        if first >= 0 and last <= 1:
            return self
        length = (last - first) or 1.0

        def scaled(frames: list[Frame]) -> list[Frame]:
            return [replace(frame, t=(frame.t - first) / length) for frame in frames]

        splits = {split: scaled(frames) for split, frames in self.splits.items()}
        return replace(self, splits=splits, unsplit=None if self.unsplit is None else scaled(self.unsplit))

    def split_again(self, every: int) -> "SceneData":
        """Split the training frames, or all frames of a dataset that names no splits, as `DataConfig.llffhold` says.

        Raises `InvalidInput` if no training frame is left.
        """
        frames = self.splits["train"] if self.unsplit is None else self.unsplit
        splits = _held_out(frames, every, {0: "test", every // 2: "val"})
        if not splits["train"]:
            raise InvalidInput("llffhold", f"fewer than the {len(frames)} training images", every)
        return replace(self, splits=splits)


def reduced(camera: Camera, size: int | None, image_path: Path) -> Camera:
    """Return `camera` for images `size` pixels wide, height in proportion; unchanged if `size` is None.

    Raises `InvalidInput` if `size` is not in [1, width of the image].
    """
    if size is None or size == camera.width:
        return camera
    if not 1 <= size <= camera.width:
        expected = f"in [1, {camera.width}], the width of {image_path}, or left out to keep that width"
        raise InvalidInput("size", expected, size)
    return camera.resized(size, max(1, round(camera.height * size / camera.width)))


def hold_out(frames: list[Frame]) -> dict[str, list[Frame]]:
    """Split frames: the first and every 8th after it are test frames; a single frame is a training frame."""
    return _held_out(frames, HELD_OUT, {0: "test"} if len(frames) > 1 else {})


def _held_out(frames: list[Frame], every: int, places: dict[int, str]) -> dict[str, list[Frame]]:
    """Split frames by their index modulo `every`: those whose place isn't named are training frames."""
    splits: dict[str, list[Frame]] = {split: [] for split in SPLITS}
    for index, frame in enumerate(frames):
        splits[places.get(index % every, "train")].append(frame)
    return splits
