"""nerfstudio layout: cameras, splits, times, points and lenses, and what is wrong with bad files."""

import copy
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from msdgs_serve.scene import InvalidInput
from msdgs_train.datasets import DatasetInvalid, load_scene
from msdgs_train.datasets.common.images import write_png
from tests.support.lens import Lens, centroids, frame_pixels, image_of_dots
from tests.support.tolerances import assert_close, tolerance

PINHOLE = Lens()
LENSES = {
    "pinhole": PINHOLE,
    "barrel": Lens(k1=-0.2, k2=0.05, p1=0.002, p2=-0.003, k3=-0.01),
    "pincushion": Lens(k1=0.08, k2=0.02, p1=-0.001, p2=0.002),
}
OPENGL = np.diag([1.0, -1.0, -1.0])
POSE = [[0.0, -0.6, 0.8, 3.2], [1.0, 0.0, 0.0, 0.0], [0.0, 0.8, 0.6, 2.4], [0.0, 0.0, 0.0, 1.0]]


def intrinsics(lens: Lens) -> dict[str, Any]:
    values = {"fl_x": lens.fx, "fl_y": lens.fy, "cx": lens.cx, "cy": lens.cy, "w": lens.width, "h": lens.height}
    return {**values, **{key: getattr(lens, key) for key in ("k1", "k2", "p1", "p2", "k3")}}


def transforms(count: int, lens: Lens = PINHOLE, **shared: Any) -> dict[str, Any]:
    frames = [{"file_path": f"images/f_{index:02}.png", "transform_matrix": POSE} for index in range(count)]
    return {"camera_model": "OPENCV", **intrinsics(lens), **shared, "frames": frames}


def write_scene(folder: Path, content: dict[str, Any], rgba: np.ndarray | None = None) -> Path:
    (folder / "transforms.json").write_text(json.dumps(content))
    for frame in content["frames"]:
        path = folder / frame["file_path"]
        path.parent.mkdir(exist_ok=True)
        write_png(path, np.zeros((240, 320, 3), np.uint8) if rgba is None else rgba)
    return folder


def to_world(points: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """From OpenCV camera axes, by a camera-to-world matrix in OpenGL axes."""
    return points @ OPENGL @ matrix[:3, :3].T + matrix[:3, 3]


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
@pytest.mark.parametrize("of_frame", [False, True], ids=["shared", "of_frame"])
def test_points_land_where_the_published_formula_puts_them(tmp_path: Path, lens: Lens, of_frame: bool):
    rng = np.random.default_rng(0)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    matrix = np.eye(4)
    matrix[:3, :3] = rotation * np.sign(np.linalg.det(rotation))
    matrix[:3, 3] = rng.normal(size=3)
    content = transforms(1, lens)
    if of_frame:
        content = {"frames": [{**content["frames"][0], **intrinsics(lens)}]}
    content["frames"][0]["transform_matrix"] = matrix.tolist()
    frame = load_scene(write_scene(tmp_path, content)).splits["train"][0]
    points = lens.grid()
    assert_close(frame_pixels(frame, to_world(points, matrix)), lens.pixels(points), "pixel")
    assert (frame.distortion is None) == (lens == PINHOLE)


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
@pytest.mark.parametrize("size", [None, 160])
def test_dots_lie_at_their_pinhole_projections_after_loading(tmp_path: Path, lens: Lens, size: int | None):
    points, scale = lens.grid(), (size or lens.width) / lens.width
    rgba = image_of_dots(lens.pixels(points), lens.width, lens.height)
    frame = load_scene(write_scene(tmp_path, transforms(1, lens), rgba), size).splits["train"][0]
    loaded = frame.load_rgba()
    wanted = lens.pinhole().pixels(points) * scale
    assert loaded.dtype == np.uint8
    assert loaded.shape == (frame.camera.height, frame.camera.width, 4)
    assert_close(centroids(loaded, wanted), wanted, "dot_centroid")
    if lens != PINHOLE:
        assert np.abs(centroids(rgba, lens.pixels(points)) * scale - wanted).max() > 10 * tolerance("dot_centroid")


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_an_even_image_stays_even_up_to_its_corners(tmp_path: Path, lens: Lens):
    rgba = np.full((240, 320, 4), [10, 200, 30, 128], np.uint8)
    frame = load_scene(write_scene(tmp_path, transforms(1, lens), rgba)).splits["train"][0]
    assert (frame.load_rgba() == rgba).all()


def test_color_behind_transparent_pixels_does_not_bleed_into_undistorted_ones(tmp_path: Path):
    rgba = np.zeros((240, 320, 4), np.uint8)
    rgba[:] = [255, 0, 0, 0]
    rgba[100:140, 100:220] = [0, 0, 250, 255]
    frame = load_scene(write_scene(tmp_path, transforms(1, LENSES["barrel"]), rgba)).splits["train"][0]
    loaded = frame.load_rgba()
    seen = loaded[loaded[..., 3] > 0]
    assert len(np.unique(seen[:, 3])) > 2
    assert (seen[:, :3] == [0, 0, 250]).all()


def test_intrinsics_are_scaled_to_a_reduced_copy(tmp_path: Path):
    content = {**transforms(1), "fl_x": 600.0, "fl_y": 620.0, "cx": 329.0, "cy": 234.0, "w": 640, "h": 480}
    camera = load_scene(write_scene(tmp_path, content)).splits["train"][0].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (300.0, 310.0, 164.5, 117.0)


def test_the_angle_serves_where_there_is_no_focal_length(tmp_path: Path):
    content = {"camera_angle_x": 0.8, "frames": transforms(1)["frames"]}
    camera = load_scene(write_scene(tmp_path, content)).splits["train"][0].camera
    focal = 160 / math.tan(0.4)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (focal, focal, 160.0, 120.0)
    content["camera_angle_y"] = 0.7
    camera = load_scene(write_scene(tmp_path, content)).splits["train"][0].camera
    assert (camera.fx, camera.fy) == (focal, 120 / math.tan(0.35))


def test_every_8th_frame_by_name_is_for_testing(tmp_path: Path):
    content = transforms(17)
    content["frames"].reverse()
    splits = load_scene(write_scene(tmp_path, content)).splits
    assert [frame.name for frame in splits["test"]] == ["images_f_00", "images_f_08", "images_f_16"]
    assert len(splits["train"]) == 14
    assert splits["val"] == []


def test_lists_of_file_names_make_the_splits(tmp_path: Path):
    lists: dict[str, Any] = {
        "train_filenames": ["./images/f_02.png", "images/f_00.png"],
        "test_filenames": ["images/f_01.png"],
    }
    scene = load_scene(write_scene(tmp_path, transforms(4, **lists)))
    assert [frame.image_path.name for frame in scene.splits["train"]] == ["f_00.png", "f_02.png"]
    assert [frame.image_path.name for frame in scene.splits["test"]] == ["f_01.png"]
    assert scene.splits["val"] == []


def test_times_are_kept_even_outside_0_and_1(tmp_path: Path):
    content = transforms(3)
    for frame, time in zip(content["frames"], [12.5, -3, 40], strict=True):
        frame["time"] = time
    scene = load_scene(write_scene(tmp_path, content))
    assert [frame.t for frame in scene.splits["test"] + scene.splits["train"]] == [12.5, -3.0, 40.0]
    assert scene.time_range == (-3.0, 40.0)


def test_a_scene_without_times_is_static(tmp_path: Path):
    scene = load_scene(write_scene(tmp_path, transforms(3)))
    assert [frame.t for frame in scene.splits["train"]] == [0.0, 0.0]
    assert scene.time_range == (0.0, 0.0)
    assert scene.points is None
    assert scene.point_colors is None


def test_masks_are_passed_over(tmp_path: Path):
    content = transforms(1)
    content["frames"][0]["mask_path"] = "masks/none.png"
    assert (load_scene(write_scene(tmp_path, content)).splits["train"][0].load_rgba()[..., 3] == 255).all()


HEADER = ["ply", "format {} 1.0", "comment c", "element vertex 2", "property float x", "property float y"]
HEADER += ["property double z", "property uchar red", "property uchar green", "property uchar blue"]
HEADER += ["element face 1", "property list uchar int vertex_index", "end_header", ""]


def ply(encoding: str) -> bytes:
    header = "\n".join(HEADER).format(encoding).encode()
    rows = [(1.0, -2.0, 0.5, 255, 0, 51), (0.25, 0.0, -4.0, 0, 102, 255)]
    if encoding == "ascii":
        return header + "\n".join(" ".join(map(str, row)) for row in rows).encode() + b"\n3 0 1 0\n"
    order = "<" if encoding == "binary_little_endian" else ">"
    kinds = [(name, order + kind) for name, kind in zip("xyzrgb", ("f4", "f4", "f8", "u1", "u1", "u1"), strict=True)]
    return header + np.array(rows, kinds).tobytes() + b"\3rest of the faces, whose size is no whole number of rows"


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_sparse_points_come_with_their_colors_in_the_axes_of_the_poses(tmp_path: Path, encoding: str):
    (tmp_path / "points.ply").write_bytes(ply(encoding))
    content = transforms(2, ply_file_path="points.ply", applied_transform=[[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]])
    scene = load_scene(write_scene(tmp_path, content))
    assert scene.points is not None
    assert scene.point_colors is not None
    assert scene.points.tolist() == [[1.0, -2.0, 0.5], [0.25, 0.0, -4.0]]
    assert_close(scene.point_colors, [[1.0, 0.0, 0.2], [0.0, 0.4, 1.0]], "sh_basis")


def without_color(content: bytes) -> bytes:
    return content.replace(b"uchar red", b"uchar other")


def without_points(content: bytes) -> bytes:
    return content.replace(b"element vertex 2", b"element vertex 0")


def test_points_may_lack_colors_and_files_points(tmp_path: Path):
    folder = write_scene(tmp_path, transforms(2, ply_file_path="points.ply"))
    (tmp_path / "points.ply").write_bytes(without_color(ply("ascii")))
    scene = load_scene(folder)
    assert scene.points is not None
    assert scene.point_colors is None
    for encoding in ("ascii", "binary_little_endian"):
        (tmp_path / "points.ply").write_bytes(without_points(ply(encoding)))
        assert load_scene(folder).points is None


BAD_PLY = [
    (lambda content: content[:40], "`file` is not a PLY file"),
    (lambda content: b"", "`file` is not a PLY file"),
    (lambda content: content[:-24], "`vertex` is cut off: the header says 2, the file holds 1"),
    (lambda content: content.replace(b"ascii", b"latin"), "`format` must be one of ascii, .* got 'latin'"),
    (lambda content: content.replace(b"vertex 2", b"vertex -2"), "`element` must be vertex and a number"),
    (lambda content: content.replace(b"element vertex", b"element edge"), "`element` must be vertex"),
    (lambda content: content.replace(b"float y", b"float x"), "`property` names must differ"),
    (lambda content: content.replace(b"float y", b"float v"), "`property y` is missing"),
    (lambda content: content.replace(b"float y", b"list uchar int y"), "`property` of a vertex must be a number"),
    (lambda content: content.replace(b"0.25", b"nan"), r"`vertex\[1\]` must be finite"),
    (lambda content: content.replace(b"0.25", b"0,25"), "`vertex` must be 6 numbers"),
    (lambda content: content.replace(b" 51", b" -51"), "`property red` green and blue must be"),
]


@pytest.mark.parametrize(("change", "message"), BAD_PLY, ids=[row[1][:30] + str(i) for i, row in enumerate(BAD_PLY)])
def test_bad_point_files_are_refused(tmp_path: Path, change: Callable[[bytes], bytes], message: str):
    (tmp_path / "points.ply").write_bytes(change(ply("ascii")))
    with pytest.raises(DatasetInvalid, match=rf"points\.ply: {message}"):
        load_scene(write_scene(tmp_path, transforms(2, ply_file_path="points.ply")))


def test_a_binary_point_file_that_is_cut_off_is_refused(tmp_path: Path):
    (tmp_path / "points.ply").write_bytes(ply("binary_little_endian")[:-80])
    with pytest.raises(DatasetInvalid, match="`vertex` is cut off"):
        load_scene(write_scene(tmp_path, transforms(2, ply_file_path="points.ply")))


def with_value(value: Any, *path: Any) -> Callable[[Any], None]:
    def change(content: Any) -> None:
        for key in path[:-1]:
            content = content[key]
        content[path[-1]] = value

    return change


def without(*path: Any) -> Callable[[Any], None]:
    def change(content: Any) -> None:
        for key in path[:-1]:
            content = content[key]
        del content[path[-1]]

    return change


def pose_with(value: object) -> list[list[Any]]:
    pose: list[list[Any]] = copy.deepcopy(POSE)
    pose[1][2] = value
    return pose


WRONG = [
    (without("frames"), "frames", "must be a list of one frame or more"),
    (without("frames", 1, "file_path"), "frames[1].file_path", "is missing"),
    (with_value("images/f_77.png", "frames", 1, "file_path"), "frames[1].file_path", "there is no such file"),
    (with_value(0.5, "frames", 0, "time"), "frames[1].time", "is missing, though other frames have one"),
    (without("frames", 1, "transform_matrix"), "frames[1].transform_matrix", "is missing"),
    (with_value(pose_with(math.nan), "frames", 1, "transform_matrix"), "frames[1].transform_matrix", "must be finite"),
    (with_value(POSE[:3], "frames", 1, "transform_matrix"), "frames[1].transform_matrix", "must be 4×4 numbers"),
    (without("fl_x"), "camera_angle_x", "is missing, and frames[0] has no fl_x"),
    (with_value(math.nan, "cx"), "frames[0].cx", "must be a finite number, got nan"),
    (with_value(-1, "frames", 1, "fl_y"), "frames[1].fl_y", "above 0 pixels, got -1"),
    (with_value(100, "w"), "frames[0].w", "and h are 100×240, but the image is 320×240"),
    (without("h"), "frames[0].h", "is missing"),
    (with_value("a", "k1"), "frames[0].k1", "must be a finite number, got 'a'"),
    (with_value(-2.0, "k1"), "frames[0].k1", "map two points to one: undistort the images"),
    (with_value(0.1, "frames", 1, "k4"), "frames[1].k4", "must be 0"),
    (with_value("OPENCV_FISHEYE", "camera_model"), "frames[0].camera_model", "got 'OPENCV_FISHEYE'"),
    (with_value("FULL_OPENCV", "frames", 1, "camera_model"), "frames[1].camera_model", "got 'FULL_OPENCV'"),
    (with_value(7, "camera_model"), "frames[0].camera_model", "must be one of PINHOLE, "),
    (with_value(True, "is_fisheye"), "frames[0].is_fisheye", "must be false"),
    (with_value(["images/f_09.png"], "train_filenames"), "train_filenames[0]", "is the file_path of no frame"),
    (with_value("images/f_00.png", "val_filenames"), "val_filenames", "must be a list of file names"),
    (with_value([["a"]], "train_filenames"), "train_filenames", "must be a list of file names"),
    (with_value(["images/f_00.png"], "test_filenames"), "train_filenames", "must name one frame or more"),
    (with_value("none.ply", "ply_file_path"), "ply_file_path", "names 'none.ply', but there is no such file"),
    (with_value(1, "ply_file_path"), "ply_file_path", "names 1, but there is no such file"),
]


@pytest.mark.parametrize(("change", "field", "problem"), WRONG, ids=[f"{row[1]}-{row[2][:30]}" for row in WRONG])
def test_what_is_wrong_is_named(tmp_path: Path, change: Callable[[Any], None], field: str, problem: str):
    content = transforms(2)
    write_scene(tmp_path, content)
    change(content)
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(DatasetInvalid) as caught:
        load_scene(tmp_path)
    assert caught.value.file == str(tmp_path / "transforms.json")
    assert caught.value.field == field
    assert problem in str(caught.value)


@pytest.mark.parametrize("text", ["", "[1]", "\x00"])
def test_what_is_no_json_object_is_refused(tmp_path: Path, text: str):
    (tmp_path / "transforms.json").write_text(text)
    with pytest.raises(DatasetInvalid, match=r"transforms\.json: `file` (is not JSON|must hold a JSON object)"):
        load_scene(tmp_path)


def test_size_may_not_be_more_than_the_width(tmp_path: Path):
    folder = write_scene(tmp_path, transforms(1))
    for size in (0, 321):
        with pytest.raises(InvalidInput, match="`size` must be"):
            load_scene(folder, size)
