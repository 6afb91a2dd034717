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
from collections.abc import Callable
from pathlib import Path

import numpy as np

from msdgs_serve.scene import Camera, InvalidInput
from msdgs_serve.scene.fields import FieldTable
from msdgs_train.datasets.common.distortion import Distortion, checked_distortion
from msdgs_train.datasets.common.extent import scene_half_size
from msdgs_train.datasets.common.images import ImageSize, other_shape, read_size
from msdgs_train.datasets.common.readers import DatasetInvalid, JsonObject, read_json, read_table, unread_fields
from msdgs_train.datasets.common.scene_data import Frame, SceneData, reduced

DATASET_FILE = "dataset.json"
FIELDS = {"camera.fx": "focal_length", "camera.fy": "pixel_aspect_ratio", "camera.width": "image_size"}
"""The value of a file that makes a field of its camera invalid; all other fields come from `orientation`."""

HYPERNERF_FIELDS = FieldTable(
    "HyperNeRF",
    {
        **dict.fromkeys(("train_ids", "val_ids", "time_id", "warp_id", "scale", "center"), "applied"),
        **dict.fromkeys(
            ("orientation", "position", "focal_length", "principal_point", "pixel_aspect_ratio"), "applied"
        ),
        **dict.fromkeys(("radial_distortion", "tangential_distortion", "tangential", "image_size"), "applied"),
        "skew": "refused",
        **dict.fromkeys(("near", "far", "count", "num_exemplars", "ids", "appearance_id", "camera_id"), "harmless"),
    },
)

Transform = Callable[[np.ndarray], np.ndarray]
"""Maps positions in the files' world, [..., 3], to the scene's."""


def load_hypernerf(folder: Path, size: int | None = None) -> SceneData:
    """Read the cameras, times, splits and sparse points of a HyperNeRF scene, as `load_scene` does.

    The smallest copy of the images at least `size` pixels wide is downscaled; without `size` the largest copy is used.
    """
    dataset = read_json(folder / DATASET_FILE)
    ids = {"train": dataset.names("train_ids"), "val": [], "test": dataset.names("val_ids")}
    if not ids["train"]:
        raise dataset.invalid("train_ids", "must name one frame or more")
    metadata, world = read_json(folder / "metadata.json"), read_json(folder / "scene.json")
    times = _times(metadata, [id_ for split in ids.values() for id_ in split])
    to_scene = _transform(world)
    cameras = {id_: read_json(folder / "camera" / f"{id_}.json") for id_ in times}
    copies = _find_copy(folder / "rgb", ids["train"][0], size)
    splits = {
        split: [_frame(cameras[id_], copies / f"{id_}.png", times[id_], to_scene, size) for id_ in members]
        for split, members in ids.items()
    }
    points = _read_points(folder / "points.npy", to_scene)
    half_size = scene_half_size(points, [frame.camera for frames in splits.values() for frame in frames])
    groups = {
        folder / DATASET_FILE: [dataset],
        metadata.file: [metadata.child(id_) for id_ in times],
        world.file: [world],
        folder / "camera": list(cameras.values()),
    }
    warnings = [text for place, objects in groups.items() for text in _unread(place, objects)]
    return SceneData(splits, half_size, points, warnings=tuple(warnings))


def _unread(place: Path, objects: list[JsonObject]) -> list[str]:
    names = dict.fromkeys(name for each in objects for name in each.values)
    return unread_fields(place, HYPERNERF_FIELDS, names)


def _times(metadata: JsonObject, ids: list[str]) -> dict[str, float]:
    """Times in [0, 1] by id; all are 0 if the largest time_id is 0."""
    numbers = {}
    for id_ in ids:
        entry = metadata.child(id_)
        key = "time_id" if "time_id" in entry.values else "warp_id"
        if key not in entry.values:
            raise entry.invalid("time_id", "is missing, and so is warp_id")
        numbers[id_] = entry.number(key)
        if numbers[id_] < 0:
            raise entry.invalid(key, f"must be 0 or more, got {numbers[id_]:g}")
    last = max(numbers.values()) or 1.0
    return {id_: number / last for id_, number in numbers.items()}


def _transform(scene: JsonObject) -> Transform:
    scale = scene.number("scale")
    if scale <= 0:
        raise scene.invalid("scale", f"must be above 0, got {scale:g}")
    center = scene.numbers("center", 3)
    return lambda positions: (positions - center) * scale


def _find_copy(folder: Path, id_: str, size: int | None) -> Path:
    """Find the folder of the smallest copies at least `size` pixels wide, or of the largest copies."""
    copies = [path for path in folder.glob("*x") if re.fullmatch(r"\d+x", path.name) and path.is_dir()]
    if not copies:
        raise DatasetInvalid(folder, "folder", "must have the images in 1x, 2x or the like, found none")
    copies.sort(key=lambda path: int(path.name[:-1]))
    if size is None:
        return copies[0]
    wide_enough = [path for path in copies if read_size(path / f"{id_}.png").width >= size]
    return wide_enough[-1] if wide_enough else copies[0]


def _frame(values: JsonObject, image_path: Path, t: float, to_scene: Transform, size: int | None) -> Frame:
    camera = _camera(values, to_scene, image_path)
    k1, k2, k3 = values.numbers("radial_distortion", 3).tolist()
    p1, p2 = values.numbers("tangential" if "tangential" in values.values else "tangential_distortion", 2).tolist()
    distortion = checked_distortion(Distortion(k1, k2, p1, p2, k3), camera, values.file, "radial_distortion")
    return Frame(image_path.stem, reduced(camera, size, image_path), t, image_path, distortion)


def _camera(values: JsonObject, to_scene: Transform, image_path: Path) -> Camera:
    """Return the camera, in pixels of the stored image."""
    if values.number("skew") != 0:
        raise values.invalid("skew", f"must be 0, got {values.get('skew')}")
    stated, image = ImageSize(*map(round, values.numbers("image_size", 2))), read_size(image_path)
    if not stated.has_shape_of(image):
        raise values.invalid("image_size", f"is {stated}, {other_shape(stated, image_path)}")
    focal, aspect = values.number("focal_length"), values.number("pixel_aspect_ratio")
    cx, cy = values.numbers("principal_point", 2)
    pose = np.eye(4)
    pose[:3, :3] = values.numbers("orientation", 3, 3).T
    pose[:3, 3] = to_scene(values.numbers("position", 3))
    try:
        return Camera(focal, focal * aspect, cx, cy, *stated, pose).resized(*image)
    except InvalidInput as error:
        raise values.invalid(FIELDS.get(error.field, "orientation"), f"is not a valid camera: {error}") from None


def _read_points(file: Path, to_scene: Transform) -> np.ndarray | None:
    if not file.exists():
        return None
    points = read_table(file, 3)
    return to_scene(points) if len(points) else None
