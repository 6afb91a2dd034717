"""Which cameras stand still."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from msdgs_train.capture.fixed_cameras import is_fixed
from msdgs_train.capture.image_files import write_image
from tests.train.capture.clips import picture


def files_of(folder: Path, images: Sequence[np.ndarray]) -> list[Path]:
    files = [folder / f"{index:02d}.png" for index in range(len(images))]
    for file, image in zip(files, images, strict=True):
        write_image(file, image)
    return files


@pytest.mark.parametrize(
    "shifts",
    [range(9), [0, 0, 0, 0, 0, 2, 4, 6, 8], [0, 2, 4, 6, 8, 8, 8, 8, 8], [0, 0, 0, 0, 0, 0, 0, 3, 6]],
    ids=["always", "at the end", "at the start", "at the very end"],
)
def test_a_camera_that_moves_at_times_is_not_fixed(tmp_path: Path, shifts: Sequence[int]):
    assert not is_fixed(files_of(tmp_path, [picture(shift) for shift in shifts]))


@pytest.mark.parametrize("hidden", [[4], [3, 4, 5], [0], [8], [0, 4, 5]], ids=str)
def test_a_camera_is_fixed_though_somebody_hides_what_it_sees(tmp_path: Path, hidden: list[int]):
    images = [picture(0)] * 9
    for index in hidden:
        images[index] = picture(index, seed=7)
    assert is_fixed(files_of(tmp_path, images))


def test_a_camera_that_sways_is_not_fixed(tmp_path: Path):
    assert not is_fixed(files_of(tmp_path, [picture(2 * math.sin(index)) for index in range(20)]))
