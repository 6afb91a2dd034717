"""The first part of a run has images of half the size."""

from pathlib import Path

import numpy as np
import pytest

from msdgs_train.datasets import Frame, load_scene
from msdgs_train.datasets.cache import ImageCache
from msdgs_train.datasets.common.images import resize_area
from msdgs_train.engine import schedule as schedule_module
from msdgs_train.engine.schedule import Schedule
from msdgs_train.engine.trainer import Trainer
from tests.support.training_scene import SIZE, small_config, splatting

STEPS = 6


def test_images_are_halved_in_the_first_part(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(schedule_module, "HALVED_WIDTH", SIZE)
    trainer = Trainer(small_config(steps=STEPS, half_resolution_fraction=0.5), load_scene(data))
    seen: list[tuple[int, ...]] = []
    loss = splatting(trainer).loss

    def noted(frame, target, background, step):
        view = loss(frame, target, background, step)
        assert target.rgb.shape == view.rgb.shape
        seen.append((frame.camera.width, frame.camera.height, len(target.alpha)))
        return view

    monkeypatch.setattr(trainer.system, "loss", noted)
    for _ in range(STEPS):
        trainer.step()
    assert seen == 3 * [3 * (SIZE // 2,)] + 3 * [3 * (SIZE,)]


@pytest.mark.parametrize(("width", "expected"), [(319, False), (320, True)])
def test_small_images_have_their_size(width: int, expected: bool) -> None:
    schedule = Schedule.from_config(small_config(steps=STEPS, half_resolution_fraction=0.5))
    assert [schedule.halves(width, step) for step in (0, 2, 3)] == [expected, expected, False]


def test_a_half_image_is_the_mean_of_four_pixels_of_the_same_view(data: Path) -> None:
    frame, cache = load_scene(data).splits["train"][0], ImageCache()
    half = frame.halved()
    assert (half.camera.fx, half.camera.cy) == (frame.camera.fx / 2, frame.camera.cy / 2)
    for _ in range(2):
        np.testing.assert_array_equal(cache.half_rgba(frame), resize_area(frame.load_rgba(), SIZE // 2, SIZE // 2))
        np.testing.assert_array_equal(cache.rgba(frame), frame.load_rgba())
    one = half.halved().halved().halved().halved().halved().halved().halved()
    assert (one.camera.width, one.camera.height) == (1, 1)


def test_the_cache_keeps_no_more_bytes_than_its_limit(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one, other = load_scene(data).splits["train"][:2]
    read, load = [], Frame.load_rgba
    monkeypatch.setattr(Frame, "load_rgba", lambda frame: read.append(frame.name) or load(frame))
    cache = ImageCache(5 * SIZE * SIZE)  # one image and its half
    for _ in range(2):
        cache.half_rgba(one)
        cache.rgba(one)
        cache.rgba(other)
    assert read == [one.name, other.name, other.name]


def test_images_that_are_not_kept_give_the_same_steps(data: Path) -> None:
    scene = load_scene(data)
    kept, read_again = (Trainer(small_config(steps=STEPS, image_memory=memory), scene) for memory in (1.0, 0.0))
    assert [kept.step().loss for _ in range(STEPS)] == [read_again.step().loss for _ in range(STEPS)]


@pytest.mark.parametrize(("halved", "of_training"), [(0.0, 4 * SIZE**2), (0.5, 5 * SIZE**2)])
def test_images_take_so_many_bytes(
    halved: float, of_training: int, data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(schedule_module, "HALVED_WIDTH", SIZE)
    scene = load_scene(data)
    trainer = Trainer(small_config(steps=STEPS, half_resolution_fraction=halved), scene)
    held_out = sum(len(frames) for split, frames in scene.splits.items() if split != "train")
    assert trainer.bytes_of_images == of_training * len(scene.splits["train"]) + 4 * SIZE**2 * held_out
