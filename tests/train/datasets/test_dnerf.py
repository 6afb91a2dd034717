"""Images in D-NeRF layout: splits, times, names and intrinsics."""

import json
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from msdgs_serve.scene import Camera, InvalidInput
from msdgs_train.datasets import DatasetInvalid, load_scene
from msdgs_train.datasets.common.images import write_png
from tests.train.datasets.layouts import CENTERED, dnerf_json, flat, write_dnerf


def camera_with(folder: Path, frame: dict[str, float], **shared: float) -> Camera:
    """Of the second frame, where the file says `shared` for all and the frame something of its own."""
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


def test_every_nth_training_image_is_held_out(tmp_path: Path):
    times = tuple(i / 10 for i in range(10))
    folder = write_dnerf(tmp_path, splits={split: dnerf_json(split, times) for split in ("train", "test")})
    splits = load_scene(folder, llffhold=4).splits
    held_out = {split: [frame.t for frame in splits[split]] for split in ("test", "val", "train")}
    assert held_out == {"test": [0.0, 0.4, 0.8], "val": [0.2, 0.6], "train": [0.1, 0.3, 0.5, 0.7, 0.9]}
    assert {frame.image_path.parent.name for frames in splits.values() for frame in frames} == {"train"}
    single = write_dnerf(folder, splits={"train": dnerf_json("train", (0.5,)), "test": dnerf_json("test", (0.5,))})
    with pytest.raises(InvalidInput, match="`llffhold` must be fewer than the 1 training images, got 4"):
        load_scene(single, llffhold=4)


def test_a_scene_without_times_is_static(tmp_path: Path):
    content = dnerf_json()
    for frame in content["frames"]:
        del frame["time"]
    scene = load_scene(write_dnerf(tmp_path, splits={"train": content}))
    assert [frame.t for frame in scene.splits["train"]] == [0.0, 0.0]
    assert scene.time_range == (0.0, 0.0)


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
    camera = camera_with(tmp_path, {"fl_x": 41.0}, fl_x=31.0, fl_y=32.0, cx=9.0, cy=4.5, w=320, h=240)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (41.0, 32.0, 9.0, 4.5)
    camera = camera_with(tmp_path, {}, fl_x=31.0, cx=9.0)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (31.0, 31.0, 9.0, 120.0)


def test_a_stated_size_of_another_shape_is_refused(tmp_path: Path):
    with pytest.raises(DatasetInvalid, match=r"frames\[1\].w` and h are 20×20, but the image is 320×240"):
        camera_with(tmp_path, {"w": 20, "h": 20})


def test_float_images_are_refused(tmp_path: Path):
    """Their values would be scene-linear, and splats blend in the display's space."""
    content = dnerf_json(times=(0.0,))
    path = write_dnerf(tmp_path, splits={"train": content}) / "train" / "r_0.exr"
    writer = oiio.ImageOutput.create(str(path))
    assert writer
    writer.open(str(path), oiio.ImageSpec(20, 10, 4, "float"))
    writer.write_image(np.zeros((10, 20, 4), np.float32))
    writer.close()
    content["frames"][0]["file_path"] = "train/r_0.exr"
    write_png(tmp_path / "train" / "r_0.exr.png", flat(0, CENTERED))  # the name as it is comes first
    with pytest.raises(DatasetInvalid, match="4 channels of float; 1 to 4 of 8 or 16 bits are supported"):
        load_scene(write_dnerf(tmp_path, splits={"train": content}))
