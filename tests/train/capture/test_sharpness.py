"""Sharpness ranks a picture above its blurred copies, whatever the exposure and noise of either."""

import weakref
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import cv2
import numpy as np
import pytest

from msdgs_train.capture.pictures import Picture
from msdgs_train.capture.selection import BLURRED, Intervals, select
from msdgs_train.capture.sharpness import noise_variance, sharpness
from tests.train.capture.clips import picture

EXPOSURES = [(1.0, 0.0), (0.7, 2.0), (1.2, 4.0), (0.8, 8.0)]
"""Gain, and standard deviation of noise in gray values."""


def textured(seed: int) -> np.ndarray:
    """float32 [144, 192] with detail at all scales, as in nature: amplitudes fall as 1 / frequency."""
    rng = np.random.default_rng(seed)
    spectrum = np.fft.rfft2(rng.normal(size=(144, 192)))
    frequency = np.hypot(np.fft.fftfreq(144)[:, None], np.fft.rfftfreq(192))
    detail = np.fft.irfft2(spectrum / np.maximum(frequency, 1 / 144), (144, 192))
    smooth = cv2.resize(picture(0, seed=seed).mean(axis=2).astype(np.float32), (192, 144))
    return (30 + 0.6 * smooth + 18 * detail / detail.std()).astype(np.float32)


def taken(image: np.ndarray, gain: float, noise: float, seed: int) -> np.ndarray:
    values = gain * image + np.random.default_rng(seed).normal(0, noise, image.shape)
    return np.clip(np.round(values), 0, 255).astype(np.uint8)


def moved(image: np.ndarray, length: int, degrees: float) -> np.ndarray:
    """Blurred by a motion of so many pixels."""
    kernel = np.zeros((2 * length + 1,) * 2, np.float32)
    x, y = np.cos(np.radians(degrees)) * length / 2, np.sin(np.radians(degrees)) * length / 2
    ends = [tuple(round(16 * (length + sign * v)) for v in (x, y)) for sign in (-1, 1)]
    cv2.line(kernel, ends[0], ends[1], 1.0, 1, cv2.LINE_AA, 4)
    return cv2.filter2D(image, -1, kernel / kernel.sum())


BLURS = {
    "out of focus": lambda image: cv2.GaussianBlur(image, (0, 0), 1.0),
    "moved along rows": lambda image: moved(image, 5, 0),
    "moved along columns": lambda image: moved(image, 5, 90),
    "moved across": lambda image: moved(image, 5, 37),
}


@pytest.mark.parametrize("blur", BLURS)
def test_a_picture_is_sharper_than_its_blurred_copy(blur: str):
    usual_is_right = total = 0
    for seed, one, two in product(range(3), EXPOSURES, EXPOSURES):
        image = textured(seed)
        sharp, copy = taken(image, *one, seed), taken(BLURS[blur](image), *two, seed + 9)
        assert sharpness(sharp) > sharpness(copy)
        usual_is_right += cv2.Laplacian(sharp, cv2.CV_32F).var() > cv2.Laplacian(copy, cv2.CV_32F).var()
        total += 1
    assert usual_is_right < total  # the variance of the Laplacian


def test_exposure_and_noise_change_it_little_and_strong_blur_much():
    image = textured(0)
    values = [sharpness(taken(image, gain, noise, 1)) for gain, noise in EXPOSURES]
    assert max(values) < 1.35 * min(values)
    assert sharpness(taken(moved(image, 9, 20), 1.0, 0.0, 1)) < BLURRED * min(values)


@pytest.mark.parametrize("noise", [2.0, 8.0])
def test_the_variance_of_noise_is_measured(noise: float):
    flat = np.full((200, 200), 120.0) + np.random.default_rng(0).normal(0, noise, (200, 200))
    assert noise_variance(flat.astype(np.float32)) == pytest.approx(noise**2, rel=0.1)


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (40, 1), (2, 3)])
def test_the_smallest_pictures_have_one(shape: tuple[int, int]):
    assert np.isfinite(sharpness(np.full(shape, 9, np.uint8)))


def test_few_pictures_are_in_memory_at_a_time(tmp_path: Path):
    """Whatever the number of frames: those of 4K are 25 MB each."""
    alive: list[weakref.ref[np.ndarray]] = []
    most = 0

    def made() -> Iterator[Picture]:
        nonlocal most
        for index in range(60):
            grey = picture(index)[..., 0].copy()
            alive.append(weakref.ref(grey))
            most = max(most, sum(each() is not None for each in alive))
            yield Picture(index, index / 30, grey, lambda shown=grey: shown)
            del grey

    selection = select(made(), 0.0, Intervals(0.0, 0.5), lambda chosen: f"{chosen.index}", lambda: None)
    assert len(selection.taken) == 4
    assert most <= 3
