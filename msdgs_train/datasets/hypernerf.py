"""HyperNeRF layout, the same as that of nerfies: one JSON file per camera, images in several sizes.

- `dataset.json`: `train_ids` and `val_ids`; the latter are the test split.
- `metadata.json`: for each id its `time_id` or, without one, its `warp_id`; t is that divided by the largest of all
  frames in use.
- `scene.json`: `scale` and `center`. The scene's axes are the file's, its origin is the center and its unit is
  1 / scale of the file's: x becomes (x - center) · scale, for cameras and points alike. `near` and `far` are not used.
- `camera/ID.json`: below.
- `rgb/Nx/ID.png`: images, downscaled to 1/N of the size in the cameras.
- `points.npy`, optional: sparse points [M, 3], without colors.

A camera is nerfies' `Camera`. `orientation` maps world to camera: its rows are the camera's axes right, down, forward.
`position` is in world axes; pixel centers are at half-integers, and fy = `focal_length` · `pixel_aspect_ratio`. As in
`Camera.project` of nerfies, x / z and y / z are distorted before focal length and principal point: by
`radial_distortion` (k1, k2, k3) with the factor 1 + k1 r² + k2 r⁴ + k3 r⁶, and by `tangential_distortion` (p1, p2;
`tangential` in nerfies) with + 2 p1 x y + p2 (r² + 2 x²) in x and + p1 (r² + 2 y²) + 2 p2 x y in y. That is OpenCV's
model, where k3 follows p2. `Frame.load_rgba` removes the distortion; the camera is a pinhole with the same intrinsics.
`skew` must be 0.
"""

import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from msdgs_serve.scene import Camera, InvalidInput
from msdgs_train.datasets.common.distortion import Distortion
from msdgs_train.datasets.common.extent import scene_half_size
from msdgs_train.datasets.common.images import ImageSize
from msdgs_train.datasets.common.readers import read_json, read_table
from msdgs_train.datasets.common.scene_data import DatasetInvalid, Frame, SceneData, image_size, reduced

DATASET_FILE = "dataset.json"
METADATA_FILE = "metadata.json"
SCENE_FILE = "scene.json"
POINTS_FILE = "points.npy"


def load_hypernerf(folder: Path | str, size: int | None = None) -> SceneData:
    """Read the cameras, times, splits and sparse points of a HyperNeRF scene.

    `size` is the width of the images in pixels: the smallest copy that is wide enough is downscaled, or with None the
    largest copy is used. Raises `DatasetInvalid` naming file and field, and `InvalidInput` for an unusable `size`.
    """
    folder = Path(folder)
    ids = _read_ids(folder / DATASET_FILE)
    times = _read_times(folder / METADATA_FILE, [id_ for split in ids.values() for id_ in split])
    world = _read_world(folder / SCENE_FILE)
    copies = _find_copy(folder / "rgb", ids["train"][0], size)
    splits = {
        split: [
            _frame(folder / "camera" / f"{id_}.json", copies / f"{id_}.png", times[id_], world, size) for id_ in members
        ]
        for split, members in ids.items()
    }
    points = _read_points(folder / POINTS_FILE, world)
    frames = [frame for members in splits.values() for frame in members]
    extent = scene_half_size(points, [frame.camera for frame in frames])
    return SceneData(splits, (min(times.values()), max(times.values())), extent, points)


class _World(NamedTuple):
    """The transform from the file's world to the scene's."""

    center: np.ndarray  # [3]
    scale: float

    def apply(self, positions: np.ndarray) -> np.ndarray:
        return (positions - self.center) * self.scale


def _read_ids(file: Path) -> dict[str, list[str]]:
    content = read_json(file)
    ids = {split: _id_list(file, content, key) for split, key in (("train", "train_ids"), ("test", "val_ids"))}
    if not ids["train"]:
        raise DatasetInvalid(file, "train_ids", "must name one frame or more")
    return {"train": ids["train"], "val": [], "test": ids["test"]}


def _id_list(file: Path, content: dict[str, Any], key: str) -> list[str]:
    value = _get(file, content, key)
    if not isinstance(value, list) or not all(isinstance(id_, str | int) for id_ in value):
        raise DatasetInvalid(file, key, "must be a list of names")
    return [str(id_) for id_ in value]


def _read_times(file: Path, ids: list[str]) -> dict[str, float]:
    """In [0, 1]; all are 0 if the largest time_id is 0."""
    content = read_json(file)
    numbers = {}
    for id_ in ids:
        entry = _get(file, content, id_)
        if not isinstance(entry, dict):
            raise DatasetInvalid(file, id_, "must be a JSON object")
        key = "time_id" if "time_id" in entry else "warp_id"
        if key not in entry:
            raise DatasetInvalid(file, f"{id_}.time_id", "is missing, and so is warp_id")
        number = _numbers(file, entry, key, (), f"{id_}.{key}")
        if number < 0:
            raise DatasetInvalid(file, f"{id_}.{key}", f"must be 0 or more, got {number:g}")
        numbers[id_] = float(number)
    last = max(numbers.values()) or 1.0
    return {id_: number / last for id_, number in numbers.items()}


def _read_world(file: Path) -> _World:
    content = read_json(file)
    scale = float(_numbers(file, content, "scale", ()))
    if scale <= 0:
        raise DatasetInvalid(file, "scale", f"must be above 0, got {scale:g}")
    return _World(_numbers(file, content, "center", (3,)), scale)


def _find_copy(folder: Path, id_: str, size: int | None) -> Path:
    """The folder of the smallest copies at least `size` pixels wide, or of the largest copies."""
    copies = [path for path in folder.glob("*x") if re.fullmatch(r"\d+x", path.name) and path.is_dir()]
    if not copies:
        raise DatasetInvalid(folder, "folder", "must have the images in 1x, 2x or the like, found none")
    copies.sort(key=lambda path: int(path.name[:-1]))
    if size is None:
        return copies[0]
    wide_enough = [path for path in copies if image_size(path / f"{id_}.png").width >= size]
    return wide_enough[-1] if wide_enough else copies[0]


def _frame(file: Path, image_path: Path, t: float, world: _World, size: int | None) -> Frame:
    content = read_json(file)
    camera = _camera(file, content, world, image_size(image_path))
    distortion = _distortion(file, content)
    if distortion is not None and distortion.folds(camera):
        raise DatasetInvalid(
            file, "radial_distortion", f"{distortion} maps two points to one: undistort the images first"
        )
    return Frame(image_path.stem, reduced(camera, size, image_path), t, image_path, distortion)


def _camera(file: Path, content: dict[str, Any], world: _World, image: ImageSize) -> Camera:
    """In pixels of the stored image."""
    if _numbers(file, content, "skew", ()) != 0:
        raise DatasetInvalid(file, "skew", f"must be 0, got {content['skew']}")
    width, height = _numbers(file, content, "image_size", (2,))
    stated = ImageSize(round(width), round(height))
    if not stated.has_shape_of(image):
        raise DatasetInvalid(file, "image_size", f"is {stated}, but the image is {image}")
    focal = float(_numbers(file, content, "focal_length", ()))
    aspect = float(_numbers(file, content, "pixel_aspect_ratio", ()))
    cx, cy = _numbers(file, content, "principal_point", (2,))
    pose = np.eye(4)
    pose[:3, :3] = _numbers(file, content, "orientation", (3, 3)).T
    pose[:3, 3] = world.apply(_numbers(file, content, "position", (3,)))
    try:
        return Camera(focal, focal * aspect, cx, cy, *stated, pose).resized(*image)
    except InvalidInput as error:
        raise DatasetInvalid(file, _KEYS.get(error.field, "orientation"), f"is not a valid camera's: {error}") from None


_KEYS = {"camera.fx": "focal_length", "camera.fy": "pixel_aspect_ratio", "camera.width": "image_size"}


def _distortion(file: Path, content: dict[str, Any]) -> Distortion | None:
    k1, k2, k3 = _numbers(file, content, "radial_distortion", (3,)).tolist()
    key = "tangential" if "tangential" in content else "tangential_distortion"
    p1, p2 = _numbers(file, content, key, (2,)).tolist()
    distortion = Distortion(k1=k1, k2=k2, p1=p1, p2=p2, k3=k3)
    return distortion if any(distortion) else None


def _read_points(file: Path, world: _World) -> np.ndarray | None:
    if not file.exists():
        return None
    points = read_table(file, 3)
    return world.apply(points) if len(points) else None


def _get(file: Path, content: dict[str, Any], key: str) -> Any:
    if content.get(key) is None:
        raise DatasetInvalid(file, key, "is missing")
    return content[key]


def _numbers(
    file: Path, content: dict[str, Any], key: str, shape: tuple[int, ...], name: str | None = None
) -> np.ndarray:
    """Finite float64 of that shape; errors call the field `name`, if given."""
    value = _get(file, content, key)
    wanted = f"{'×'.join(map(str, shape))} finite numbers" if shape else "a finite number"
    try:
        array = np.array(value)
    except ValueError:  # rows of different lengths
        array = np.array(None)
    if array.dtype.kind not in "fiu" or array.shape != shape or not np.isfinite(array).all():
        raise DatasetInvalid(file, name or key, f"must be {wanted}, got {repr(value)[:100]}")
    return array.astype(np.float64)
