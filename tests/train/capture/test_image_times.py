"""Times of images in folders, from their names."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from msdgs_train.capture.image_source import ImageSource, starts_by_names

FRAMES = "30 images per second are assumed"
NAMED: dict[str, tuple[list[str], list[float], str]] = {
    "seconds": (["t_1.25", "t_1.5", "t_2.5"], [0, 0.25, 1.25], ""),
    "milliseconds since 1970": (["1706745600000", "1706745600033", "1706745600533"], [0, 0.033, 0.533], ""),
    "clocks": (["20240131_235958", "20240201_000001", "20240201_000100"], [0, 3, 62], ""),
    "milliseconds": (["a_50ms", "a_100ms", "a_250ms"], [0, 0.05, 0.2], ""),
    "frames": (["00005", "00006", "00009"], [0, 1 / 30, 4 / 30], FRAMES),
    "halves of frames": (["frame_1.0", "frame_1.5", "frame_3.0"], [0, 0.5 / 30, 2 / 30], FRAMES),
    "no times": (["a", "b", "c"], [0, 1 / 30, 2 / 30], FRAMES),
    "photos": (["IMG_0001", "IMG_0002", "IMG_0009"], [0, 1 / 30, 2 / 30], FRAMES),
    "several in a second": (
        ["20240131_235958_01", "20240131_235958_02", "20240131_235959_01"],
        [0, 1 / 30, 2 / 30],
        FRAMES,
    ),
}


def folder_of(folder: Path, names: list[str]) -> Path:
    folder.mkdir()
    for index, name in enumerate(names):
        cv2.imwrite(str(folder / f"{name}.png"), np.full((8, 9, 3), index, np.uint8))
    return folder


@pytest.mark.parametrize("kind", NAMED)
def test_images_are_at_the_times_in_their_names(tmp_path: Path, kind: str):
    names, times, note = NAMED[kind]
    source = ImageSource(folder_of(tmp_path / "a", names), 64)
    pictures = list(source.pictures())
    assert [picture.time for picture in pictures] == pytest.approx(times)
    assert [int(picture.grey[0, 0]) for picture in pictures] == [0, 1, 2]
    assert source.duration == pytest.approx(times[-1])
    assert source.period == pytest.approx(1 / 30 if note else times[-1] / 2)
    assert [note in each for each in source.notes()] == [True] * bool(note)


STARTS = [
    (["f_0", "f_1", "f_9"], ["f_5", "f_6", "f_9"], (0, 5 / 30)),
    (["t_1.5", "t_9.5"], ["t_1.25", "t_9.25"], (0, -0.25)),
    (["f_0", "f_1"], ["t_0.25", "t_1.25"], None),
    (["f_0", "f_1"], ["f_7", "f_8"], None),
    (["f_0", "f_1"], ["a", "b"], None),
    (["IMG_0", "IMG_5"], ["IMG_1", "IMG_6"], None),
]


@pytest.mark.parametrize(("one", "two", "starts"), STARTS)
def test_folders_share_the_times_in_their_names(
    tmp_path: Path, one: list[str], two: list[str], starts: tuple[float, ...] | None
):
    found = starts_by_names([folder_of(tmp_path / "one", one), folder_of(tmp_path / "two", two)])
    assert found == (None if starts is None else pytest.approx(starts))
