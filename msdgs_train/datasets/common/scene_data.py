"""The common form of all datasets: splits of frames, each with a camera and a time."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from msdgs_serve.scene import Camera, InvalidInput
from msdgs_serve.scene.similarity import IDENTITY, Similarity
from msdgs_train.datasets.common.backdrop import Color, find_backdrop
from msdgs_train.datasets.common.distortion import Distortion, inside, shows_outside, undistort
from msdgs_train.datasets.common.extent import scene_half_size
from msdgs_train.datasets.common.images import read_rgba, resize_area
from msdgs_train.datasets.common.masks import WHITE, as_rgba, read_mask
from msdgs_train.datasets.common.normalization import (
    MIN_SEEN,
    are_at_one_place,
    are_parallel,
    find_subject,
    normalization,
    other_units,
    seen_depths,
)
from msdgs_train.datasets.common.readers import DatasetInvalid

SPLITS = ("train", "val", "test")
HELD_OUT = 8
"""Every 8th frame is a test frame if a dataset names none, as in Mip-NeRF 360 and 3D Gaussian Splatting."""

ONE_PLACE = (
    "all cameras are at one place, which shows no depth, and only views from there will look right: record with a "
    "camera that moves, or with several"
)
SAME_MODEL = "give points in the axes and units of the poses, such as those of the same COLMAP model"
UNSEEN_POINTS = "{} one of the {:,} points, which are left out: " + SAME_MODEL
UNKNOWN_SIZE = (
    "the cameras don't look at one point and there are no points, so that the size of the scene is a guess: {:.3g} "
    "around the cameras; --scene-half-size sets it, and COLMAP's points tell it"
)


@dataclass(frozen=True)
class Frame:
    """One image with its camera, its time and its file."""

    name: str
    camera: Camera  # a pinhole of the size that `load_rgba` returns
    t: float
    image_path: Path
    distortion: Distortion | None = None  # of the stored image; `load_rgba` removes it
    mask_path: Path | None = None  # an image of the stored image's size, black where pixels don't count
    states_size: bool = True  # whether the dataset says for which size of the image its intrinsics are

    @property
    def files(self) -> tuple[Path, ...]:
        """The files that its pixels are read from."""
        return (self.image_path,)

    def load_rgba(self) -> np.ndarray:
        """Read [height, width, 4] uint8, sRGB with straight alpha, undistorted and downscaled to the camera's size.

        Raises `DatasetInvalid` if the file can't be read.
        """
        return self._as_camera(read_rgba(self.image_path))

    @property
    def is_masked(self) -> bool:
        """Whether some pixels don't count, by a mask or since the stored image doesn't show them."""
        return self.mask_path is not None or self._shows_outside

    @property
    def _shows_outside(self) -> bool:
        return self.distortion is not None and shows_outside(self.camera, self.distortion)

    def load_mask(self) -> np.ndarray | None:
        """Read [height, width] bool, true where the pixels of `load_rgba` count; None if all do.

        A pixel counts if all of the stored pixels that it was made of do, and if its center, distorted, is in the
        stored image. Raises `DatasetInvalid`, also if none does.
        """
        mask = self.load_own_mask()
        if self.distortion is None or not self._shows_outside:
            return mask
        shown = inside(self.camera, self.distortion)
        return shown if mask is None else shown & mask

    def load_own_mask(self) -> np.ndarray | None:
        """`load_mask` by the mask's file alone."""
        if self.mask_path is None:
            return None
        mask = self._as_camera(as_rgba(read_mask(self.mask_path)))[..., 0] == WHITE
        if not mask.any():
            problem = f"leaves no pixel of {self.image_path} at {self.camera.width}×{self.camera.height}: white pixels "
            raise DatasetInvalid(self.mask_path, "mask", problem + "count, black ones don't. Leave this image out")
        return mask

    def downscale_mask(self, mask: np.ndarray) -> np.ndarray:
        """Downscale a mask of this frame, bool [H, W], to the camera's size, as `load_mask` does."""
        return self.downscale(as_rgba(mask))[..., 0] == WHITE

    def _as_camera(self, rgba: np.ndarray) -> np.ndarray:
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
    """A dataset. Loaders return it in the world that the dataset's files describe, `normalized` in the frame that is
    trained in. Cameras are OpenCV."""

    splits: dict[str, list[Frame]]  # "train" has one frame or more; "val" and "test" may be empty
    scene_half_size: float  # half the side of the cube around the origin that holds the scene, in scene units
    points: np.ndarray | None = None  # [M, 3] float64, sparse surface points, scene units
    point_colors: np.ndarray | None = None  # [M, 3] float64 sRGB in [0, 1]; None if `points` have no colors
    unsplit: list[Frame] | None = None  # all frames in their order, if the dataset itself names no splits
    warnings: tuple[str, ...] = ()  # what a user should know about the files, each one sentence with its remedy
    layout: str = ""  # name of the dataset's layout
    scene_to_world: Similarity = IDENTITY  # from the frame of cameras and points to that of the files
    has_nominal_size: bool = False
    """Whether `scene_half_size` is that of all scenes in this layout, with cameras at `normalization.DISTANCE`."""

    @property
    def cameras(self) -> list[Camera]:
        """Those of all frames, of each pose one."""
        every = (frame.camera for frames in self.splits.values() for frame in frames)
        return list({camera.camera_to_world.tobytes(): camera for camera in every}.values())

    @cached_property
    def backdrop(self) -> Color | None:
        """The color that opaque images show around the scene, RGB in [0, 1], if they show one."""
        return find_backdrop(self.splits["train"])

    def normalized(self) -> "SceneData":
        """The same scene in the frame that it is trained in, without points that fewer than half of the cameras see."""
        if not self.scene_to_world.is_identity:
            return self
        cameras, points, warnings = self.cameras, self.points, list(self.warnings)
        if points is not None and (seen := len(seen_depths(cameras, points))) < MIN_SEEN * len(cameras):
            who = f"only {seen:,} of {len(cameras):,} cameras see" if seen else "no camera sees"
            warnings.append(UNSEEN_POINTS.format(who, len(points)))
            points = None
        if points is not None and (problem := other_units(cameras, points)):
            warnings.append(f"{problem}: {SAME_MODEL}")
        if sum(map(len, self.splits.values())) > 1 and are_at_one_place(cameras):
            warnings.append(ONE_PLACE)
        if self.has_nominal_size and are_parallel(cameras):
            return replace(self, warnings=tuple(warnings))
        subject = find_subject(cameras, points)
        is_guess = points is None and not subject.is_looked_at and subject.distance > 0
        if is_guess:
            warnings.append(UNKNOWN_SIZE.format(subject.distance))
        scene = replace(self, warnings=tuple(warnings), has_nominal_size=self.has_nominal_size and not is_guess)
        if points is not self.points:
            scene = replace(scene, points=None, point_colors=None)
        if not scene.has_nominal_size:
            scene = replace(scene, scene_half_size=scene_half_size(points, cameras))
        return scene.in_frame(normalization(subject))

    def in_frame(self, scene_to_world: Similarity) -> "SceneData":
        """The same scene in another frame."""
        own = self.scene_to_world
        if scene_to_world == own:
            return self

        def moved(frame: Frame) -> Frame:
            return replace(frame, camera=scene_to_world.camera_to_scene(own.camera_to_world(frame.camera)))

        points = None if self.points is None else scene_to_world.to_scene(own.to_world(self.points))
        scene = replace(self._with_each(moved), points=points, scene_to_world=scene_to_world)
        if self.has_nominal_size:
            return scene
        return replace(scene, scene_half_size=scene_half_size(points, scene.cameras))

    @cached_property
    def time_range(self) -> tuple[float, float]:
        """First and last time of the frames of all splits; equal in a static scene."""
        times = [frame.t for frames in self.splits.values() for frame in frames]
        return min(times), max(times)

    def without_masks(self) -> "SceneData":
        """The same scene, all pixels of which count."""
        return self._with_each(lambda frame: replace(frame, mask_path=None))

    def in_unit_time(self) -> "SceneData":
        """The same scene; if times outside [0, 1] occur, all are scaled to it: layers take float32, and expect that."""
        first, last = self.time_range
        if first >= 0 and last <= 1:
            return self
        half = (last / 2 - first / 2) or 0.5  # the whole length may overflow
        return self.retimed(lambda frame: (frame.t / 2 - first / 2) / half)

    def retimed(self, time: Callable[[Frame], float]) -> "SceneData":
        """The same scene, with another time of each frame."""
        return self._with_each(lambda frame: replace(frame, t=time(frame)))

    def split_again(self, every: int) -> "SceneData":
        """Split the training frames, or all frames of a dataset that names no splits, as `DataConfig.llffhold` says.

        Raises `InvalidInput` if no training frame is left.
        """
        frames = self.splits["train"] if self.unsplit is None else self.unsplit
        splits = _held_out(frames, every, {0: "test", every // 2: "val"})
        if not splits["train"]:
            raise InvalidInput("llffhold", f"0 with so few images ({len(frames)})", every)
        return replace(self, splits=splits)

    def _with_each(self, change: Callable[[Frame], Frame]) -> "SceneData":
        splits = {split: [change(frame) for frame in frames] for split, frames in self.splits.items()}
        unsplit = None if self.unsplit is None else [change(frame) for frame in self.unsplit]
        return replace(self, splits=splits, unsplit=unsplit)


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
