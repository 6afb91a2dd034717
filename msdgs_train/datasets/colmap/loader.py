"""COLMAP layout: a sparse model in `sparse/0` or `sparse`, binary or text, and the images in `images`.

Poses map world to camera in OpenCV axes and pixel centers are at half-integers, both as in `Camera`. Images of
the models SIMPLE_RADIAL, RADIAL and OPENCV are undistorted by `Frame.load_rgba`, bilinearly, to a pinhole camera with
the same intrinsics. If `images` holds downscaled copies, intrinsics are scaled to them.

COLMAP stores no times: a frame's time is the number that a pattern finds in the image's name, scaled to [0, 1] over the
images of the model. The first image, in the order of names, and every 8th after it are test frames.
"""

import math
import re
from pathlib import Path, PurePosixPath

import numpy as np

from msdgs_serve.scene import Camera, InvalidInput
from msdgs_serve.scene.quaternion import normalize, to_matrix
from msdgs_train.datasets.colmap import binary as colmap_binary
from msdgs_train.datasets.colmap import text as colmap_text
from msdgs_train.datasets.colmap.model import ModelCamera, ModelImage
from msdgs_train.datasets.common.distortion import Distortion
from msdgs_train.datasets.common.extent import scene_half_size
from msdgs_train.datasets.common.images import ImageSize
from msdgs_train.datasets.common.scene_data import DatasetInvalid, Frame, SceneData, hold_out, image_size, reduced

SPARSE = "sparse"
TRAILING_NUMBER = r"(\d+)[^\d/]*$"
"""The last run of digits in the name of the file, folders excluded."""


def load_colmap(folder: Path | str, size: int | None = None, time_pattern: str | None = TRAILING_NUMBER) -> SceneData:
    """Read the cameras, times and sparse points of a COLMAP scene.

    `size` is the width of the images in pixels. `time_pattern` is a regular expression with one group, the time in any
    unit; it is searched in the image's path below `images`, without the extension. With None, or if all numbers are
    equal, the scene is static, t = 0. Raises `DatasetInvalid` naming file and field, and `InvalidInput` for an unusable
    `size` or `time_pattern`.
    """
    folder = Path(folder)
    files = _model_files(folder)
    read = colmap_binary if files[0].suffix == ".bin" else colmap_text
    cameras = dict(read.read_cameras(files[0]))
    images = sorted(read.read_images(files[1]), key=lambda image: image.name)
    if not images:
        raise DatasetInvalid(files[1], "images", "must be one or more")
    frames = [
        _frame(folder, files, image, cameras.get(image.camera_id), t, size)
        for image, t in zip(images, _times(files[1], images, time_pattern), strict=True)
    ]
    points, colors = _points(files[2], list(read.read_points(files[2])))
    extent = scene_half_size(points, [frame.camera for frame in frames])
    times = [frame.t for frame in frames]
    return SceneData(hold_out(frames), (min(times), max(times)), extent, points, colors)


def _model_files(folder: Path) -> list[Path]:
    """The existing files `cameras`, `images` and `points3D`."""
    for place in (folder / SPARSE / "0", folder / SPARSE):
        for ending in (".bin", ".txt"):
            files = [place / f"{part}{ending}" for part in ("cameras", "images", "points3D")]
            if files[0].is_file():
                for file in files[1:]:
                    if not file.is_file():
                        raise DatasetInvalid(file, "file", f"is missing beside {files[0].name}")
                return files
    raise DatasetInvalid(folder / SPARSE, "cameras", "is missing: there is no cameras.bin or cameras.txt, here or in 0")


def _frame(
    folder: Path, files: list[Path], image: ModelImage, camera: ModelCamera | None, t: float, size: int | None
) -> Frame:
    field = f"images[{image.name}]"
    if camera is None:
        raise DatasetInvalid(files[1], field, f"has camera {image.camera_id}, which is not in {files[0].name}")
    image_path = folder / "images" / image.name
    if not image_path.is_file():
        raise DatasetInvalid(files[1], field, f"is in the model, but there is no file {image_path}")
    stored, stated = image_size(image_path), ImageSize(camera.width, camera.height)
    if not stated.has_shape_of(stored):
        raise DatasetInvalid(files[1], field, f"has a camera for {stated}, but the image is {stored}")
    pinhole = _pinhole(files, image, camera).resized(*stored)
    distortion = Distortion(**{key: camera.values.get(key, 0.0) for key in Distortion._fields})
    if distortion.folds(pinhole):
        problem = f"is {distortion} and maps two points to one: undistort the images with COLMAP"
        raise DatasetInvalid(files[0], f"cameras[{image.camera_id}]", problem)
    name = "_".join(PurePosixPath(image.name).with_suffix("").parts)
    return Frame(name, reduced(pinhole, size, image_path), t, image_path, distortion if any(distortion) else None)


def _pinhole(files: list[Path], image: ModelImage, camera: ModelCamera) -> Camera:
    """In pixels of the image that COLMAP was run on."""
    values = camera.values
    fx, fy = (values.get(key, values.get("f", math.nan)) for key in ("fx", "fy"))
    pose = _camera_to_world(files[1], image)
    try:
        return Camera(fx, fy, values["cx"], values["cy"], camera.width, camera.height, pose)
    except InvalidInput as error:
        raise DatasetInvalid(files[0], f"cameras[{image.camera_id}]", f"is not a valid camera: {error}") from None


def _camera_to_world(file: Path, image: ModelImage) -> np.ndarray:
    for key, values in (("qvec", image.qvec), ("tvec", image.tvec)):
        if not np.isfinite(values).all():
            raise DatasetInvalid(file, f"images[{image.name}].{key}", f"must be finite, got {values.tolist()}")
    try:
        rotation = to_matrix(normalize(image.qvec))  # world to camera
    except InvalidInput as error:
        raise DatasetInvalid(file, f"images[{image.name}].qvec", f"is not a rotation: {error}") from None
    pose = np.eye(4)
    pose[:3, :3] = rotation.T
    pose[:3, 3] = -rotation.T @ image.tvec
    return pose


def _times(file: Path, images: list[ModelImage], pattern: str | None) -> list[float]:
    """The time of each image, in [0, 1]."""
    if pattern is None:
        return [0.0] * len(images)
    try:
        expression = re.compile(pattern)
    except re.error as error:
        raise InvalidInput("time_pattern", f"a regular expression ({error})", repr(pattern)) from None
    if expression.groups != 1:
        raise InvalidInput("time_pattern", "a regular expression with one group", repr(pattern))
    numbers = [_number(file, image.name, expression) for image in images]
    first, last = min(numbers), max(numbers)
    return [(number - first) / ((last - first) or 1.0) for number in numbers]


def _number(file: Path, name: str, expression: re.Pattern[str]) -> float:
    match = expression.search(str(PurePosixPath(name).with_suffix("")))
    try:
        number = float(match[1]) if match else math.nan
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        problem = f"has no time: {expression.pattern} finds no number in it; set another time_pattern, or None"
        raise DatasetInvalid(file, f"images[{name}].name", problem)
    return number


def _points(file: Path, rows: list[tuple[float, ...]]) -> tuple[np.ndarray | None, np.ndarray | None]:
    """From x y z and 8-bit red green blue; None without points."""
    if not rows:
        return None, None
    values = np.array(rows, dtype=np.float64)
    bad = ~np.isfinite(values).all(axis=1)
    if bad.any():
        raise DatasetInvalid(file, f"points3D[{int(bad.argmax())}]", "must be finite")
    return values[:, :3], np.clip(values[:, 3:] / 255, 0, 1)
