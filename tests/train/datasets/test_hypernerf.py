"""HyperNeRF layout: cameras by nerfies' projection, lenses, times and splits, and what is wrong with bad files."""

import copy
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from msdgs_serve.scene import InvalidInput
from msdgs_train.datasets import DatasetInvalid, load_scene
from msdgs_train.datasets.common.images import write_png
from tests.support.lens import centroids, frame_pixels, image_of_dots
from tests.support.tolerances import assert_close

WIDTH, HEIGHT = 320, 240
IDS = ["000010", "000020", "000030", "000040"]
SCENE = {"scale": 0.25, "center": [0.5, -1.0, 2.0], "near": 0.1, "far": 3.0}
LENSES = {
    "pinhole": ([0.0, 0.0, 0.0], [0.0, 0.0]),
    "radial": ([-0.12, 0.05, -0.02], [0.0, 0.0]),
    "tangential": ([0.0, 0.0, 0.0], [0.01, -0.006]),
    "both": ([0.1, -0.06, 0.03], [-0.004, 0.009]),
}


def camera(seed: int, lens: str = "pinhole") -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    radial, tangential = LENSES[lens]
    return {
        "orientation": (rotation * np.sign(np.linalg.det(rotation))).tolist(),
        "position": rng.normal(size=3).tolist(),
        "focal_length": 300.0,
        "principal_point": [164.5, 117.0],
        "skew": 0.0,
        "pixel_aspect_ratio": 1.05,
        "radial_distortion": radial,
        "tangential_distortion": tangential,
        "image_size": [WIDTH, HEIGHT],
    }


def contents(lens: str = "pinhole") -> dict[str, Any]:
    """What each JSON says, by its path. The capture alternates between two cameras, as vrig scenes do."""
    metadata = {
        id_: {"time_id": 5 * k, "warp_id": 99, "appearance_id": 0, "camera_id": k % 2} for k, id_ in enumerate(IDS)
    }
    files = {
        "dataset.json": {"count": 4, "ids": IDS, "train_ids": IDS[::2], "val_ids": IDS[1::2]},
        "metadata.json": metadata,
        "scene.json": copy.deepcopy(SCENE),
    }
    return {**files, **{f"camera/{id_}.json": camera(seed, lens) for seed, id_ in enumerate(IDS)}}


def write_scene(folder: Path, files: dict[str, Any], copies: tuple[int, ...] = (1,)) -> Path:
    (folder / "camera").mkdir()
    for name, content in files.items():
        (folder / name).write_text(json.dumps(content))
    for reduction in copies:
        (folder / "rgb" / f"{reduction}x").mkdir(parents=True)
        for id_ in IDS:
            image = np.full((HEIGHT // reduction, WIDTH // reduction, 3), int(id_) % 256, np.uint8)
            write_png(folder / "rgb" / f"{reduction}x" / f"{id_}.png", image)
    return folder


def nerfies_pixels(content: dict[str, Any], points: np.ndarray) -> np.ndarray:
    """[N, 2] of [N, 3] points in the file's world, term by term as in nerfies' `Camera.project`."""
    local = (np.array(content["orientation"]) @ (points - content["position"]).T).T
    x, y = local[:, 0] / local[:, 2], local[:, 1] / local[:, 2]
    r2 = x**2 + y**2
    k, p = content["radial_distortion"], content["tangential_distortion"]
    factor = 1.0 + r2 * (k[0] + r2 * (k[1] + k[2] * r2))
    x_lens = x * factor + 2.0 * p[0] * x * y + p[1] * (r2 + 2.0 * x**2)
    y_lens = y * factor + 2.0 * p[1] * x * y + p[0] * (r2 + 2.0 * y**2)
    f = content["focal_length"]
    u = f * x_lens + content["skew"] * y_lens + content["principal_point"][0]
    v = f * content["pixel_aspect_ratio"] * y_lens + content["principal_point"][1]
    return np.stack([u, v], axis=1)


def points_before(content: dict[str, Any], half_angle: float = 0.35) -> np.ndarray:
    """[12, 3] points in the file's world that the camera sees, each at another depth."""
    x, y = np.meshgrid(np.linspace(-half_angle, half_angle, 4), np.linspace(-0.7 * half_angle, 0.7 * half_angle, 3))
    rays = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)
    return rays * np.linspace(2.0, 6.0, 12)[:, None] @ np.array(content["orientation"]) + content["position"]


def to_scene(points: np.ndarray) -> np.ndarray:
    return (points - SCENE["center"]) * SCENE["scale"]


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("reduction", [1, 2])
def test_points_land_where_the_published_formula_puts_them(tmp_path: Path, lens: str, reduction: int):
    files = contents(lens)
    scene = load_scene(write_scene(tmp_path, files, copies=(reduction,)))
    for frame in [*scene.splits["train"], *scene.splits["test"]]:
        content = files[f"camera/{frame.name}.json"]
        points = points_before(content)
        want = nerfies_pixels(content, points) / reduction
        assert_close(frame_pixels(frame, to_scene(points)), want, "pixel")
        assert (frame.distortion is None) == (lens == "pinhole")


@pytest.mark.parametrize("lens", LENSES)
def test_dots_lie_at_their_pinhole_projections_after_loading(tmp_path: Path, lens: str):
    files = contents(lens)
    write_scene(tmp_path, files)
    content = files[f"camera/{IDS[0]}.json"]
    points = points_before(content)
    dots = image_of_dots(nerfies_pixels(content, points), WIDTH, HEIGHT)
    write_png(tmp_path / "rgb" / "1x" / f"{IDS[0]}.png", dots)
    straight = nerfies_pixels({**content, "radial_distortion": [0] * 3, "tangential_distortion": [0] * 2}, points)
    rgba = load_scene(tmp_path).splits["train"][0].load_rgba()
    assert_close(centroids(rgba, straight), straight, "dot_centroid")


def test_the_key_of_nerfies_is_understood(tmp_path: Path):
    files = contents("both")
    for id_ in IDS:
        files[f"camera/{id_}.json"]["tangential"] = files[f"camera/{id_}.json"].pop("tangential_distortion")
    distortion = load_scene(write_scene(tmp_path, files)).splits["train"][0].distortion
    assert distortion is not None
    assert (distortion.k1, distortion.k2, distortion.k3, distortion.p1, distortion.p2) == (
        0.1,
        -0.06,
        0.03,
        -0.004,
        0.009,
    )


def test_splits_times_and_pixels(tmp_path: Path):
    scene = load_scene(write_scene(tmp_path, contents()))
    assert {split: [frame.name for frame in frames] for split, frames in scene.splits.items()} == {
        "train": ["000010", "000030"],
        "val": [],
        "test": ["000020", "000040"],
    }
    assert [frame.t for frame in scene.splits["train"]] == [0.0, 10 / 15]
    assert [frame.t for frame in scene.splits["test"]] == [5 / 15, 1.0]
    assert scene.time_range == (0.0, 1.0)
    assert (scene.splits["test"][0].load_rgba()[..., :3] == 20).all()


def test_warp_ids_serve_where_there_are_no_time_ids(tmp_path: Path):
    files = contents()
    files["metadata.json"] = {id_: {"warp_id": 3 * k + 3, "camera_id": 0} for k, id_ in enumerate(IDS)}
    scene = load_scene(write_scene(tmp_path, files))
    assert [frame.t for frame in scene.splits["test"]] == [0.5, 1.0]
    assert scene.time_range == (0.25, 1.0)


def test_a_scene_whose_ids_are_all_0_is_static(tmp_path: Path):
    files = contents()
    files["metadata.json"] = {id_: {"time_id": 0} for id_ in IDS}
    assert load_scene(write_scene(tmp_path, files)).time_range == (0.0, 0.0)


def test_the_smallest_copy_that_is_wide_enough_is_read(tmp_path: Path):
    write_scene(tmp_path, contents(), copies=(2, 4, 16))
    for size, reduction in ((None, 2), (160, 2), (81, 2), (80, 4), (21, 4), (20, 16), (7, 16)):
        frame = load_scene(tmp_path, size).splits["train"][0]
        assert frame.image_path.parent.name == f"{reduction}x"
        assert frame.load_rgba().shape[1] == (size or 160)
    for size in (161, 0):
        with pytest.raises(InvalidInput, match="`size` must be"):
            load_scene(tmp_path, size)


def test_points_move_with_the_cameras(tmp_path: Path):
    write_scene(tmp_path, contents())
    assert load_scene(tmp_path).points is None
    points = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    np.save(tmp_path / "points.npy", points)
    scene = load_scene(tmp_path)
    assert scene.points is not None
    assert (scene.points == to_scene(points.astype(np.float64))).all()
    assert scene.point_colors is None
    assert scene.scene_half_size <= np.abs(scene.points).max()


def test_bad_points_are_refused(tmp_path: Path):
    write_scene(tmp_path, contents())
    np.save(tmp_path / "points.npy", [[0.0, 1.0, 2.0], [0.0, np.nan, 2.0]])
    with pytest.raises(DatasetInvalid, match=r"points\.npy: `row 1` must be finite"):
        load_scene(tmp_path)
    np.save(tmp_path / "points.npy", [[0.0, 1.0]])
    with pytest.raises(DatasetInvalid, match=r"points\.npy: `file` must hold real numbers in shape M×3"):
        load_scene(tmp_path)


CAMERA = "camera/000020.json"
MISSING = object()
WRONG = [
    ("dataset.json", "train_ids", MISSING, "train_ids", "is missing"),
    ("dataset.json", "train_ids", [], "train_ids", "must name one frame or more"),
    ("dataset.json", "val_ids", "000020", "val_ids", "must be a list of names"),
    ("dataset.json", "val_ids", [[1]], "val_ids", "must be a list of names"),
    ("metadata.json", "000020", MISSING, "000020", "is missing"),
    ("metadata.json", "000020", 7, "000020", "must be a JSON object"),
    ("metadata.json", "000020", {"camera_id": 1}, "000020.time_id", "is missing, and so is warp_id"),
    ("metadata.json", "000020", {"time_id": "late"}, "000020.time_id", "must be a finite number, got 'late'"),
    ("metadata.json", "000020", {"time_id": float("nan")}, "000020.time_id", "must be a finite number, got nan"),
    ("metadata.json", "000020", {"warp_id": -1}, "000020.warp_id", "must be 0 or more, got -1"),
    ("scene.json", "scale", MISSING, "scale", "is missing"),
    ("scene.json", "scale", 0, "scale", "must be above 0, got 0"),
    ("scene.json", "center", [0.0, 1.0], "center", "must be 3 finite numbers, got [0.0, 1.0]"),
    ("scene.json", "center", [0.0, float("inf"), 0.0], "center", "must be 3 finite numbers"),
    (CAMERA, "orientation", MISSING, "orientation", "is missing"),
    (CAMERA, "orientation", [[1, 0, 0], [0, 1, 0], [0, 0]], "orientation", "must be 3×3 finite numbers"),
    (CAMERA, "orientation", [[1, 0, 0], [0, 1, 0], [0, 0, float("nan")]], "orientation", "must be 3×3 finite numbers"),
    (CAMERA, "orientation", [[1, 0, 0], [0, 1, 0], [0, 0, -1]], "orientation", "without scale or mirroring"),
    (CAMERA, "position", [1, 2, 10**400], "position", "must be 3 finite numbers"),
    (CAMERA, "position", [True, False, True], "position", "must be 3 finite numbers"),
    (CAMERA, "focal_length", "long", "focal_length", "must be a finite number, got 'long'"),
    (CAMERA, "focal_length", -3.0, "focal_length", "above 0 pixels, got -3"),
    (CAMERA, "pixel_aspect_ratio", 0.0, "pixel_aspect_ratio", "above 0 pixels, got 0"),
    (CAMERA, "principal_point", [1.0], "principal_point", "must be 2 finite numbers"),
    (CAMERA, "skew", 0.5, "skew", "must be 0, got 0.5"),
    (CAMERA, "radial_distortion", MISSING, "radial_distortion", "is missing"),
    (CAMERA, "radial_distortion", [0.0, 0.0], "radial_distortion", "must be 3 finite numbers"),
    (CAMERA, "radial_distortion", [-9.0, 0.0, 0.0], "radial_distortion", "maps two points to one"),
    (CAMERA, "tangential_distortion", MISSING, "tangential_distortion", "is missing"),
    (CAMERA, "tangential_distortion", [0.0, float("nan")], "tangential_distortion", "must be 2 finite numbers"),
    (CAMERA, "image_size", [240, 320], "image_size", "is 240×320, but the image is 320×240"),
]


@pytest.mark.parametrize(("file", "key", "value", "field", "problem"), WRONG, ids=range(len(WRONG)))
def test_what_is_wrong_is_named(tmp_path: Path, file: str, key: str, value: Any, field: str, problem: str):
    files = contents()
    files[file] = {**files[file], key: value}
    if value is MISSING:
        del files[file][key]
    with pytest.raises(DatasetInvalid) as caught:
        load_scene(write_scene(tmp_path, files))
    assert (caught.value.file, caught.value.field) == (str(tmp_path / file), field)
    assert problem in str(caught.value)


@pytest.mark.parametrize("file", ["metadata.json", "scene.json", CAMERA])
@pytest.mark.parametrize("text", [None, "", "[1]", "{"])
def test_a_json_that_is_missing_or_none(tmp_path: Path, file: str, text: str | None):
    path = write_scene(tmp_path, contents()) / file
    path.unlink()
    if text is not None:
        path.write_text(text)
    with pytest.raises(DatasetInvalid, match=r"`file` (can't be read|is not JSON|must hold a JSON object)") as caught:
        load_scene(tmp_path)
    assert caught.value.file == str(path)


def test_images_that_are_missing_are_named(tmp_path: Path):
    write_scene(tmp_path, contents(), copies=(2,))
    (tmp_path / "rgb" / "2x" / "000040.png").unlink()
    with pytest.raises(DatasetInvalid, match=r"000040\.png: `image` can't be read"):
        load_scene(tmp_path)
    (tmp_path / "rgb").rename(tmp_path / "images")
    with pytest.raises(DatasetInvalid, match="rgb: `folder` must have the images in 1x, 2x or the like"):
        load_scene(tmp_path)
