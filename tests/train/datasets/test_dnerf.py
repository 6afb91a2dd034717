"""Images in D-NeRF layout: where their cameras look, what their pixels become, and what is wrong with bad ones."""

import copy
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest

from msdgs_serve.scene import Camera, InvalidInput
from msdgs_train.datasets import DatasetInvalid, load_scene
from msdgs_train.datasets.common.images import write_png
from tests.support.tolerances import assert_close

ANGLE = 0.6911112070083618
POSE = [[0.0, -0.6, 0.8, 3.2], [1.0, 0.0, 0.0, 0.0], [0.0, 0.8, 0.6, 2.4], [0.0, 0.0, 0.0, 1.0]]


def write_scene(folder: Path, splits: dict[str, Any]) -> Path:
    """Write the JSON of each split, and for every frame an image of its own, 20×10, unless there is one."""
    for split, content in splits.items():
        (folder / f"transforms_{split}.json").write_text(json.dumps(content))
        for index, frame in enumerate(content["frames"]):
            path = folder / f"{frame['file_path']}.png"
            path.parent.mkdir(exist_ok=True)
            if not path.exists():
                write_png(path, image(index))
    return folder


def image(seed: int, width: int = 20, height: int = 10) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, size=(height, width, 4), dtype=np.uint8)


def transforms(split: str, times: list[float], **values: Any) -> dict[str, Any]:
    frames = [
        {"file_path": f"./{split}/r_{index}", "time": t, "transform_matrix": POSE, **values}
        for index, t in enumerate(times)
    ]
    return {"camera_angle_x": ANGLE, "frames": frames}


def opengl_pixel(matrix: np.ndarray, focal: float, width: int, height: int, point: np.ndarray) -> np.ndarray:
    """Where NeRF's own ray formula, d = [(u - W/2) / f, -(v - H/2) / f, -1] rotated by the matrix, meets a point."""
    x, y, z = np.linalg.solve(matrix, [*point, 1.0])[:3]
    return np.array([width / 2 + focal * x / -z, height / 2 - focal * y / -z])


def pixel_of(camera: Camera, point: np.ndarray) -> np.ndarray:
    x, y, z = (camera.world_to_camera @ [*point, 1.0])[:3]
    return np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])


@pytest.mark.parametrize("seed", range(5))
def test_points_land_where_the_published_formula_puts_them(tmp_path: Path, seed: int):
    rng = np.random.default_rng(seed)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    matrix = np.eye(4)
    matrix[:3, :3] = rotation * np.sign(np.linalg.det(rotation))
    matrix[:3, 3] = rng.normal(size=3)
    content = transforms("train", [0.0], transform_matrix=matrix.tolist())
    camera = load_scene(write_scene(tmp_path, {"train": content})).splits["train"][0].camera
    focal = 0.5 * 20 / math.tan(0.5 * ANGLE)
    for _ in range(20):
        point = matrix[:3] @ [*rng.uniform(-1, 1, size=2), rng.uniform(-5, -1), 1]  # in front, in OpenGL axes
        assert_close(pixel_of(camera, point), opengl_pixel(matrix, focal, 20, 10, point), "pixel")


def test_a_painted_point_is_found_at_its_projection(tmp_path: Path):
    """Off centre in both directions: a flipped axis, or rows taken for columns, ends on another pixel."""
    point = np.array([0.3, 0.5, 0.4])
    column, row = np.floor(opengl_pixel(np.array(POSE), 0.5 * 20 / math.tan(0.5 * ANGLE), 20, 10, point)).astype(int)
    rgba = np.full((10, 20, 4), 255, np.uint8)
    rgba[row, column] = [250, 10, 20, 255]
    (tmp_path / "train").mkdir()
    write_png(tmp_path / "train" / "r_0.png", rgba)
    frame = load_scene(write_scene(tmp_path, {"train": transforms("train", [0.0])})).splits["train"][0]
    x, y = np.floor(pixel_of(frame.camera, point)).astype(int)
    assert (x, y) != (10, 5)
    assert frame.load_rgba()[y, x].tolist() == [250, 10, 20, 255]


def test_splits_times_and_names(tmp_path: Path):
    content = {split: transforms(split, times) for split, times in (("train", [0.2, 0.9]), ("test", [0.5, 1.0]))}
    scene = load_scene(write_scene(tmp_path, content))
    assert [frame.t for frame in scene.splits["train"]] == [0.2, 0.9]
    assert [frame.name for frame in scene.splits["test"]] == ["r_0", "r_1"]
    assert scene.splits["val"] == []
    assert scene.time_range == (0.2, 1.0)
    assert scene.scene_half_size == 1.3
    assert (scene.splits["train"][1].load_rgba() == image(1)).all()


def test_a_scene_without_times_is_static(tmp_path: Path):
    content = transforms("train", [0.0, 0.0])
    for frame in content["frames"]:
        del frame["time"]
    scene = load_scene(write_scene(tmp_path, {"train": content}))
    assert [frame.t for frame in scene.splits["train"]] == [0.0, 0.0]
    assert scene.time_range == (0.0, 0.0)


@pytest.mark.parametrize(
    ("file_path", "file"),
    [("train/r_0.png", "r_0.png"), ("./train/r_0.5", "r_0.5.png"), ("train/a", "a.jpg"), ("train/a.jpeg", "a.jpeg")],
)
def test_file_names_with_and_without_extension(tmp_path: Path, file_path: str, file: str):
    content = transforms("train", [0.0], file_path=file_path)
    (tmp_path / "train").mkdir()
    write_png(tmp_path / "train" / "whatever.png", image(0)[..., :3])
    (tmp_path / "train" / "whatever.png").rename(tmp_path / "train" / file)  # read by content, not by extension
    (tmp_path / "transforms_train.json").write_text(json.dumps(content))
    assert load_scene(tmp_path).splits["train"][0].image_path.name == file


def test_intrinsics_of_a_frame_come_before_the_angle(tmp_path: Path):
    content = transforms("train", [0.0, 0.5], fl_x=31.0, fl_y=32.0, cx=9.0, cy=4.5, w=20, h=10)
    content["frames"][1] = {**content["frames"][1], "fl_x": 41.0}
    first, second = (frame.camera for frame in load_scene(write_scene(tmp_path, {"train": content})).splits["train"])
    assert (first.fx, first.fy, first.cx, first.cy) == (31.0, 32.0, 9.0, 4.5)
    assert (second.fx, second.fy) == (41.0, 32.0)


def test_intrinsics_of_the_file_serve_all_frames(tmp_path: Path):
    content = {**transforms("train", [0.0]), "fl_x": 31.0, "cx": 9.0}
    camera = load_scene(write_scene(tmp_path, {"train": content})).splits["train"][0].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (31.0, 31.0, 9.0, 5.0)


def test_intrinsics_are_scaled_to_a_reduced_copy(tmp_path: Path):
    """The JSON speaks of 800×400, the stored image is 20×10."""
    content = transforms("train", [0.0], fl_x=1000.0, cx=380.0, w=800, h=400)
    camera = load_scene(write_scene(tmp_path, {"train": content})).splits["train"][0].camera
    assert (camera.width, camera.height) == (20, 10)
    assert (camera.fx, camera.cx, camera.cy) == (25.0, 9.5, 5.0)


def test_size_reduces_image_and_camera_together(tmp_path: Path):
    folder = write_scene(tmp_path, {"train": transforms("train", [0.0])})
    full, small = (load_scene(folder, size).splits["train"][0] for size in (None, 8))
    assert (small.camera.width, small.camera.height) == (8, 4)
    assert small.load_rgba().shape == (4, 8, 4)
    point = np.array([0.3, 0.5, 0.4])
    assert_close(pixel_of(small.camera, point), pixel_of(full.camera, point) * 0.4, "pixel")


def test_size_may_be_the_width_but_not_more(tmp_path: Path):
    folder = write_scene(tmp_path, {"train": transforms("train", [0.0])})
    assert (load_scene(folder, 20).splits["train"][0].load_rgba() == image(0)).all()
    for size in (21, 0, -3):
        with pytest.raises(InvalidInput, match="`size` must be") as caught:
            load_scene(folder, size)
        assert caught.value.field == "size"


def without(*path: Any) -> Callable[[Any], None]:
    def change(content: Any) -> None:
        for key in path[:-1]:
            content = content[key]
        del content[path[-1]]

    return change


def with_value(value: Any, *path: Any) -> Callable[[Any], None]:
    def change(content: Any) -> None:
        for key in path[:-1]:
            content = content[key]
        content[path[-1]] = value

    return change


def pose_with(value: object, row: int = 0, column: int = 0) -> list[list[Any]]:
    pose: list[list[Any]] = copy.deepcopy(POSE)
    pose[row][column] = value
    return pose


MATRIX = ("frames", 1, "transform_matrix")
WRONG = [
    (without("camera_angle_x"), "camera_angle_x", "is missing, and frames[0] has no fl_x"),
    (with_value("wide", "camera_angle_x"), "camera_angle_x", "must be in (0, π) radians, got 'wide'"),
    (with_value(math.pi, "camera_angle_x"), "camera_angle_x", "must be in (0, π)"),
    (with_value(math.nan, "camera_angle_x"), "camera_angle_x", "must be in (0, π) radians, got nan"),
    (without("frames"), "frames", "must be a list of one frame or more"),
    (with_value([], "frames"), "frames", "must be a list of one frame or more"),
    (with_value({}, "frames"), "frames", "must be a list of one frame or more"),
    (with_value(7, "frames", 1), "frames[1]", "must be a JSON object"),
    (without("frames", 1, "file_path"), "frames[1].file_path", "is missing"),
    (with_value(3, "frames", 1, "file_path"), "frames[1].file_path", "must be a file name, got 3"),
    (with_value("train/r_9", "frames", 1, "file_path"), "frames[1].file_path", "there is no such file"),
    (without("frames", 1, "time"), "frames[1].time", "is missing, though other frames have one"),
    (with_value("late", "frames", 1, "time"), "frames[1].time", "must be a finite number, got 'late'"),
    (with_value(True, "frames", 1, "time"), "frames[1].time", "must be a finite number, got True"),
    (with_value(math.inf, "frames", 1, "time"), "frames[1].time", "must be a finite number, got inf"),
    (with_value(10**400, "frames", 1, "time"), "frames[1].time", "must be a finite number, got 1000"),
    (without(*MATRIX), "frames[1].transform_matrix", "is missing"),
    (with_value("identity", *MATRIX), "frames[1].transform_matrix", "must be 4×4 numbers"),
    (with_value(POSE[:3], *MATRIX), "frames[1].transform_matrix", "must be 4×4 numbers, got shape (3, 4)"),
    (with_value([*POSE[:3], [1]], *MATRIX), "frames[1].transform_matrix", "must be 4×4 numbers"),
    (with_value(pose_with(math.nan), *MATRIX), "frames[1].transform_matrix", "must be finite"),
    (with_value(pose_with(10**400), *MATRIX), "frames[1].transform_matrix", "must be 4×4 numbers"),
    (with_value((2 * np.array(POSE)).tolist(), *MATRIX), "frames[1].transform_matrix", "without scale or mirroring"),
    (with_value(np.diag([1, 1, -1, 1]).tolist(), *MATRIX), "frames[1].transform_matrix", "without scale or mirroring"),
    (with_value(pose_with(1, 3, 0), *MATRIX), "frames[1].transform_matrix", "last row is 0 0 0 1"),
    (with_value(-5, "frames", 1, "fl_x"), "frames[1].fl_x", "above 0 pixels, got -5"),
    (with_value("long", "frames", 1, "fl_y"), "frames[1].fl_y", "must be a finite number"),
    (with_value(30, "frames", 1, "w"), "frames[1].h", "is missing"),
    (with_value(30, "w"), "frames[0].h", "is missing"),
    (with_value(0.1, "frames", 1, "k1"), "frames[1].k1", "must be 0"),
]


@pytest.mark.parametrize(("change", "field", "problem"), WRONG, ids=[f"{row[1]}-{row[2][:30]}" for row in WRONG])
def test_what_is_wrong_is_named(tmp_path: Path, change: Callable[[Any], None], field: str, problem: str):
    content = transforms("train", [0.0, 1.0])
    write_scene(tmp_path, {"train": content})
    change(content)
    (tmp_path / "transforms_train.json").write_text(json.dumps(content))
    with pytest.raises(DatasetInvalid) as caught:
        load_scene(tmp_path)
    assert caught.value.file == str(tmp_path / "transforms_train.json")
    assert caught.value.field == field
    assert str(caught.value).startswith(f"{caught.value.file}: `{field}` ")
    assert problem in str(caught.value)


def test_a_stated_size_of_another_shape_is_refused(tmp_path: Path):
    folder = write_scene(tmp_path, {"train": transforms("train", [0.0], w=20, h=20)})
    with pytest.raises(DatasetInvalid, match=r"frames\[0\].w` and h are 20×20, but the image is 20×10"):
        load_scene(folder)


@pytest.mark.parametrize("text", ["", "{", "[1, 2]", '"train"', "\x00", "[" * 100_000], ids=range(6))
@pytest.mark.parametrize("split", ["train", "test"])
def test_what_is_no_json_object_is_refused(tmp_path: Path, split: str, text: str):
    write_scene(tmp_path, {"train": transforms("train", [0.0])})
    (tmp_path / f"transforms_{split}.json").write_text(text)
    with pytest.raises(DatasetInvalid, match=rf"transforms_{split}.json: `file` (is not JSON|must hold a JSON object)"):
        load_scene(tmp_path)


def test_bytes_that_are_no_text_are_refused(tmp_path: Path):
    (tmp_path / "transforms_train.json").write_bytes(b"\xff\xfe\x00{")
    with pytest.raises(DatasetInvalid, match="is not JSON"):
        load_scene(tmp_path)


def test_folders_that_are_no_dataset(tmp_path: Path):
    with pytest.raises(DatasetInvalid, match="nowhere: `folder` does not exist"):
        load_scene(tmp_path / "nowhere")
    with pytest.raises(DatasetInvalid, match=r"is in no known layout: D-NeRF's has transforms_train\.json"):
        load_scene(tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(DatasetInvalid, match="`folder` is a file"):
        load_scene(tmp_path / "file")


def test_an_image_that_is_none_is_refused_before_training(tmp_path: Path):
    folder = write_scene(tmp_path, {"train": transforms("train", [0.0])})
    (folder / "train" / "r_0.png").write_bytes(b"not an image")
    with pytest.raises(DatasetInvalid, match=r"r_0\.png: `image` can't be read: "):
        load_scene(folder)


def test_an_image_that_is_cut_off_is_refused(tmp_path: Path):
    folder = write_scene(tmp_path, {"train": transforms("train", [0.0])})
    path = folder / "train" / "r_0.png"
    path.write_bytes(path.read_bytes()[:-60])
    frame = load_scene(folder).splits["train"][0]
    with pytest.raises(DatasetInvalid, match=r"r_0\.png: `image` can't be read: "):
        frame.load_rgba()


def test_float_images_are_refused(tmp_path: Path):
    """Their values would be scene-linear, and splats blend in the display's space."""
    (tmp_path / "train").mkdir()
    path = tmp_path / "train" / "r_0.exr"
    writer = oiio.ImageOutput.create(str(path))
    assert writer
    writer.open(str(path), oiio.ImageSpec(20, 10, 4, "float"))
    writer.write_image(np.zeros((10, 20, 4), np.float32))
    writer.close()
    content = transforms("train", [0.0], file_path="train/r_0.exr")
    (tmp_path / "transforms_train.json").write_text(json.dumps(content))
    with pytest.raises(DatasetInvalid, match="4 channels of float; 1 to 4 of 8 or 16 bits are understood"):
        load_scene(tmp_path)
