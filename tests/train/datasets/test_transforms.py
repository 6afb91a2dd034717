"""D-NeRF's and nerfstudio's JSON: splits, times, names, intrinsics, images that can't be used, and points."""

import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from msdgs_serve.scene import Camera, InvalidInput
from msdgs_train.datasets import DatasetInvalid, load_scene
from msdgs_train.datasets.common.images import write_png
from tests.support.tolerances import assert_close
from tests.train.datasets.layouts import (
    CENTERED,
    LENSES,
    dnerf_json,
    flat,
    nerfstudio_json,
    points_of,
    write_dnerf,
    write_nerfstudio,
)


def camera_with(folder: Path, frame: dict[str, float], **shared: float) -> Camera:
    """The camera of the second frame, given values for all frames, `shared`, and for this one."""
    content = {**dnerf_json(), **shared}
    content["frames"][1].update(frame)
    return load_scene(write_dnerf(folder, splits={"train": content})).splits["train"][1].camera


def test_splits_times_and_names(tmp_path: Path):
    content = {split: dnerf_json(split, times) for split, times in (("train", (0.2, 0.9)), ("test", (0.5, 1.0)))}
    scene = load_scene(write_dnerf(tmp_path, splits=content))
    assert [frame.t for frame in scene.splits["train"]] == [0.2, 0.9]
    assert [frame.name for frame in scene.splits["test"]] == ["r_0", "r_1"]
    assert scene.splits["val"] == []
    assert scene.time_range == (0.2, 1.0)
    assert scene.scene_half_size == 1.3
    assert (scene.splits["train"][1].load_rgba()[..., :3] == 1).all()


def test_images_of_one_name_in_two_folders_keep_the_folders_name(tmp_path: Path):
    content = dnerf_json("train", (0.2, 0.9))
    for camera, frame in enumerate(content["frames"]):
        frame["file_path"] = f"./train/cam{camera}/0001"
    folder = write_dnerf(tmp_path, splits={"train": content})
    assert [frame.name for frame in load_scene(folder).splits["train"]] == ["cam0_0001", "cam1_0001"]


def test_every_nth_training_image_is_held_out(tmp_path: Path):
    times = tuple(i / 10 for i in range(10))
    folder = write_dnerf(tmp_path, splits={split: dnerf_json(split, times) for split in ("train", "test")})
    splits = load_scene(folder, llffhold=4).splits
    held_out = {split: [frame.t for frame in splits[split]] for split in ("test", "val", "train")}
    assert held_out == {"test": [0.0, 0.4, 0.8], "val": [0.2, 0.6], "train": [0.1, 0.3, 0.5, 0.7, 0.9]}
    assert {frame.image_path.parent.name for frames in splits.values() for frame in frames} == {"train"}
    single = write_dnerf(folder, splits={"train": dnerf_json("train", (0.5,)), "test": dnerf_json("test", (0.5,))})
    with pytest.raises(InvalidInput, match=r"`llffhold` must be 0 with so few images \(1\), got 4"):
        load_scene(single, llffhold=4)


@pytest.mark.parametrize(
    ("file_path", "file"),
    [("train/r_0.png", "r_0.png"), ("./train/r_0.5", "r_0.5.png"), ("train/a", "a.jpg"), ("train/a.jpeg", "a.jpeg")],
)
def test_file_names_with_and_without_extension(tmp_path: Path, file_path: str, file: str):
    content = dnerf_json(times=(0.0,))
    folder = write_dnerf(tmp_path, splits={"train": content})
    (folder / "train" / "r_0.png").rename(folder / "train" / file)  # read by content, not by extension
    content["frames"][0]["file_path"] = file_path
    (folder / "transforms_train.json").write_text(json.dumps(content))
    assert load_scene(folder).splits["train"][0].image_path.name == file


def test_intrinsics_of_a_frame_come_before_those_of_the_file_and_these_before_the_angle(tmp_path: Path):
    camera = camera_with(tmp_path, {"fl_x": 41.0}, fl_x=31.0, fl_y=32.0, cx=150.0, cy=114.5, w=320, h=240)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (41.0, 32.0, 150.0, 114.5)
    camera = camera_with(tmp_path, {}, fl_x=31.0, cx=150.0)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (31.0, 31.0, 150.0, 120.0)


def test_float_images_are_refused(tmp_path: Path):
    """They would be scene-linear, but splats are blended in display space."""
    content = dnerf_json(times=(0.0,))
    path = write_dnerf(tmp_path, splits={"train": content}) / "train" / "r_0.exr"
    writer = oiio.ImageOutput.create(str(path))
    assert writer
    writer.open(str(path), oiio.ImageSpec(20, 10, 4, "float"))
    writer.write_image(np.zeros((10, 20, 4), np.float32))
    writer.close()
    content["frames"][0]["file_path"] = "train/r_0.exr"
    write_png(tmp_path / "train" / "r_0.exr.png", flat(0, CENTERED))  # the exact name is tried first
    with pytest.raises(DatasetInvalid, match="4 channels of float; 1 to 4 of 8 or 16 bits are supported: convert it"):
        load_scene(write_dnerf(tmp_path, splits={"train": content}))


def test_color_behind_transparent_pixels_does_not_bleed_into_undistorted_ones(tmp_path: Path):
    rgba = np.zeros((240, 320, 4), np.uint8)
    rgba[:] = [255, 0, 0, 0]
    rgba[100:140, 100:220] = [0, 0, 250, 255]
    frame = load_scene(write_nerfstudio(tmp_path, LENSES["barrel"])).splits["train"][0]
    write_png(frame.image_path, rgba)
    loaded = frame.load_rgba()
    seen = loaded[loaded[..., 3] > 0]
    assert len(np.unique(seen[:, 3])) > 2
    assert (seen[:, :3] == [0, 0, 250]).all()


def test_the_angle_is_used_without_a_focal_length(tmp_path: Path):
    content = {"camera_angle_x": 0.8, "frames": nerfstudio_json(1)["frames"]}
    camera = load_scene(write_nerfstudio(tmp_path, content=content)).splits["train"][0].camera
    focal = 160 / math.tan(0.4)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (focal, focal, 160.0, 120.0)
    content["camera_angle_y"] = 0.7
    camera = load_scene(write_nerfstudio(tmp_path, content=content)).splits["train"][0].camera
    assert (camera.fx, camera.fy) == (focal, 120 / math.tan(0.35))


def test_every_8th_frame_by_name_is_for_testing(tmp_path: Path):
    content = nerfstudio_json(17)
    content["frames"].reverse()
    splits = load_scene(write_nerfstudio(tmp_path, content=content)).splits
    assert [frame.name for frame in splits["test"]] == ["images_f_00", "images_f_08", "images_f_16"]
    assert len(splits["train"]) == 14
    assert splits["val"] == []
    splits = load_scene(tmp_path, llffhold=6).splits
    assert [frame.name[-2:] for frame in splits["test"]] == ["00", "06", "12"]
    assert sum(map(len, splits.values())) == 17


def test_lists_of_file_names_make_the_splits(tmp_path: Path):
    names = {"train": ["./images/f_02.png", "images/f_00.png"], "test": ["images/f_01.png"]}
    content = {**nerfstudio_json(4), **{f"{split}_filenames": listed for split, listed in names.items()}}
    splits = load_scene(write_nerfstudio(tmp_path, content=content)).splits
    found = {split: [frame.image_path.name for frame in frames] for split, frames in splits.items()}
    assert found == {"train": ["f_00.png", "f_02.png"], "val": [], "test": ["f_01.png"]}


def test_times_outside_0_and_1_are_scaled(tmp_path: Path):
    content = nerfstudio_json(3)
    for frame, time in zip(content["frames"], [12.5, -3, 28], strict=True):
        frame["time"] = time
    scene = load_scene(write_nerfstudio(tmp_path, content=content))
    assert [frame.t for frame in scene.splits["test"] + scene.splits["train"]] == [0.5, 0.0, 1.0]
    assert scene.time_range == (0.0, 1.0)
    assert [frame.t for frame in load_scene(tmp_path, llffhold=3).splits["train"]] == [1.0]
    assert (scene.splits["train"][0].load_rgba()[..., 3] == 255).all()


HEADER = ["ply", "format {} 1.0", "comment Γ, not ASCII", "element vertex 2", "property float x", "property float y"]
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
    content = nerfstudio_json(ply_file_path="points.ply", applied_transform=np.eye(4)[[1, 0, 2]].tolist())
    points, colors = points_of(load_scene(write_nerfstudio(tmp_path, content=content)))
    assert points == [[1.0, -2.0, 0.5], [0.25, 0.0, -4.0]]
    assert_close(colors, [[1.0, 0.0, 0.2], [0.0, 0.4, 1.0]], "sh_basis")


@pytest.mark.parametrize(
    ("kind", "color", "expected"),
    [
        ("int", "200 100 50", (200 / 255, 100 / 255, 50 / 255)),
        ("ushort", "255 0 51", (1.0, 0.0, 0.2)),
        ("ushort", "65535 0 13107", (1.0, 0.0, 0.2)),
        ("uint", "4294967295 0 858993459", (1.0, 0.0, 0.2)),
        ("double", "0.5 0.25 1", (0.5, 0.25, 1.0)),
    ],
)
def test_colors_of_wide_types_are_read_by_their_values(tmp_path: Path, kind: str, color: str, expected: tuple):
    header = "\n".join([*HEADER[:10], "end_header", ""]).format("ascii").replace("uchar", kind)
    (tmp_path / "points.ply").write_text(f"{header}0 0 1 {color}\n1 0 1 {color}\n")
    _, colors = points_of(load_scene(write_nerfstudio(tmp_path, content=nerfstudio_json(ply_file_path="points.ply"))))
    assert_close(colors, [expected, expected], "sh_basis")


def without_color(content: bytes) -> bytes:
    return content.replace(b"uchar red", b"uchar other")


def without_points(content: bytes) -> bytes:
    header = content.partition(b"end_header\n")[0].replace(b"vertex 2", b"vertex 0").replace(b"face 1", b"face 0")
    return header + b"end_header\n"


def test_points_may_lack_colors_and_files_points(tmp_path: Path):
    folder = write_nerfstudio(tmp_path, content=nerfstudio_json(ply_file_path="points.ply"))
    (tmp_path / "points.ply").write_bytes(without_color(ply("ascii")))
    scene = load_scene(folder)
    assert scene.points is not None
    assert scene.point_colors is None
    for encoding in ("ascii", "binary_little_endian"):
        (tmp_path / "points.ply").write_bytes(without_points(ply(encoding)))
        assert load_scene(folder).points is None


BAD_PLY = [
    (lambda content: content[:40], "`file` isn't a whole PLY file"),
    (lambda content: b"", "`file` isn't a whole PLY file"),
    (lambda content: ply("binary_little_endian")[:-80], r"`file` is cut off: 2 rows of `vertex` needs"),
    (lambda content: content[:-24], "`file` has a row of `vertex` that isn't 6 numbers"),
    (lambda content: content[:-40], "`file` is cut off: 2 rows of `vertex` needs 23 bytes, there are 14"),
    (lambda content: content.replace(b"ascii", b"latin"), "`file` has no header line `format` with one of ascii, "),
    (lambda content: content.replace(b"vertex 2", b"vertex -2"), "`file` has a header line that can't be read: "),
    (lambda content: content.replace(b"element vertex", b"element edge"), "`file` has no element `vertex`, only edge"),
    (lambda content: content.replace(b"float y", b"float x"), "`file` has the property `x` of `vertex` twice"),
    (lambda content: content.replace(b"float y", b"float v"), "`property y` is missing or not a number"),
    (lambda content: content.replace(b"float y", b"list uchar int y"), "`file` has lists in `vertex`"),
    (lambda content: content.replace(b"0.25", b"nan"), r"`vertex\[1\]` must be finite"),
    (lambda content: content.replace(b"0.25", b"0,25"), "`file` has a row of `vertex` that isn't 6 numbers"),
    (lambda content: content.replace(b" 51", b" -51"), "`file` has a number that `blue` of `vertex` can't hold"),
    (
        lambda content: content.replace(b"uchar red", b"float red").replace(b"255 0", b"nan 0"),
        "`property red` green and",
    ),
]


@pytest.mark.parametrize(("change", "message"), BAD_PLY, ids=[row[1][:30] + str(i) for i, row in enumerate(BAD_PLY)])
def test_bad_point_files_are_refused(tmp_path: Path, change: Callable[[bytes], bytes], message: str):
    (tmp_path / "points.ply").write_bytes(change(ply("ascii")))
    with pytest.raises(DatasetInvalid, match=rf"points\.ply: {message}"):
        load_scene(write_nerfstudio(tmp_path, content=nerfstudio_json(ply_file_path="points.ply")))
