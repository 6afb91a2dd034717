"""Errors of datasets name the file, the field, the expected and the given value."""

import json
import math
import re
import shutil
import struct
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from msdgs_train.datasets import DatasetInvalid, load_scene
from msdgs_train.datasets.common.images import write_png
from tests.train.datasets import layouts
from tests.train.datasets.jpegs import jpeg
from tests.train.datasets.layouts import flat

Change = Callable[[Any], Any]
WRITE: dict[str, Callable[[Path], Path]] = {
    "dnerf": layouts.write_dnerf,
    "nerfstudio": layouts.write_nerfstudio,
    "neu3d": layouts.write_neu3d,
    "hypernerf": layouts.write_hypernerf,
    "neu3d-videos": layouts.write_neu3d_videos,
    "colmap": partial(layouts.write_colmap, ending="txt"),
    "colmap-bin": layouts.write_colmap,
}
DNERF, NERFSTUDIO, POSES = "dnerf/transforms_train.json", "nerfstudio/transforms.json", "neu3d/poses_bounds.npy"
CAMERA = "hypernerf/camera/000002.json"
HYPERNERF = ("hypernerf/metadata.json", "hypernerf/scene.json", CAMERA)
JSONS = (DNERF, NERFSTUDIO, "dnerf/transforms_test.json", *HYPERNERF)
MISSING = object()
MATRIX = np.array(layouts.opengl_matrix(layouts.pose(1)))


def put(value: Any, *path: Any) -> Change:
    """A change of JSON or of an array: another value at some path, or none."""

    def change(content: Any) -> Any:
        at = content
        for key in path[:-1]:
            at = at[key]
        if value is MISSING:
            del at[path[-1]]
        else:
            at[path[-1]] = value
        return content

    return change


def swap(old: str, new: str) -> Change:
    """Of a text."""
    return lambda text: text.replace(old, new)


def matrix(value: Any, *path: int) -> Change:
    """Of the second frame of a `transforms` file."""
    return put(put(value, *path)(MATRIX.tolist()) if path else value, "frames", 1, "transform_matrix")


FRAME, ANGLE, PLY = "frames[1]", "frames[0].camera_angle_x", "ply_file_path"
WHOLE, FOLDED = "PINHOLE 320 240 300.0 310.0 164.5 117.0", "SIMPLE_RADIAL 320 240 300.0 164.5 117.0 -2"
TURN, MIRROR, NOT_FINITE = f"{FRAME}.transform_matrix", np.diag([1, 1, -1, 1]), (math.nan, math.inf, 10**400)
OF_TRANSFORMS = [
    *((put(value, "frames"), "frames", "must be a list of one frame or more") for value in (MISSING, [], {})),
    (put(7, "frames", 1), FRAME, "must be a JSON object"),
    (put(MISSING, "frames", 1, "file_path"), f"{FRAME}.file_path", "is missing"),
    (put(3, "frames", 1, "file_path"), f"{FRAME}.file_path", "must be a file name, got 3"),
    (put("train/r_9", "frames", 1, "file_path"), f"{FRAME}.file_path", "there is no such file"),
    (matrix(MISSING), f"{FRAME}.transform_matrix", "is missing"),
    *((matrix(value), TURN, "must be 4×4 finite numbers") for value in ("identity", MATRIX[:3].tolist())),
    *((matrix(value, 1, 2), TURN, "must be 4×4 finite numbers") for value in NOT_FINITE),
    (matrix([1], 3), TURN, "must be 4×4 finite numbers"),
    *((matrix(value.tolist()), TURN, "without scale or mirroring") for value in (2 * MATRIX, MIRROR)),
    (matrix(1, 3, 0), TURN, "last row is 0 0 0 1"),
    *((put(-5, "frames", 1, key), f"{FRAME}.{key}", "above 0 pixels, got -5") for key in ("fl_x", "fl_y")),
    (put("long", "frames", 1, "fl_y"), f"{FRAME}.fl_y", "must be a finite number, got 'long'"),
    (put(math.nan, "cx"), "frames[0].cx", "must be a finite number, got nan"),
]
WRONG = [
    *((file, *row) for file in (DNERF, NERFSTUDIO) for row in OF_TRANSFORMS),
    (DNERF, put(MISSING, "camera_angle_x"), ANGLE, "is missing, and so is fl_x"),
    *(
        (DNERF, put(value, "camera_angle_x"), ANGLE, f"must be a finite number, got {value!r}")
        for value in ("a", math.nan)
    ),
    (DNERF, put(math.pi, "camera_angle_x"), ANGLE, "must be in (0, π)"),
    (DNERF, put(MISSING, "frames", 1, "time"), f"{FRAME}.time", "is missing, though other frames have one"),
    *(
        (DNERF, put(v, "frames", 1, "time"), f"{FRAME}.time", "must be a finite number, got")
        for v in ("a", True, *NOT_FINITE)
    ),
    (DNERF, put(30, "frames", 1, "w"), f"{FRAME}.h", "is missing"),
    (
        DNERF,
        lambda content: put(20, "frames", 1, "w")(put(20, "frames", 1, "h")(content)),
        f"{FRAME}.w",
        "and h are 20×20, but the image is 320×240",
    ),
    (DNERF, put(30, "w"), "frames[0].h", "is missing"),
    (NERFSTUDIO, put(0.5, "frames", 0, "time"), f"{FRAME}.time", "is missing, though other frames have one"),
    (
        NERFSTUDIO,
        lambda content: put(MISSING, "fl_x")(put(MISSING, "fl_y")(content)),
        ANGLE,
        "is missing, and so is fl_x",
    ),
    (NERFSTUDIO, put(100, "w"), "frames[0].w", "and h are 100×240, but the image is 320×240"),
    (NERFSTUDIO, put(MISSING, "h"), "frames[0].h", "is missing"),
    (NERFSTUDIO, put("a", "k1"), "frames[0].k1", "must be a finite number, got 'a'"),
    (NERFSTUDIO, put(-2.0, "k1"), "frames[0].k1", "maps two points to one: undistort the images"),
    (NERFSTUDIO, put(0.1, "frames", 1, "k4"), f"{FRAME}.k4", "must be off or 0, got 0.1"),
    (NERFSTUDIO, put("OPENCV_FISHEYE", "camera_model"), "frames[0].camera_model", "got 'OPENCV_FISHEYE'"),
    (NERFSTUDIO, put("FULL_OPENCV", "frames", 1, "camera_model"), f"{FRAME}.camera_model", "got 'FULL_OPENCV'"),
    (NERFSTUDIO, put(7, "camera_model"), "frames[0].camera_model", "must be one of PINHOLE, "),
    (NERFSTUDIO, put(True, "is_fisheye"), "frames[0].is_fisheye", "must be off or 0, got True: undistort"),
    (NERFSTUDIO, put(["images/f_09.png"], "train_filenames"), "train_filenames[0]", "is the file_path of no frame"),
    *(
        (NERFSTUDIO, put(value, "val_filenames"), "val_filenames", "must be a list of names")
        for value in ("a", [["a"]])
    ),
    (NERFSTUDIO, put(["images/f_00.png"], "test_filenames"), "train_filenames", "must name one frame or more"),
    (NERFSTUDIO, put("none.ply", PLY), PLY, "names 'none.ply', but there is no such file"),
    (NERFSTUDIO, put(1, PLY), PLY, "must be a file name, got 1"),
    (POSES, lambda poses: poses[:, :15], "file", "must hold real numbers in shape M×17"),
    (POSES, lambda poses: poses.astype(str), "file", "must hold real numbers in shape M×17"),
    (POSES, lambda poses: poses[:1], "rows", "are 1, but there are 2 cameras: cam00 cam01"),
    (POSES, put(math.nan, (1, 3)), "row 1", "must be finite"),
    (POSES, put(math.inf, (0, 16)), "row 0", "must be finite"),
    (POSES, put(-1.0, (1, 15)), "row 1", "must end in 0 < near < far, got -1 and 9"),
    (POSES, put(0.1, (1, 16)), "row 1", "must end in 0 < near < far, got 0.5 and 0.1"),
    (POSES, put(1000.0, (1, 4)), "row 1", "states a size of 320×1000, but the image is 320×240"),
    (POSES, put(-240.0, (1, 4)), "row 1", "states a size of 320×-240"),
    (POSES, put(0.0, (1, 14)), "row 1", "above 0 pixels, got 0"),
    (POSES, put(5.0, (1, 0)), "row 1", "without scale or mirroring"),
    ("hypernerf/dataset.json", put(MISSING, "train_ids"), "train_ids", "is missing"),
    ("hypernerf/dataset.json", put([], "train_ids"), "train_ids", "must name one frame or more"),
    *(
        ("hypernerf/dataset.json", put(value, "val_ids"), "val_ids", "must be a list of names")
        for value in ("a", [[1]])
    ),
    ("hypernerf/metadata.json", put(MISSING, "000002"), "000002", "is missing"),
    ("hypernerf/metadata.json", put(7, "000002"), "000002", "must be a JSON object"),
    ("hypernerf/metadata.json", put({"camera_id": 1}, "000002"), "000002.time_id", "is missing, and so is warp_id"),
    ("hypernerf/metadata.json", put("late", "000002", "time_id"), "000002.time_id", "a finite number, got 'late'"),
    ("hypernerf/metadata.json", put({"warp_id": -1}, "000002"), "000002.warp_id", "must be 0 or more, got -1"),
    ("hypernerf/scene.json", put(MISSING, "scale"), "scale", "is missing"),
    ("hypernerf/scene.json", put(0, "scale"), "scale", "must be above 0, got 0"),
    ("hypernerf/scene.json", put([0.0, 1.0], "center"), "center", "must be 3 finite numbers, got [0.0, 1.0]"),
    ("hypernerf/scene.json", put([0.0, math.inf, 0.0], "center"), "center", "must be 3 finite numbers"),
    (CAMERA, put(MISSING, "orientation"), "orientation", "is missing"),
    *((CAMERA, put(row, "orientation", 2), "orientation", "must be 3×3 finite") for row in ([0, 0], [0, 0, math.nan])),
    (CAMERA, put(np.diag([1, 1, -1]).tolist(), "orientation"), "orientation", "without scale or mirroring"),
    *((CAMERA, put([1, 2, value], "position"), "position", "must be 3 finite numbers") for value in NOT_FINITE),
    (CAMERA, put([True, False, True], "position"), "position", "must be 3 finite numbers"),
    (CAMERA, put("long", "focal_length"), "focal_length", "must be a finite number, got 'long'"),
    (CAMERA, put(-3.0, "focal_length"), "focal_length", "above 0 pixels, got -3"),
    (CAMERA, put(0.0, "pixel_aspect_ratio"), "pixel_aspect_ratio", "above 0 pixels, got 0"),
    (CAMERA, put([1.0], "principal_point"), "principal_point", "must be 2 finite numbers"),
    (CAMERA, put(0.5, "skew"), "skew", "must be 0, got 0.5"),
    (CAMERA, put(MISSING, "radial_distortion"), "radial_distortion", "is missing"),
    (CAMERA, put([0.0, 0.0], "radial_distortion"), "radial_distortion", "must be 3 finite numbers"),
    (CAMERA, put([-9.0, 0.0, 0.0], "radial_distortion"), "radial_distortion", "maps two points to one"),
    (CAMERA, put(MISSING, "tangential_distortion"), "tangential_distortion", "is missing"),
    (CAMERA, put(math.nan, "tangential_distortion", 1), "tangential_distortion", "must be 2 finite numbers"),
    (CAMERA, put([240, 320], "image_size"), "image_size", "is 240×320, but the image is 320×240"),
    ("colmap/cameras.txt", swap("PINHOLE", "FOV"), "line 3", "is FOV, but only"),
    ("colmap/cameras.txt", swap("310.0", "nan"), "line 3.fy", "must be finite, got nan"),
    ("colmap/cameras.txt", swap("310.0", "-1"), "cameras[7]", "is not a valid camera: `camera.fy` must be finite"),
    ("colmap/cameras.txt", swap(" 117.0", ""), "line 3", "must have 4 parameters for PINHOLE, got 3"),
    ("colmap/cameras.txt", swap("320", "wide"), "line 3", "must be CAMERA_ID MODEL WIDTH HEIGHT"),
    ("colmap/cameras.txt", swap(WHOLE, "PINHOLE"), "line 3", "must be CAMERA_ID MODEL"),
    ("colmap/cameras.txt", swap(WHOLE, FOLDED), "cameras[7]", "maps two points to one"),
    ("colmap/images.txt", swap(" 7 a_0.png", " 8 a_0.png"), "images[a_0.png]", "has camera 8, which is not in cameras"),
    ("colmap/images.txt", swap("\n1 ", "\n1 zero"), "line 3", "must be IMAGE_ID QW"),
    ("colmap/images.txt", swap(" a_0.png", ""), "line 3", "must be IMAGE_ID QW"),
    ("colmap/images.txt", lambda text: "# none", "images", "must be one or more"),
    ("colmap/points3D.txt", swap("-1.25", "nan"), "points3D[0]", "must be finite"),
    ("colmap/points3D.txt", swap("-1.25", "far"), "line 2", "must be POINT3D_ID X Y Z R G B"),
    ("colmap/points3D.txt", swap("1 -2.0", "-2.0\n"), "line 3", "must be POINT3D_ID X Y Z R G B"),
]


def changed(folder: Path, file: str, change: Change) -> Path:
    """A dataset of the layout that `file` begins with, with this file changed."""
    layout, _, name = file.partition("/")
    WRITE[layout](folder)
    path = folder / "sparse" / "0" / name if layout == "colmap" else folder / name
    if path.suffix == ".npy":
        np.save(path, change(np.load(path)))
    elif path.suffix == ".json":
        path.write_text(json.dumps(change(json.loads(path.read_text()))))
    else:
        path.write_text(change(path.read_text()))
    return path


@pytest.mark.parametrize(
    ("file", "change", "field", "problem"), WRONG, ids=[f"{row[0]}-{row[2]}-{row[3][:30]}" for row in WRONG]
)
def test_invalid_values_are_named(tmp_path: Path, file: str, change: Change, field: str, problem: str):
    path = changed(tmp_path, file, change)
    with pytest.raises(DatasetInvalid) as caught:
        load_scene(tmp_path)
    assert (caught.value.file, caught.value.field) == (str(path), field)
    assert str(caught.value).startswith(f"{path}: `{field}` ")
    assert problem in str(caught.value)


@pytest.mark.parametrize(
    "text", [b"", b"{", b"[1, 2]", b'"train"', b"\x00", b"[" * 100_000, b"\xff\xfe\0{"], ids=range(7)
)
@pytest.mark.parametrize("file", JSONS)
def test_what_is_no_json_object_is_refused(tmp_path: Path, file: str, text: bytes):
    layout, _, name = file.partition("/")
    (WRITE[layout](tmp_path) / name).write_bytes(text)
    with pytest.raises(DatasetInvalid, match=r"`file` (is not JSON|must hold a JSON object)") as caught:
        load_scene(tmp_path)
    assert caught.value.file == str(tmp_path / name)


Edit = Callable[[Path], Any]


def remove(*names: str) -> Edit:
    def edit(folder: Path) -> None:
        for path in map(folder.joinpath, names):
            shutil.rmtree(path) if path.is_dir() else path.unlink()

    return edit


def write(name: str, content: bytes) -> Edit:
    return lambda folder: (folder / name).write_bytes(content)


def points(rows: list[list[float]]) -> Edit:
    return lambda folder: np.save(folder / "points.npy", rows)


def smaller(name: str, folder: Path) -> None:
    write_png(folder / name, flat(0, layouts.SMALL))


def shorter(folder: Path) -> None:
    layouts.write_video(folder / "cam01.mp4", 4 * [flat(0, layouts.SMALL)])


def other_shape(folder: Path) -> None:
    write_png(load_scene(folder).splits["train"][0].image_path, flat(0, layouts.CENTERED)[:, :200].copy())


def resized(size: tuple[int, int], folder: Path) -> None:
    for path in images_of(folder):
        write_png(path, np.zeros((*size[::-1], 3), np.uint8))


def turned_by_exif(folder: Path) -> None:
    """JPEG files, whatever their names are."""
    exif = Image.Exif()
    exif[0x0112] = 6
    for path in images_of(folder):
        path.write_bytes(jpeg(np.zeros((320, 240, 3), np.uint8), exif=exif))


def images_of(folder: Path) -> list[Path]:
    return [frame.image_path for frames in load_scene(folder).splits.values() for frame in frames]


def camera_model(number: int) -> Edit:
    def edit(folder: Path) -> None:
        file = folder / "sparse" / "0" / "cameras.bin"
        content = file.read_bytes()
        file.write_bytes(content[:12] + struct.pack("<i", number) + content[16:])

    return edit


SPOILED: list[tuple[str, Edit, str]] = [
    ("neu3d", write("poses_bounds.npy", b""), r"poses_bounds\.npy: `file` is not a NumPy array"),
    ("neu3d", write("poses_bounds.npy", b"not numpy"), r"poses_bounds\.npy: `file` is not a NumPy array"),
    ("neu3d", write("poses_bounds.npy", b"PK\x03\x04"), r"poses_bounds\.npy: `file` is not a NumPy array"),
    ("neu3d", lambda folder: (folder / "cam02").mkdir(), r"cam02: `frames` are missing: there is no cam02\.mp4"),
    ("neu3d", partial(smaller, "cam01/0001.png"), r"0001\.png: `image` is 32×24, but .*0000\.png is 320×240"),
    ("neu3d", remove("cam01"), "`cameras` must be two or more, got 1"),
    ("neu3d", remove("cam00", "cam01"), "is in no known layout"),
    ("neu3d-videos", write("cam01.mp4", b"not a video"), r"cam01\.mp4: `video` can't be read: "),
    ("neu3d-videos", shorter, r"cam01\.mp4: `frames` are 4, but .*cam00\.mp4 has 7"),
    ("hypernerf", points([[0.0, 1.0, 2.0], [0.0, math.nan, 2.0]]), r"points\.npy: `row 1` must be finite"),
    ("hypernerf", points([[0.0, 1.0]]), r"points\.npy: `file` must hold real numbers in shape M×3"),
    ("hypernerf", remove("rgb/1x/000003.png"), r"000003\.png: `image` can't be read"),
    ("neu3d", remove("poses_bounds.npy"), r"is in no known layout: .* Neu3D's has poses_bounds\.npy and cam0\*, "),
    (
        "nerfstudio",
        turned_by_exif,
        "but the image is 240×320, which its EXIF orientation 6 turns: store the images upr",
    ),
    ("hypernerf", turned_by_exif, "but the image is 240×320, which its EXIF orientation 6 turns: store the images upr"),
    (
        "colmap",
        turned_by_exif,
        "but the image is 240×320, which its EXIF orientation 6 turns: store the images upright",
    ),
    *((layout, partial(resized, (320, 241)), "320×241, no copy") for layout in ("nerfstudio", "hypernerf", "colmap")),
    *((layout, partial(resized, (32, 25)), "32×25, no copy") for layout in ("nerfstudio", "hypernerf", "colmap")),
    ("neu3d", partial(resized, (320, 241)), "but .*image is 320×241|320×241, but"),
    ("hypernerf", remove("metadata.json"), r"metadata\.json: `file` can't be read"),
    ("hypernerf", remove("scene.json"), r"scene\.json: `file` can't be read"),
    ("hypernerf", remove("camera/000002.json"), r"000002\.json: `file` can't be read"),
    *((layout, other_shape, "320×240, but the image is 200×240") for layout in ("nerfstudio", "hypernerf", "colmap")),
    ("hypernerf", remove("rgb"), "rgb: `folder` must have the images in 1x, 2x or the like"),
    ("colmap", remove("sparse/0/images.txt"), r"images\.txt: `file` is missing beside cameras\.txt"),
    ("colmap", remove("sparse/0/points3D.txt"), r"points3D\.txt: `file` is missing beside cameras\.txt"),
    ("colmap", write("sparse/0/images.txt", b"\xff\xfe\0"), r"images\.txt: `file` is not text"),
    ("colmap-bin", remove("sparse/0/images.bin"), r"images\.bin: `file` is missing beside cameras\.bin"),
    ("colmap-bin", remove("sparse/0/points3D.bin"), r"points3D\.bin: `file` is missing beside cameras\.bin"),
    ("colmap-bin", remove("sparse/0"), r"sparse: `cameras` is missing: there is no cameras\.bin or cameras\.txt"),
    ("colmap-bin", remove("images/a_1.png"), r"images\.bin: `images\[a_1\.png\]` is in the model, but there is no"),
    ("colmap-bin", remove("images"), r"images\.bin: `images\[a_0\.png\]` is in the model, but there is no file"),
    ("colmap-bin", camera_model(5), r"cameras\.bin: `cameras\[0\]` is .*OPENCV_FISHEYE, but only SIMPLE_PINHOLE, "),
    ("colmap-bin", camera_model(6), r"cameras\.bin: `cameras\[0\]` is .*FULL_OPENCV, but only SIMPLE_PINHOLE, "),
    ("colmap-bin", camera_model(99), r"cameras\.bin: `cameras\[0\]` is .*model 99, but only SIMPLE_PINHOLE, "),
    ("colmap-bin", camera_model(-1), r"cameras\.bin: `cameras\[0\]` is .*-1, but only SIMPLE_PINHOLE, "),
]


@pytest.mark.parametrize(("layout", "edit", "message"), SPOILED, ids=[f"{row[0]}-{row[2][:30]}" for row in SPOILED])
def test_missing_files_and_invalid_types_are_named(tmp_path: Path, layout: str, edit: Edit, message: str):
    edit(WRITE[layout](tmp_path))
    with pytest.raises(DatasetInvalid, match=message):
        load_scene(tmp_path)


def test_folders_that_are_no_dataset(tmp_path: Path):
    with pytest.raises(DatasetInvalid, match="nowhere: `folder` does not exist"):
        load_scene(tmp_path / "nowhere")
    with pytest.raises(DatasetInvalid, match=r"is in no known layout: D-NeRF's has transforms_train\.json"):
        load_scene(tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(DatasetInvalid, match="`folder` is a file"):
        load_scene(tmp_path / "file")


@pytest.mark.parametrize("layout", sorted(WRITE.keys() - {"neu3d-videos"}))
def test_an_invalid_or_truncated_image_is_refused(tmp_path: Path, layout: str):
    """An invalid header is found before training, missing pixels when they are read."""
    folder = WRITE[layout](tmp_path)
    path = load_scene(folder).splits["train"][0].image_path
    noise = np.random.default_rng(0).integers(0, 256, size=(240, 320, 3), dtype=np.uint8)
    write_png(path, noise)
    frame = load_scene(folder).splits["train"][0]
    path.write_bytes(path.read_bytes()[:-60])
    message = rf"{re.escape(path.name)}: `image` can't be read: "
    with pytest.raises(DatasetInvalid, match=message):
        frame.load_rgba()
    path.write_bytes(b"not an image")
    with pytest.raises(DatasetInvalid, match=message):
        load_scene(folder)
