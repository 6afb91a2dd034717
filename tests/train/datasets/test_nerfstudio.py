"""nerfstudio layout: angles, splits, times and points."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from msdgs_train.datasets import DatasetInvalid, load_scene
from msdgs_train.datasets.common.images import write_png
from tests.support.tolerances import assert_close
from tests.train.datasets.layouts import LENSES, nerfstudio_json, write_nerfstudio


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


def test_the_angle_serves_where_there_is_no_focal_length(tmp_path: Path):
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


def test_lists_of_file_names_make_the_splits(tmp_path: Path):
    lists: dict[str, Any] = {
        "train_filenames": ["./images/f_02.png", "images/f_00.png"],
        "test_filenames": ["images/f_01.png"],
    }
    scene = load_scene(write_nerfstudio(tmp_path, content=nerfstudio_json(4, **lists)))
    assert [frame.image_path.name for frame in scene.splits["train"]] == ["f_00.png", "f_02.png"]
    assert [frame.image_path.name for frame in scene.splits["test"]] == ["f_01.png"]
    assert scene.splits["val"] == []


def test_times_are_kept_even_outside_0_and_1(tmp_path: Path):
    content = nerfstudio_json(3)
    for frame, time in zip(content["frames"], [12.5, -3, 40], strict=True):
        frame["time"] = time
    scene = load_scene(write_nerfstudio(tmp_path, content=content))
    assert [frame.t for frame in scene.splits["test"] + scene.splits["train"]] == [12.5, -3.0, 40.0]
    assert scene.time_range == (-3.0, 40.0)


def test_a_scene_without_times_is_static(tmp_path: Path):
    scene = load_scene(write_nerfstudio(tmp_path, content=nerfstudio_json(3)))
    assert [frame.t for frame in scene.splits["train"]] == [0.0, 0.0]
    assert scene.time_range == (0.0, 0.0)
    assert scene.points is None
    assert scene.point_colors is None


def test_masks_are_passed_over(tmp_path: Path):
    content = nerfstudio_json(1)
    content["frames"][0]["mask_path"] = "masks/none.png"
    assert (load_scene(write_nerfstudio(tmp_path, content=content)).splits["train"][0].load_rgba()[..., 3] == 255).all()


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
    content = nerfstudio_json(ply_file_path="points.ply", applied_transform=np.eye(4)[[1, 0, 2]].tolist())
    scene = load_scene(write_nerfstudio(tmp_path, content=content))
    assert scene.points is not None
    assert scene.point_colors is not None
    assert scene.points.tolist() == [[1.0, -2.0, 0.5], [0.25, 0.0, -4.0]]
    assert_close(scene.point_colors, [[1.0, 0.0, 0.2], [0.0, 0.4, 1.0]], "sh_basis")


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
    (lambda content: content[:40], "`file` is not a complete PLY"),
    (lambda content: b"", "`file` is not a complete PLY"),
    (lambda content: content[:-24], "`file` is not a complete PLY file: element 'vertex': "),
    (lambda content: content.replace(b"ascii", b"latin"), "`file` is not a complete PLY file: line 2: "),
    (lambda content: content.replace(b"vertex 2", b"vertex -2"), "`file` is not a complete PLY file: negative"),
    (lambda content: content.replace(b"element vertex", b"element edge"), "`element` vertex is missing"),
    (
        lambda content: content.replace(b"float y", b"float x"),
        "`file` is not .* two properties with same name",
    ),
    (lambda content: content.replace(b"float y", b"float v"), "`property y` is missing or not a number"),
    (lambda content: content.replace(b"float y", b"list uchar int y"), "`file` is not a complete PLY file: "),
    (lambda content: content.replace(b"0.25", b"nan"), r"`vertex\[1\]` must be finite"),
    (lambda content: content.replace(b"0.25", b"0,25"), "`file` is not a complete PLY file: element 'vertex': "),
    (lambda content: content.replace(b" 51", b" -51"), "`file` is not a complete PLY file: "),
]


@pytest.mark.parametrize(("change", "message"), BAD_PLY, ids=[row[1][:30] + str(i) for i, row in enumerate(BAD_PLY)])
def test_bad_point_files_are_refused(tmp_path: Path, change: Callable[[bytes], bytes], message: str):
    (tmp_path / "points.ply").write_bytes(change(ply("ascii")))
    with pytest.raises(DatasetInvalid, match=rf"points\.ply: {message}"):
        load_scene(write_nerfstudio(tmp_path, content=nerfstudio_json(ply_file_path="points.ply")))


def test_a_binary_point_file_that_is_cut_off_is_refused(tmp_path: Path):
    (tmp_path / "points.ply").write_bytes(ply("binary_little_endian")[:-80])
    with pytest.raises(DatasetInvalid, match=r"`file` is not .*element 'vertex'.*early end-of-file"):
        load_scene(write_nerfstudio(tmp_path, content=nerfstudio_json(ply_file_path="points.ply")))
