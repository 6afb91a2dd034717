"""Neu3D (DyNeRF) layout: `poses_bounds.npy` and, for each of some fixed cameras, a video or a folder of images.

`poses_bounds.npy` is LLFF's: a row of 17 numbers for each camera, in the order of the cameras' names. Those are a 3×5
matrix, row by row, and the nearest and furthest depth. The matrix's columns are the camera's axes in world space (down,
right, back), its position, and height, width and focal length in pixels; the principal point is the image's center.
World axes are those of the file. Images may be downscaled copies of the size in the matrix.

A camera is `cam07.mp4`, or a folder `cam07/` or `cam07/images/`, which is preferred as it needs no decoding. Cameras
are synchronized: all have F frames, and frame i is at t = i / (F - 1). The first camera, cam00, is the test view and
not trained on. Rows without a camera are left out if rows are numbered as cameras are. In coffee_martini, whose cam13
isn't synchronized, that one is left out, whether it is there or not.
"""

import re
from pathlib import Path

import numpy as np

from msdgs_serve.scene import Camera, InvalidInput
from msdgs_serve.scene.fields import FieldTable
from msdgs_train.datasets.common.extent import scene_half_size
from msdgs_train.datasets.common.images import EXTENSIONS, ImageSize, read_size
from msdgs_train.datasets.common.name_fields import natural_order
from msdgs_train.datasets.common.ply_points import read_ply_points
from msdgs_train.datasets.common.readers import DatasetInvalid, read_table
from msdgs_train.datasets.common.scene_data import Frame, SceneData, reduced
from msdgs_train.datasets.common.video import VideoFrame, read_info

POSES_FILE = "poses_bounds.npy"
MARKERS = (POSES_FILE, "cam0*")
"""Static LLFF scenes have a `poses_bounds.npy` too, and other layouts videos beside their images."""

POINTS_FILES = ("points3D_downsample*.ply", "points3d.ply", "points3D.ply")
"""The first that exists is read; of several downsampled ones the last by name, which is the smallest."""

NEU3D_FIELDS = FieldTable(
    "Neu3D",
    {
        **dict.fromkeys(("down", "right", "back", "position", "height", "width", "focal", "displaymatrix"), "applied"),
        **dict.fromkeys(("near", "far"), "harmless"),
    },
)
"""Columns of `poses_bounds.npy`, and what the videos' headers say of their frames."""

UNSYNCHRONIZED = ("coffee_martini", "cam13")
"""A scene, and its camera that publications leave out."""

VIDEO = ".mp4"
CAMERA_NAME = re.compile(r"cam\d+")


def load_neu3d(folder: Path, size: int | None = None) -> SceneData:
    """Read the cameras and, if there is a `.ply` file, the sparse points of a Neu3D scene, as `load_scene` does."""
    cameras, file = _find_cameras(folder), folder / POSES_FILE
    poses = read_table(file, 17)
    rows = _rows(folder, file, list(cameras), len(poses))
    views = [_view(file, row, name, cameras[name], poses[row], size) for name, row in rows.items()]
    first = views[0]
    for view in views:
        if len(view) != len(first):
            problem = f"are {len(view)}, but {first[0].image_path.parent} has {len(first)}: cut all to the same frames"
            raise DatasetInvalid(view[0].image_path.parent, "frames", problem)
    points, colors = _read_points(folder)
    splits = {"train": [frame for view in views[1:] for frame in view], "val": [], "test": first}
    return SceneData(splits, scene_half_size(points, [view[0].camera for view in views]), points, colors)


def _rows(folder: Path, file: Path, names: list[str], count: int) -> dict[str, int]:
    """The row of each camera that is used, given the cameras' names in order and the number of rows."""
    left_out = {UNSYNCHRONIZED[1]} if UNSYNCHRONIZED[0] in folder.resolve().name else set()
    in_order = sorted({*names, *left_out}, key=natural_order)
    if in_order != sorted(in_order):
        problem = (
            "may be in the order of the cameras' numbers or, as LLFF's script sorts them, of their names as texts, "
        )
        problem += (
            f"{' '.join(sorted(in_order))}: give all names as many digits, such as cam00, in the order of the rows"
        )
        raise DatasetInvalid(file, "rows", problem)
    numbers = [int(name.removeprefix("cam")) for name in names]
    if count in (len(in_order), len(names)):
        found = {name: row for row, name in enumerate(in_order if count == len(in_order) else names)}
    elif len(names) < count and max(numbers) < count:
        found = dict(zip(names, numbers, strict=True))
    else:
        problem = f"are {count}, but there are {len(names)} cameras: {' '.join(names)}. There must be one row "
        raise DatasetInvalid(file, "rows", problem + "per camera, in the order of their names")
    return {name: found[name] for name in names if name not in left_out}


def _find_cameras(folder: Path) -> dict[str, list[Path]]:
    """Find the images of each camera in the order of time, or its video; by the camera's name."""
    names = {path.stem for path in folder.iterdir() if CAMERA_NAME.fullmatch(path.stem)}
    if len(names) < 2:
        problem = f"must be two or more, got {len(names)}: cam00 for testing, cam01 and on for training"
        raise DatasetInvalid(folder, "cameras", problem)
    return {name: _find_files(folder, name) for name in sorted(names, key=natural_order)}


def _find_files(folder: Path, name: str) -> list[Path]:
    for place in (folder / name / "images", folder / name):
        shown = (path for path in place.glob("*") if not path.name.startswith("."))
        files = [path for path in shown if path.suffix.lower() in EXTENSIONS and path.is_file()]
        if files:
            return sorted(files, key=lambda path: natural_order(path.name))
    videos = [path for path in folder.glob(f"{name}.*") if path.suffix.lower() == VIDEO and path.is_file()]
    if not videos:
        problem = f"are missing: there is no {name}{VIDEO} and no {'|'.join(EXTENSIONS)}"
        raise DatasetInvalid(folder / name, "frames", problem)
    return videos[:1]


def _view(file: Path, row: int, name: str, files: list[Path], pose: np.ndarray, size: int | None) -> list[Frame]:
    """Read all frames of one camera, in the order of time."""
    first = files[0]
    if first.suffix.lower() == VIDEO:
        info = read_info(first)
        camera = reduced(_camera(file, row, pose, ImageSize(info.width, info.height)), size, first)
        return [
            VideoFrame(f"{name}_{i:06d}", camera, t, first / f"{i:06d}", video=first, index=i, info=info)
            for i, t in enumerate(_times(info.count))
        ]
    image = read_size(first)
    for path in files:
        if read_size(path) != image:
            raise DatasetInvalid(path, "image", f"is {read_size(path)}, but {first} is {image}")
    camera = reduced(_camera(file, row, pose, image), size, first)
    return [Frame(f"{name}_{path.stem}", camera, t, path) for path, t in zip(files, _times(len(files)), strict=True)]


def _times(count: int) -> list[float]:
    return [index / max(count - 1, 1) for index in range(count)]


def _camera(file: Path, row: int, values: np.ndarray, image: ImageSize) -> Camera:
    down, right, back, position, (height, width, focal) = values[:15].reshape(3, 5).T
    near, far = values[15:]
    if not 0 < near < far:
        raise DatasetInvalid(file, f"row {row}", f"must end in 0 < near < far, got {near:g} and {far:g}")
    stated = ImageSize(round(width), round(height))
    if not stated.has_shape_of(image):
        raise DatasetInvalid(file, f"row {row}", f"states a size of {stated}, but the image is {image}")
    pose = np.eye(4)
    pose[:3] = np.stack([right, down, -back, position], axis=1)
    try:
        return Camera(focal, focal, width / 2, height / 2, *stated, pose).resized(*image)
    except InvalidInput as error:
        raise DatasetInvalid(file, f"row {row}", f"is not a valid camera: {error}") from None


def _read_points(folder: Path) -> tuple[np.ndarray | None, np.ndarray | None]:
    for pattern in POINTS_FILES:
        files = sorted(folder.glob(pattern), key=lambda path: natural_order(path.stem))
        if files:
            return read_ply_points(files[-1])
    return None, None
