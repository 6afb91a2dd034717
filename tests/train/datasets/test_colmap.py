"""COLMAP's layout, binary and text: cameras, times and points, and what is wrong with bad files."""

import re
import shutil
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from msdgs_serve.scene import InvalidInput
from msdgs_train.datasets import DatasetInvalid, load_scene
from msdgs_train.datasets.common.images import write_png
from tests.support.lens import Lens, centroids, frame_pixels, image_of_dots
from tests.support.tolerances import assert_close

BLACK = np.zeros((240, 320, 3), np.uint8)
SPLIT_OF_9 = {"train": [f"v_{index:02}" for index in range(1, 8)], "val": [], "test": ["v_00", "v_08"]}


class Kind(NamedTuple):
    """A camera model: its number in binary files, its parameters in their order, and the lens that they are."""

    number: int
    parameters: tuple[float, ...]
    lens: Lens


KINDS = {
    "SIMPLE_PINHOLE": Kind(0, (300, 164.5, 117), Lens(fy=300)),
    "PINHOLE": Kind(1, (300, 310, 164.5, 117), Lens()),
    "SIMPLE_RADIAL": Kind(2, (300, 164.5, 117, -0.15), Lens(fy=300, k1=-0.15)),
    "RADIAL": Kind(3, (300, 164.5, 117, 0.07, 0.03), Lens(fy=300, k1=0.07, k2=0.03)),
    "OPENCV": Kind(4, (300, 310, 164.5, 117, -0.2, 0.05, 0.002, -0.003), Lens(k1=-0.2, k2=0.05, p1=0.002, p2=-0.003)),
}
POINTS = [((0.5, -1.25, 3.0), (255, 0, 51)), ((-2.0, 0.0, 1.5), (0, 102, 255))]


class Pose(NamedTuple):
    """x_camera = R(q) · x + t; q is wxyz and needn't be of length 1."""

    q: tuple[float, float, float, float] = (0.9, 0.1, -0.3, 0.2)
    t: tuple[float, float, float] = (0.3, -0.2, 4.0)

    def to_world(self, points: np.ndarray) -> np.ndarray:
        """Of [N, 3] points in camera axes, by turning with the quaternion itself: x = q* · (y - t) · q."""
        w, v = self.q[0], -np.array(self.q[1:])
        length = np.linalg.norm(self.q)
        w, v = w / length, v / length
        moved = points - np.array(self.t)
        return moved + 2 * np.cross(v, np.cross(v, moved) + w * moved)


def write_model(
    folder: Path, ending: str, names: list[str], model: str = "PINHOLE", pose: Pose | None = None, place: str = "0"
) -> Path:
    """A model with an image of black for every image that has none; the second image has seen nothing."""
    sparse = folder / "sparse" / place
    sparse.mkdir(parents=True, exist_ok=True)
    write = {"bin": write_binary, "txt": write_text}[ending]
    write(sparse, names, model, KINDS[model], pose or Pose())
    for name in names:
        path = folder / "images" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists():
            write_png(path, BLACK)
    return folder


def write_binary(sparse: Path, names: list[str], model: str, kind: Kind, pose: Pose) -> None:
    parameters = struct.pack(f"<{len(kind.parameters)}d", *kind.parameters)
    (sparse / "cameras.bin").write_bytes(struct.pack("<QiiQQ", 1, 7, kind.number, 320, 240) + parameters)
    images = struct.pack("<Q", len(names))
    for index, name in enumerate(names):
        seen = 0 if index == 1 else 2
        images += struct.pack("<i7di", index + 1, *pose.q, *pose.t, 7) + name.encode() + b"\0"
        images += struct.pack("<Q", seen) + struct.pack("<ddq", 10.5, 20.5, -1) * seen
    (sparse / "images.bin").write_bytes(images)
    points = struct.pack("<Q", len(POINTS))
    for index, (position, color) in enumerate(POINTS):
        points += struct.pack("<Q3d3BdQ", index, *position, *color, 0.7, index) + struct.pack("<ii", 1, 0) * index
    (sparse / "points3D.bin").write_bytes(points)


def write_text(sparse: Path, names: list[str], model: str, kind: Kind, pose: Pose) -> None:
    parameters = " ".join(map(str, kind.parameters))
    (sparse / "cameras.txt").write_text(f"# Camera list\n\n7 {model} 320 240 {parameters}\n")
    lines = ["# Image list with two lines of data per image:", "#   POINTS2D[] as (X, Y, POINT3D_ID)"]
    for index, name in enumerate(names):
        lines += [" ".join(map(str, [index + 1, *pose.q, *pose.t, 7, name])), "" if index == 1 else "10.5 20.5 -1"]
    (sparse / "images.txt").write_text("\n".join(lines) + "\n")
    rows = [[index, *position, *color, 0.7, 1, 0] for index, (position, color) in enumerate(POINTS)]
    (sparse / "points3D.txt").write_text("# points\n" + "\n".join(" ".join(map(str, row)) for row in rows))


both = pytest.mark.parametrize("ending", ["bin", "txt"])


@both
@pytest.mark.parametrize("model", KINDS)
def test_points_land_where_the_published_formula_puts_them(tmp_path: Path, ending: str, model: str):
    folder = write_model(tmp_path, ending, ["a_0.png", "a_1.png", "a_2.png"], model)
    lens, points = KINDS[model].lens, KINDS[model].lens.grid()
    for frame in load_scene(folder).splits["train"]:
        assert_close(frame_pixels(frame, Pose().to_world(points)), lens.pixels(points), "pixel")
        assert (frame.distortion is None) == ("PINHOLE" in model)


@pytest.mark.parametrize("model", KINDS)
def test_dots_lie_at_their_pinhole_projections_after_loading(tmp_path: Path, model: str):
    lens, points = KINDS[model].lens, KINDS[model].lens.grid()
    (tmp_path / "images").mkdir()
    write_png(tmp_path / "images" / "0.png", image_of_dots(lens.pixels(points), 320, 240))
    frame = load_scene(write_model(tmp_path, "bin", ["0.png"], model)).splits["train"][0]
    wanted = frame_pixels(replace(frame, distortion=None), Pose().to_world(points))
    assert_close(centroids(frame.load_rgba(), wanted), wanted, "dot_centroid")


@both
@pytest.mark.parametrize("place", ["0", "."])
def test_points_colors_and_size_of_the_scene(tmp_path: Path, ending: str, place: str):
    scene = load_scene(write_model(tmp_path, ending, ["0.png"], place=place))
    assert scene.points is not None
    assert scene.point_colors is not None
    assert scene.points.tolist() == [list(position) for position, _ in POINTS]
    assert_close(scene.point_colors, [[1.0, 0.0, 0.2], [0.0, 0.4, 1.0]], "sh_basis")
    assert 2.0 < scene.scene_half_size <= 3.0


@both
def test_times_are_the_last_numbers_of_the_names_and_every_8th_image_is_for_testing(tmp_path: Path, ending: str):
    names = [f"v_{index:02}.png" for index in (8, 2, 3, 0, 1, 4, 5, 6, 7)]
    scene = load_scene(write_model(tmp_path, ending, names))
    assert {split: [frame.name for frame in frames] for split, frames in scene.splits.items()} == SPLIT_OF_9
    assert scene.time_range == (0.0, 1.0)
    assert [frame.t for frame in scene.splits["train"]] == [index / 8 for index in range(1, 8)]


def test_times_are_linear_in_the_numbers_found(tmp_path: Path):
    names = ["cam2/take 3 frame 100.png", "cam1/take 3 frame 110.png", "cam1/take 3 frame 140.jpg.png"]
    scene = load_scene(write_model(tmp_path, "txt", names))
    times = {frame.name: frame.t for frames in scene.splits.values() for frame in frames}
    assert times == {
        "cam1_take 3 frame 110": 0.25,
        "cam1_take 3 frame 140.jpg": 1.0,
        "cam2_take 3 frame 100": 0.0,
    }


@both
def test_a_pattern_may_find_the_time_elsewhere(tmp_path: Path, ending: str):
    folder = write_model(tmp_path, ending, ["t1.5/a_7.png", "t2.5/a_7.png", "t5.5/a_7.png"])
    times = [frame.t for frames in load_scene(folder, None, r"t([\d.]+)/").splits.values() for frame in frames]
    assert times == [0.25, 1.0, 0.0]


def test_static_scenes(tmp_path: Path):
    """By choice, or because there is but one number."""
    for scene in (
        load_scene(write_model(tmp_path / "a", "bin", ["x.png", "y.png"]), time_pattern=None),
        load_scene(write_model(tmp_path / "b", "bin", ["c1/0005.png", "c2/0005.png"])),
    ):
        assert scene.time_range == (0.0, 0.0)
        assert len(scene.splits["train"]) == 1


def test_names_without_a_time_are_named(tmp_path: Path):
    folder = write_model(tmp_path, "txt", ["a_1.png", "cam07/front.png"])
    with pytest.raises(DatasetInvalid, match=r"images\[cam07/front\.png\]\.name` has no time: .*; choose another"):
        load_scene(folder)
    with pytest.raises(DatasetInvalid, match=r"images\[a_1\.png\]\.name` has no time"):
        load_scene(folder, time_pattern="(a)")
    for pattern in ("(", "a", "(a)(b)"):
        with pytest.raises(InvalidInput, match="`time_pattern` must be a regular expression"):
            load_scene(folder, time_pattern=pattern)


def test_intrinsics_are_scaled_to_reduced_copies(tmp_path: Path):
    (tmp_path / "images").mkdir()
    write_png(tmp_path / "images" / "0.png", BLACK[::2, ::2].copy())
    folder = write_model(tmp_path, "bin", ["0.png"])
    for size in (None, 80):
        camera = load_scene(folder, size).splits["train"][0].camera
        scale = (size or 160) / 320
        assert (camera.width, camera.height) == (320 * scale, 240 * scale)
        assert (camera.fx, camera.fy) == (300 * scale, 310 * scale)
        assert (camera.cx, camera.cy) == (164.5 * scale, 117 * scale)


def test_without_points_the_cameras_say_how_large_the_scene_is(tmp_path: Path):
    folder = write_model(tmp_path, "txt", ["0.png"])
    (folder / "sparse" / "0" / "points3D.txt").write_text("# none\n")
    scene = load_scene(folder)
    assert scene.points is None
    assert scene.scene_half_size > 0


@both
@pytest.mark.parametrize("part", ["images", "points3D"])
def test_a_missing_file_is_named(tmp_path: Path, ending: str, part: str):
    folder = write_model(tmp_path, ending, ["0.png"])
    (folder / "sparse" / "0" / f"{part}.{ending}").unlink()
    with pytest.raises(DatasetInvalid, match=rf"{part}\.{ending}: `file` is missing beside cameras\.{ending}"):
        load_scene(folder)


def test_a_missing_model_and_missing_images_are_named(tmp_path: Path):
    (tmp_path / "sparse").mkdir()
    with pytest.raises(DatasetInvalid, match=r"sparse: `cameras` is missing: there is no cameras\.bin or cameras\.txt"):
        load_scene(tmp_path)
    folder = write_model(tmp_path, "bin", ["0.png", "1.png"])
    (folder / "images" / "1.png").unlink()
    with pytest.raises(DatasetInvalid, match=r"images\.bin: `images\[1\.png\]` is in the model, but there is no file"):
        load_scene(folder)
    shutil.rmtree(folder / "images")
    with pytest.raises(DatasetInvalid, match=r"images\.bin: `images\[0\.png\]` is in the model, but there is no file"):
        load_scene(folder)


@pytest.mark.parametrize("part", ["cameras", "images", "points3D"])
def test_a_binary_file_that_is_cut_off_is_refused_wherever_the_cut_is(tmp_path: Path, part: str):
    folder = write_model(tmp_path, "bin", ["0.png", "1.png"])
    file = folder / "sparse" / "0" / f"{part}.bin"
    content = file.read_bytes()
    for length in range(len(content)):
        file.write_bytes(content[:length])
        with pytest.raises(DatasetInvalid, match=rf"{part}\.bin: `{part}.*is cut off: the file ends after {length} b"):
            load_scene(folder)


@both
@pytest.mark.parametrize(
    ("pose", "message"),
    [
        (Pose(q=(0.9, float("nan"), 0.1, 0.2)), "qvec` must be finite, got .*nan"),
        (Pose(t=(float("inf"), 0.0, 0.0)), "tvec` must be finite, got .*inf"),
        (Pose(q=(0.0, 0.0, 0.0, 0.0)), "qvec` is not a rotation"),
    ],
    ids=["nan", "inf", "zero"],
)
def test_poses_that_are_none_are_refused(tmp_path: Path, ending: str, pose: Pose, message: str):
    folder = write_model(tmp_path, ending, ["0.png"], pose=pose)
    with pytest.raises(DatasetInvalid, match=rf"images\.{ending}: `images\[0\.png\]\.{message}"):
        load_scene(folder)


@pytest.mark.parametrize(("number", "name"), [(5, "OPENCV_FISHEYE"), (6, "FULL_OPENCV"), (99, "model 99"), (-1, "-1")])
def test_other_camera_models_are_refused_by_name(tmp_path: Path, number: int, name: str):
    folder = write_model(tmp_path, "bin", ["0.png"])
    file = folder / "sparse" / "0" / "cameras.bin"
    content = file.read_bytes()
    file.write_bytes(content[:12] + struct.pack("<i", number) + content[16:])
    with pytest.raises(DatasetInvalid, match=rf"cameras\.bin: `cameras\[0\]` is .*{name}, and only SIMPLE_PINHOLE, "):
        load_scene(folder)


Change = Callable[[str], str]


def swapped(old: str, new: str) -> Change:
    return lambda text: text.replace(old, new)


WRONG = [
    ("cameras", swapped("PINHOLE", "FOV"), "`line 3` is FOV, and only"),
    ("cameras", swapped("310", "nan"), r"`line 3\.fy` must be finite, got nan"),
    ("cameras", swapped("310", "-1"), r"`cameras\[7\]` is not a valid camera: `camera\.fy` must be finite and above 0"),
    ("cameras", swapped(" 117", ""), "`line 3` must have 4 parameters for PINHOLE, got 3"),
    ("cameras", swapped("320", "wide"), "`line 3` must be CAMERA_ID MODEL WIDTH HEIGHT"),
    ("cameras", swapped(" 320 240 300 310 164.5 117", ""), "`line 3` must be CAMERA_ID MODEL"),
    ("images", swapped(" 7 0.png", " 8 0.png"), r"`images\[0\.png\]` has camera 8, which is not in cameras\.txt"),
    ("images", swapped("0.9", "zero"), "`line 3` must be IMAGE_ID QW"),
    ("images", swapped(" 0.png", ""), "`line 3` must be IMAGE_ID QW"),
    ("images", lambda text: "# none", "`images` must be one or more"),
    ("points3D", swapped("-1.25", "nan"), r"`points3D\[0\]` must be finite"),
    ("points3D", swapped("-1.25", "far"), "`line 2` must be POINT3D_ID X Y Z R G B"),
    ("points3D", swapped("1 -2.0", "-2.0\n"), "`line 3` must be POINT3D_ID X Y Z R G B"),
]


@pytest.mark.parametrize(("part", "change", "message"), WRONG, ids=[f"{row[0]}-{i}" for i, row in enumerate(WRONG)])
def test_what_is_wrong_in_text_files_is_named(tmp_path: Path, part: str, change: Change, message: str):
    folder = write_model(tmp_path, "txt", ["0.png"])
    file = folder / "sparse" / "0" / f"{part}.txt"
    file.write_text(change(file.read_text()))
    with pytest.raises(DatasetInvalid, match=rf"{part}\.txt: {message}"):
        load_scene(folder)


def test_what_is_no_text_is_refused(tmp_path: Path):
    folder = write_model(tmp_path, "txt", ["0.png"])
    (folder / "sparse" / "0" / "images.txt").write_bytes(b"\xff\xfe\0")
    with pytest.raises(DatasetInvalid, match=r"images\.txt: `file` is not text"):
        load_scene(folder)


def test_images_of_another_shape_are_refused(tmp_path: Path):
    folder = write_model(tmp_path, "bin", ["0.png"])
    write_png(folder / "images" / "0.png", BLACK[:, :200].copy())
    with pytest.raises(DatasetInvalid, match=re.escape("has a camera for 320×240, but the image is 200×240")):
        load_scene(folder)


def test_a_lens_that_shows_places_twice_is_refused(tmp_path: Path):
    folder = write_model(tmp_path, "txt", ["0.png"], "SIMPLE_RADIAL")
    file = folder / "sparse" / "0" / "cameras.txt"
    file.write_text(file.read_text().replace("-0.15", "-2"))
    with pytest.raises(DatasetInvalid, match=r"`cameras\[7\]` is Distortion\(k1=-2.* maps two points to one"):
        load_scene(folder)
