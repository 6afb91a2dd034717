"""Videos are turned and mirrored as their display matrix says."""

import math
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from msdgs_train.datasets import DatasetInvalid, load_scene
from msdgs_train.datasets.common.video import read_info
from tests.train.datasets.layouts import SMALL, poses_bounds, write_video

ONE = 1 << 16
MATRIX = 44  # bytes from the name of the box `tkhd` (version 0) to its matrix, ISO/IEC 14496-12
TURNS: dict[str, tuple[tuple[float, ...], Callable[[np.ndarray], np.ndarray]]] = {
    "upright": ((1, 0, 0, 1), lambda image: image),
    "90° clockwise": ((0, 1, -1, 0), lambda image: np.rot90(image, -1)),
    "180°": ((-1, 0, 0, -1), lambda image: np.rot90(image, 2)),
    "90° counterclockwise": ((0, -1, 1, 0), lambda image: np.rot90(image)),
    "left to right": ((-1, 0, 0, 1), np.fliplr),
    "top to bottom": ((1, 0, 0, -1), np.flipud),
    "transposed": ((0, 1, 1, 0), lambda image: image.swapaxes(0, 1)),
    "transposed the other way": ((0, -1, -1, 0), lambda image: np.rot90(image, 2).swapaxes(0, 1)),
    "twice as large": ((2, 0, 0, 2), lambda image: image),
    "half a degree": ((math.cos(0.008), math.sin(0.008), -math.sin(0.008), math.cos(0.008)), lambda image: image),
    "no matrix": ((0, 0, 0, 0), lambda image: image),
}


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def drawing() -> np.ndarray:
    """Four corners of different colors, in squares of 8 pixels."""
    image = np.full((SMALL.height, SMALL.width, 3), 90, np.uint8)
    image[:8, :8], image[:8, -8:], image[-8:, :8] = [200, 40, 40], [40, 200, 40], [40, 40, 200]
    return image


def turn(video: Path, matrix: Any) -> None:
    """Set the display matrix of an MP4, (a b, c d)."""
    content = bytearray(video.read_bytes())
    place = content.index(b"tkhd") + MATRIX
    assert struct.unpack(">9i", content[place : place + 36]) == (ONE, 0, 0, 0, ONE, 0, 0, 0, 1 << 30)
    a, b, c, d = (round(value * ONE) for value in matrix)
    content[place : place + 36] = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    video.write_bytes(content)


def write_turned(folder: Path, matrix: Any, poses: Any = SMALL) -> Path:
    np.save(folder / "poses_bounds.npy", poses_bounds(2, poses))
    for name in ("cam00", "cam01"):
        write_video(folder / f"{name}.mp4", [drawing(), drawing()])
        turn(folder / f"{name}.mp4", matrix)
    return folder


@pytest.mark.parametrize("name", TURNS)
@pytest.mark.parametrize("reduction", [1, 2])
def test_frames_are_as_players_show_them(tmp_path: Path, name: str, reduction: int):
    matrix, shown = TURNS[name]
    wanted = shown(drawing())[::reduction, ::reduction].astype(int)
    height, width, _ = wanted.shape
    poses = SMALL._replace(width=width * reduction, height=height * reduction)
    scene = load_scene(write_turned(tmp_path, matrix, poses), None if reduction == 1 else width)
    for split in ("train", "test"):
        pixels = scene.splits[split][1].load_rgba()[..., :3].astype(int)
        assert pixels.shape == wanted.shape
        assert np.abs(pixels - wanted).mean() < 6  # chroma has half of the pixels
        for row, column in ((2, 2), (2, -3), (-3, 2), (-3, -3)):
            assert np.abs(pixels[row, column] - wanted[row, column]).max() < 40


@pytest.mark.parametrize("degrees", [30, 45, 95, -135])
def test_other_angles_are_refused(tmp_path: Path, degrees: int):
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    with pytest.raises(DatasetInvalid, match=rf"cam00\.mp4: `video` is shown turned by {degrees}\.0°, but must b"):
        load_scene(write_turned(tmp_path, (c, s, -s, c)))


def test_poses_are_for_frames_as_shown(tmp_path: Path):
    with pytest.raises(DatasetInvalid, match="`row 0` states a size of 32×24, but the image is 24×32"):
        load_scene(write_turned(tmp_path, TURNS["90° clockwise"][0]))


def test_frames_that_were_decoded_before_the_matrix_changed_are_not_shown(tmp_path: Path):
    first = load_scene(write_turned(tmp_path, (1, 0, 0, 1))).splits["test"][0]
    upright, state = first.load_rgba(), (tmp_path / "cam00.mp4").stat()
    turn(write_turned(tmp_path, (1, 0, 0, 1)) / "cam00.mp4", (-1, 0, 0, -1))
    assert (tmp_path / "cam00.mp4").stat().st_size == state.st_size
    assert read_info(tmp_path / "cam00.mp4").turn != read_info(tmp_path / "cam01.mp4").turn
    turned = load_scene(tmp_path).splits["test"][0].load_rgba()
    assert (turned == upright[::-1, ::-1]).all()
