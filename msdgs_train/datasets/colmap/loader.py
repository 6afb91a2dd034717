"""COLMAP layout: a sparse model in `sparse/0` or `sparse`, binary or text, and the images in `images`. Of `sparse/0`,
`sparse/1`, … the model with most images is read.

Poses map world to camera in OpenCV axes and pixel centers are at half-integers, both as in `Camera`. Images of
the models SIMPLE_RADIAL, RADIAL and OPENCV are undistorted by `Frame.load_rgba`, bilinearly, to a pinhole camera with
the same intrinsics. If `images` holds downscaled copies, intrinsics are scaled to them. `masks/a.png.png`, as COLMAP
names them, or `masks/a.png` is the mask of `images/a.png`, black where pixels don't count.

COLMAP stores no times: they are those of `times.json`, or without it t = 0 here, and `load_scene` takes them from the
images' names. The first image, in the order of names, and every 8th after it are test frames.
"""

import math
import os
from pathlib import Path
from types import ModuleType

import numpy as np

from msdgs_serve.scene import Camera, InvalidInput
from msdgs_serve.scene.quaternion import normalize, to_matrix
from msdgs_train.datasets.colmap import binary as colmap_binary
from msdgs_train.datasets.colmap import text as colmap_text
from msdgs_train.datasets.colmap.model import ModelCamera, ModelImage
from msdgs_train.datasets.common.distortion import Distortion, checked_distortion
from msdgs_train.datasets.common.extent import scene_half_size
from msdgs_train.datasets.common.images import EXTENSIONS, ImageSize, other_shape, read_size
from msdgs_train.datasets.common.masks import checked_mask, find_mask
from msdgs_train.datasets.common.name_fields import natural_order
from msdgs_train.datasets.common.paths import find_file, not_found, posix
from msdgs_train.datasets.common.readers import DatasetInvalid, finite_rows
from msdgs_train.datasets.common.scene_data import Frame, SceneData, hold_out, reduced
from msdgs_train.datasets.common.times_file import with_stored_times

SPARSE, IMAGES, MASKS = "sparse", "images", "masks"


def load_colmap(folder: Path, size: int | None = None) -> SceneData:
    """Read the cameras and sparse points of a COLMAP scene, as `load_scene` does."""
    models = [(files, _images(files)) for files in _model_files(folder)]
    files, images = max(models, key=lambda model: len(model[1]))
    if not images:
        raise DatasetInvalid(files[1], "images", "must be one or more")
    cameras = dict(_reader(files).read_cameras(files[0]))
    frames = [_frame(folder, files, image, cameras.get(image.camera_id), size) for image in images]
    frames = with_stored_times(frames, folder)
    points, colors = _points(files[2], list(_reader(files).read_points(files[2])))
    half_size = scene_half_size(points, [frame.camera for frame in frames])
    warnings = _pose_warnings(folder, files[0].parent, frames, len(models)) + _mask_warnings(folder / MASKS, frames)
    return SceneData(hold_out(frames), half_size, points, colors, unsplit=frames, warnings=warnings)


def _model_files(folder: Path) -> list[list[Path]]:
    """Find the files `cameras`, `images` and `points3D` of each model."""
    sparse = folder / SPARSE
    numbered = [place for place in sparse.glob("*") if place.name.isdecimal()]
    places = [*sorted(numbered, key=lambda place: natural_order(place.name)), sparse]
    found = [files for place in places if (files := _files_in(place))]
    if not found:
        raise DatasetInvalid(sparse, "cameras", "is missing: there is no cameras.bin or cameras.txt, here or in 0")
    whole = [files for files in found if all(file.is_file() for file in files)]
    if not whole:
        missing = next(file for file in found[0] if not file.is_file())
        raise DatasetInvalid(missing, "file", f"is missing beside {found[0][0].name}")
    return [files for files in whole if files[0].parent != sparse] or whole


def _files_in(place: Path) -> list[Path]:
    """The files that a model in this folder has, binary before text; none if it has no cameras."""
    for ending in (".bin", ".txt"):
        files = [place / f"{part}{ending}" for part in ("cameras", "images", "points3D")]
        if files[0].is_file():
            return files
    return []


def _reader(files: list[Path]) -> ModuleType:
    return colmap_binary if files[0].suffix == ".bin" else colmap_text


def _images(files: list[Path]) -> list[ModelImage]:
    return sorted(_reader(files).read_images(files[1]), key=lambda image: image.name)


def _pose_warnings(folder: Path, model: Path, frames: list[Frame], models: int) -> tuple[str, ...]:
    """A warning if the model that is read has no poses for some images."""
    used = {os.path.abspath(frame.image_path) for frame in frames}
    endings = {*EXTENSIONS, *(frame.image_path.suffix.lower() for frame in frames)}
    names = [
        path.relative_to(folder).as_posix() for path in (folder / IMAGES).rglob("*") if path.suffix.lower() in endings
    ]
    shown = [name for name in names if "mask" not in name.lower() and "/." not in name]
    without = sorted(name for name in shown if os.path.abspath(folder / name) not in used)
    if not without:
        return ()
    problem = f"{len(without)} of {len(without) + len(frames)} images have no pose in {model} and are left out, first "
    problem += f"{without[0]}: what only they show, and when it moves, isn't learned. "
    if models > 1:
        problem += f"It is the largest of {models} models, each in axes of its own. "
    return (problem + "Register them with COLMAP, or remove them",)


def _frame(folder: Path, files: list[Path], image: ModelImage, camera: ModelCamera | None, size: int | None) -> Frame:
    field = f"images[{image.name}]"
    if camera is None:
        raise DatasetInvalid(files[1], field, f"has camera {image.camera_id}, which is not in {files[0].name}")
    image_path = find_file(folder / IMAGES, image.name)
    if image_path is None:
        problem = f"is in the model, but there is no file {folder / IMAGES / posix(image.name)}"
        raise DatasetInvalid(files[1], field, f"{problem}: {not_found(folder / IMAGES, image.name)}")
    stored, stated = read_size(image_path), ImageSize(camera.width, camera.height)
    if not stated.has_shape_of(stored):
        raise DatasetInvalid(files[1], field, f"has a camera for {stated}, {other_shape(stated, image_path)}")
    pinhole = _pinhole(files, image, camera).resized(*stored)
    distortion = Distortion(**{key: camera.values.get(key, 0.0) for key in Distortion._fields})
    distortion = checked_distortion(distortion, pinhole, files[0], f"cameras[{image.camera_id}]")
    mask = find_mask(folder / MASKS, image.name)
    mask = None if mask is None else checked_mask(mask, stored, image_path)
    name = "_".join(posix(image.name).with_suffix("").parts)
    return Frame(name, reduced(pinhole, size, image_path), 0.0, image_path, distortion, mask)


def _mask_warnings(folder: Path, frames: list[Frame]) -> tuple[str, ...]:
    """A warning if a folder of masks has none for some images."""
    without = [frame for frame in frames if frame.mask_path is None]
    if not without or not folder.is_dir() or not any(folder.iterdir()):
        return ()
    name = without[0].image_path.relative_to(folder.parent / IMAGES).as_posix()
    problem = (
        f"{folder}: {len(without)} of {len(frames)} images have no mask, so that all their pixels count, first {name}"
    )
    return (f"{problem}; its mask is named {name}.png or as the image",)


def _pinhole(files: list[Path], image: ModelImage, camera: ModelCamera) -> Camera:
    """Return the camera, in pixels of the image that COLMAP was run on."""
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


def _points(file: Path, rows: list[tuple[float, ...]]) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Return positions and colors of rows of x y z and 8-bit red green blue; None without points."""
    if not rows:
        return None, None
    values = finite_rows(file, "points3D[{}]", np.array(rows, dtype=np.float64))
    return values[:, :3], np.clip(values[:, 3:] / 255, 0, 1)
