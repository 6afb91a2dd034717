"""Each field of COLMAP's, HyperNeRF's and Neu3D's files is applied, refused by name, or harmless."""

from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from msdgs_serve.scene.fields import FieldTable
from msdgs_train.datasets import DatasetInvalid, load_scene
from msdgs_train.datasets.colmap.model import COLMAP_FIELDS, PARAMETERS
from msdgs_train.datasets.hypernerf import HYPERNERF_FIELDS
from msdgs_train.datasets.neu3d import NEU3D_FIELDS
from tests.train.datasets import layouts
from tests.train.datasets.layouts import COLMAP_LENSES, hypernerf_json, write_colmap, write_hypernerf, write_neu3d


def of_use(table: FieldTable, use: str) -> list[str]:
    return [name for name, of in table.uses.items() if of == use]


def outcome(folder: Path) -> str:
    """All that training uses, as text; of a dataset that is refused, the error."""
    try:
        scene = load_scene(folder)
    except DatasetInvalid as error:
        return f"{error.field}: {error}"
    frames = [(split, frame) for split, frames in scene.splits.items() for frame in frames]
    values = [(s, f.name, f.t, f.distortion, f.camera, f.camera.camera_to_world.tolist()) for s, f in frames]
    masks = [frame.load_mask() for _, frame in frames]
    return repr((values, masks, scene.points, scene.point_colors, scene.scene_half_size))


# COLMAP: the columns of the text files

PLACES = {
    **{name: ("cameras.txt", 0, 2 + k) for k, name in enumerate(("WIDTH", "HEIGHT"))},
    **{name: ("images.txt", 0, k) for k, name in enumerate(("IMAGE_ID", "QW", "QX", "QY", "QZ", "TX", "TY", "TZ"))},
    **{name: ("images.txt", 0, 8 + k) for k, name in enumerate(("CAMERA_ID", "NAME"))},
    "POINTS2D[]": ("images.txt", 1, 0),
    **{name: ("points3D.txt", 0, k) for k, name in enumerate(("POINT3D_ID", "X", "Y", "Z", "R", "G", "B", "ERROR"))},
    "TRACK[]": ("points3D.txt", 0, 8),
}
"""File, line among those that are no comments, and column."""


def changed_colmap(folder: Path, name: str) -> Path:
    """A model in which one column of one line has another value."""
    file, line, column = PLACES[name]
    path = write_colmap(folder, ending="txt") / "sparse" / "0" / file
    lines = path.read_text().split("\n")
    number = [k for k, text in enumerate(lines) if text and not text.startswith("#")][line]
    words = lines[number].split(" ")
    other = {"NAME": "a_2.png", "R": "7", "CAMERA_ID": "8"}
    words[column] = other[name] if name in other else str(round(float(words[column]) + 3))
    lines[number] = " ".join(words)
    path.write_text("\n".join(lines))
    return folder


@pytest.mark.parametrize("name", [name for use in ("applied", "harmless") for name in of_use(COLMAP_FIELDS, use)])
def test_columns_of_colmap(tmp_path: Path, name: str):
    (tmp_path / "plain").mkdir()
    plain = outcome(write_colmap(tmp_path / "plain", ending="txt"))
    if name in PARAMETERS:
        folder = write_colmap(tmp_path, COLMAP_LENSES[name], ending="txt")
    elif name == "masks/":
        layouts.write_image(tmp_path / "masks" / "a_0.png.png", layouts.flat(255, COLMAP_LENSES["PINHOLE"]))
        folder = write_colmap(tmp_path, ending="txt")
    else:
        folder = changed_colmap(tmp_path, name)
    is_same = outcome(folder) == plain
    assert is_same == (COLMAP_FIELDS.use(name) == "harmless" or name == "PINHOLE")


@pytest.mark.parametrize("name", of_use(COLMAP_FIELDS, "refused"))
def test_other_lenses_of_colmap_are_named(tmp_path: Path, name: str):
    file = write_colmap(tmp_path, ending="txt") / "sparse" / "0" / "cameras.txt"
    file.write_text(file.read_text().replace("PINHOLE", name))
    with pytest.raises(DatasetInvalid, match=rf"is {name}, but only SIMPLE_PINHOLE, .* undistort the images"):
        load_scene(tmp_path)


# HyperNeRF

ORIENTATION = layouts.pose(8).rotation.T.tolist()
HYPERNERF: dict[str, tuple[str, Any]] = {
    "train_ids": ("dataset.json", ["000001"]),
    "val_ids": ("dataset.json", ["000000"]),
    "time_id": ("metadata.json", 3),
    "warp_id": ("metadata.json", 3),
    "scale": ("scene.json", 3.0),
    "center": ("scene.json", [3.0, 0.0, 1.0]),
    "orientation": ("camera/000000.json", ORIENTATION),
    "position": ("camera/000000.json", [3.0, 0.0, 1.0]),
    "focal_length": ("camera/000000.json", 222.0),
    "principal_point": ("camera/000000.json", [111.0, 99.0]),
    "pixel_aspect_ratio": ("camera/000000.json", 1.25),
    "radial_distortion": ("camera/000000.json", [0.02, 0.0, 0.0]),
    "tangential_distortion": ("camera/000000.json", [0.002, 0.0]),
    "tangential": ("camera/000000.json", [0.002, 0.0]),
    "image_size": ("camera/000000.json", [640, 480]),
    "skew": ("camera/000000.json", 0.5),
    "near": ("scene.json", 3.0),
    "far": ("scene.json", 33.0),
    "count": ("dataset.json", 3),
    "num_exemplars": ("dataset.json", 3),
    "ids": ("dataset.json", ["000003"]),
    "appearance_id": ("metadata.json", 3),
    "camera_id": ("metadata.json", 3),
}


def changed_hypernerf(folder: Path, name: str) -> Path:
    file, value = HYPERNERF[name]
    files = hypernerf_json()
    of = files[file]["000000"] if file == "metadata.json" else files[file]
    of[name] = value
    if name == "warp_id":
        for each in files[file].values():
            del each["time_id"]
    return write_hypernerf(folder, files=files)


@pytest.mark.parametrize("name", HYPERNERF_FIELDS.uses)
def test_fields_of_hypernerf(tmp_path: Path, name: str):
    (tmp_path / "plain").mkdir()
    plain, use = outcome(write_hypernerf(tmp_path / "plain")), HYPERNERF_FIELDS.use(name)
    got = outcome(changed_hypernerf(tmp_path, name))
    assert (got == plain) == (use == "harmless")
    assert got.startswith(f"{name}: ") == (use == "refused")


def test_unknown_fields_of_hypernerf_are_named_once_per_file(tmp_path: Path):
    files = hypernerf_json()
    for name, content in files.items():
        for of in content.values() if name == "metadata.json" else [content]:
            of["lightness"] = 1
    warnings = load_scene(write_hypernerf(tmp_path, files=files)).warnings
    places = [warning.partition(":")[0] for warning in warnings]
    assert places == [str(tmp_path / name) for name in ("dataset.json", "metadata.json", "scene.json", "camera")]
    assert all("`lightness` is not a known field of HyperNeRF" in warning for warning in warnings)


# Neu3D: the columns of poses_bounds.npy; videos are in test_video_rotation

COLUMNS = {"down": 0, "right": 1, "back": 2, "position": 3, "height": 4, "width": 9, "focal": 14, "near": 15, "far": 16}


@pytest.mark.parametrize("name", [name for name in NEU3D_FIELDS.uses if name != "displaymatrix"])
def test_columns_of_neu3d(tmp_path: Path, name: str):
    plain = outcome(write_neu3d(tmp_path))
    poses = np.load(tmp_path / "poses_bounds.npy")
    poses[0, COLUMNS[name]] += 0.25 if name in ("near", "far") else 30.0
    np.save(tmp_path / "poses_bounds.npy", poses)
    assert (outcome(tmp_path) == plain) == (NEU3D_FIELDS.use(name) == "harmless")


@pytest.mark.parametrize("shape", [(2, 15), (17, 2), (2, 14), (2, 3, 5), (17,)])
def test_a_table_of_another_shape_is_refused(tmp_path: Path, shape: tuple[int, ...]):
    np.save(write_neu3d(tmp_path) / "poses_bounds.npy", np.ones(shape))
    got = "×".join(map(str, shape))
    with pytest.raises(DatasetInvalid, match=rf"must hold real numbers in shape M×17, got float64 in shape {got}$"):
        load_scene(tmp_path)


def test_each_field_has_an_example():
    for table, names in ((HYPERNERF_FIELDS, HYPERNERF), (NEU3D_FIELDS, {**COLUMNS, "displaymatrix": 0})):
        assert set(names) == set(table.uses)
    known = {*PLACES, *PARAMETERS, "masks/", *of_use(COLMAP_FIELDS, "refused")}
    assert [name for name in COLMAP_FIELDS.uses if not any(fnmatchcase(each, name) for each in known)] == []


@pytest.mark.parametrize("ending", ["bin", "txt"])
def test_principal_points_outside_of_colmaps_images_are_refused(
    tmp_path: Path, ending: str, monkeypatch: pytest.MonkeyPatch
):
    outside = COLMAP_LENSES["PINHOLE"]._replace(cx=640.0, cy=480.0)
    monkeypatch.setitem(COLMAP_LENSES, "PINHOLE", outside)
    with pytest.raises(DatasetInvalid, match=r"`principal points` .* the center of images 4 times as wide"):
        load_scene(write_colmap(tmp_path, outside, ending=ending))
