"""The color behind a scene: that of a plain backdrop, else white."""

import math
from pathlib import Path

import numpy as np
import pytest

from msdgs_serve.scene import Camera
from msdgs_train.datasets.common.images import write_png
from msdgs_train.datasets.common.scene_data import Frame, SceneData
from msdgs_train.datasets.config import DataConfig

WHITE = (1.0, 1.0, 1.0)
BACKDROP, WALL = (90, 78, 70), (30, 200, 10)
BACKDROP_COLOR = tuple(value / 255 for value in BACKDROP)
CAMERA = Camera(width=32, height=24, fx=30.0, fy=30.0, cx=16.0, cy=12.0, camera_to_world=np.eye(4))


def scene_of(folder: Path, images: list[np.ndarray], masks: list[np.ndarray] | None = None) -> SceneData:
    frames = []
    for index, image in enumerate(images):
        path = folder / f"{index:03}.png"
        write_png(path, image)
        mask = folder / f"{index:03}.mask.png" if masks else None
        if mask and masks:
            write_png(mask, 255 * masks[index].astype(np.uint8)[..., None].repeat(3, axis=2))
        frames.append(Frame(path.name, CAMERA, index / len(images), path, mask_path=mask))
    return SceneData({"train": frames, "val": [], "test": []}, 1.0)


def picture(border: tuple[int, ...], *, wall_from: int = 24) -> np.ndarray:
    """Something in front of one color, whose last columns and the border there are another one."""
    image = np.full((24, 32, len(border)), border, np.uint8)
    image[1:-1, 1:-1, :3] = np.random.default_rng(0).integers(256, size=(22, 30, 3))
    image[:, wall_from:, :3] = WALL
    return image


def behind(scene: SceneData, **settings: str) -> tuple[float, float, float]:
    return DataConfig(**settings).evaluation_background(scene)  # type: ignore[arg-type]


def test_a_plain_backdrop_is_behind_the_scene(tmp_path: Path):
    scene = scene_of(tmp_path, [picture(BACKDROP, wall_from=30 - k) for k in range(4)])
    assert behind(scene) == BACKDROP_COLOR
    assert behind(scene, background="white") == behind(scene, background="random") == WHITE
    assert behind(scene, background="black") == (0.0, 0.0, 0.0)


def test_it_is_white_behind_images_that_are_transparent_somewhere(tmp_path: Path):
    images = [picture((*BACKDROP, 255)) for _ in range(3)]
    assert behind(scene_of(tmp_path, images)) == BACKDROP_COLOR
    images[2][10, 10, 3] = 254
    assert behind(scene_of(tmp_path, images)) == WHITE


@pytest.mark.parametrize(("step", "expected"), [(4, (90 / 255,) * 3), (5, WHITE)])
def test_a_wall_that_varies_is_no_backdrop(tmp_path: Path, step: int, expected: tuple[float, float, float]):
    columns = 90 + step * (np.arange(32) % 3 - 1)  # a third of the pixels each
    image = np.broadcast_to(columns[None, :, None], (24, 32, 3)).astype(np.uint8)
    assert behind(scene_of(tmp_path, [image, np.roll(image, 1, axis=1)])) == expected


def test_hidden_pixels_do_not_count(tmp_path: Path):
    left = np.full((24, 32), True)
    left[:, 20:] = False
    images = [picture(BACKDROP, wall_from=12)] * 2
    assert behind(scene_of(tmp_path, images)) == tuple(value / 255 for value in WALL)
    assert behind(scene_of(tmp_path, images, [left] * 2)) == WHITE  # a third of the border
    assert behind(scene_of(tmp_path, [picture(BACKDROP, wall_from=20)] * 2, [left] * 2)) == BACKDROP_COLOR


def test_a_few_pixels_are_no_backdrop(tmp_path: Path):
    feet = np.full((24, 32), False)
    feet[5:, 14:18] = True  # what a mask leaves of a person
    assert behind(scene_of(tmp_path, [picture(BACKDROP)] * 2, [feet] * 2)) == WHITE


@pytest.mark.parametrize("count", [1, 2, 500])
def test_few_images_are_read(tmp_path: Path, count: int, monkeypatch: pytest.MonkeyPatch):
    scene, read = scene_of(tmp_path, [picture(BACKDROP)] * count), []
    load = Frame.load_rgba

    def noted(frame: Frame) -> np.ndarray:
        read.append(frame.name)
        return load(frame)

    monkeypatch.setattr(Frame, "load_rgba", noted)
    assert behind(scene) == behind(scene)
    assert len(read) == len(set(read)) == min(count, 8)
    assert math.isclose(sum(behind(scene)), sum(BACKDROP) / 255)
