"""A dataset is recognized wherever its folder is, and an edited one is told by the part that differs."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from msdgs_train.datasets import DatasetInvalid, Frame, SceneData, load_scene
from msdgs_train.datasets.common.images import read_rgba, write_png
from msdgs_train.datasets.identity import differences, identity
from tests.support.training_scene import write_scene


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("identity") / "scene")


@pytest.fixture
def copy(original: Path, tmp_path: Path) -> Path:
    return shutil.copytree(original, tmp_path / "elsewhere" / "of another name", copy_function=shutil.copyfile)


def differing(one: Path, other: Path) -> list[str]:
    return differences(identity(load_scene(one)), identity(load_scene(other)))


def edited(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    file = folder / "transforms_train.json"
    contents = json.loads(file.read_text())
    change(contents)
    file.write_text(json.dumps(contents, indent=4))


def test_a_copy_is_the_same(original: Path, copy: Path):
    edited(copy, lambda contents: None)  # the same numbers in other bytes
    (copy / "notes.txt").write_text("a file that isn't read")
    assert not differing(original, copy)


def flip_a_bit(folder: Path) -> None:
    file = folder / "train" / "r_003.png"
    pixels = read_rgba(file)
    pixels[11, 5] ^= 1
    write_png(file, pixels)


def encode_again(folder: Path) -> None:
    file = folder / "train" / "r_006.png"
    write_png(file, read_rgba(file))  # with alpha


def exchange(folder: Path) -> None:
    one, other, aside = (folder / "train" / name for name in ("r_001.png", "r_002.png", "aside.png"))
    one.rename(aside)
    other.rename(one)
    aside.rename(other)


def move_a_camera(folder: Path) -> None:
    edited(folder, lambda contents: contents["frames"][2]["transform_matrix"][0].__setitem__(3, 1e-4))


def zoom(folder: Path) -> None:
    edited(folder, lambda contents: contents.update(camera_angle_x=contents["camera_angle_x"] + 1e-4))


def change_a_time(folder: Path) -> None:
    edited(folder, lambda contents: contents["frames"][2].update(time=0.123))


def rename_an_image(folder: Path) -> None:
    (folder / "train" / "r_000.png").rename(folder / "train" / "other.png")
    edited(folder, lambda contents: contents["frames"][0].update(file_path="./train/other"))


def order_by_time_backwards(folder: Path) -> None:
    edited(folder, lambda contents: contents["frames"].reverse())


def leave_out_an_image(folder: Path) -> None:
    edited(folder, lambda contents: contents["frames"].pop())


def hide_a_pixel(folder: Path) -> None:
    pixels = np.full_like(read_rgba(folder / "train" / "r_003.png"), 255)
    pixels[11, 5, :3] = 0
    write_png(folder / "mask.png", pixels)
    edited(folder, lambda contents: contents["frames"][3].update(mask_path="mask.png"))


@pytest.mark.parametrize(
    ("edit", "told"),
    [
        (flip_a_bit, {"contents of images"}),
        (encode_again, {"contents of images"}),
        (exchange, {"contents of images"}),
        (move_a_camera, {"cameras"}),
        (zoom, {"cameras"}),
        (change_a_time, {"times"}),
        (rename_an_image, {"names of images or splits"}),
        (hide_a_pixel, {"masks"}),
        (order_by_time_backwards, {"names of images or splits", "times", "cameras", "contents of images"}),
        (
            leave_out_an_image,
            {"number of images", "names of images or splits", "times", "cameras", "contents of images"},
        ),
    ],
)
def test_an_edited_one_is_told_by_what_differs(
    original: Path, copy: Path, edit: Callable[[Path], None], told: set[str]
):
    edit(copy)
    assert set(differing(original, copy)) == told


def moved(scene: SceneData, change: Callable[[np.ndarray], np.ndarray], only: str | None = None) -> SceneData:
    """The scene with other poses, of all frames or of one."""

    def changed(frame: Frame) -> Frame:
        pose = frame.camera.camera_to_world
        return replace(frame, camera=replace(frame.camera, camera_to_world=change(pose)))

    splits = {
        split: [changed(frame) if only in (None, frame.name) else frame for frame in frames]
        for split, frames in scene.splits.items()
    }
    return replace(scene, splits=splits)


def shifted(pose: np.ndarray, by: float) -> np.ndarray:
    return pose + by * np.array([[0, 0, 0, 1], *np.zeros((3, 4))])


@pytest.mark.parametrize(("distance", "step"), [(0.0, 1e-5), (4e6, 1e-2)])
def test_last_digits_are_the_machines_own_and_others_count(original: Path, distance: float, step: float):
    """Also in the coordinates of a survey, far from the origin."""
    far, noise = moved(load_scene(original), lambda pose: shifted(pose, distance)), np.random.default_rng(0)
    computed = moved(far, lambda pose: pose * (1 + 1e-15 * noise.standard_normal((4, 4))))
    assert not differences(identity(far), identity(computed))
    nudged = moved(far, lambda pose: shifted(pose, step), far.splits["train"][3].name)
    assert differences(identity(far), identity(nudged)) == ["cameras"]


def test_other_masks_are_told(copy: Path):
    hide_a_pixel(copy)
    one, pixels = load_scene(copy), read_rgba(copy / "mask.png")
    before = identity(one)
    pixels[:9, 5, :3] = 0
    write_png(copy / "mask.png", pixels)
    assert differences(before, identity(load_scene(copy))) == ["masks"]
    assert differences(before, identity(one.without_masks())) == ["masks"]


def test_a_missing_image_is_named(copy: Path):
    scene = load_scene(copy)
    (copy / "test" / "r_001.png").unlink()
    with pytest.raises(DatasetInvalid, match=r"r_001\.png: `image` can't be read: No such file"):
        identity(scene)


def test_what_an_earlier_version_did_not_record_does_not_count(original: Path):
    found = identity(load_scene(original))
    assert not differences({}, found)
    assert differences({**found, "times": "another", "later": "unknown here"}, found) == ["times"]
