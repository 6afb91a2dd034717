"""Cameras that a model file keeps."""

from pathlib import Path

import numpy as np
import pytest

from msdgs_serve.scene import Camera
from msdgs_train.datasets import Frame
from msdgs_train.gaussians.bounds import spread_frames


def frames_at(*positions: float) -> list[Frame]:
    """A frame per position on a line."""
    frames = []
    for i, x in enumerate(positions):
        pose = np.eye(4)
        pose[0, 3] = x
        frames.append(Frame(f"r_{i}", Camera.from_fov(pose, 8, 8, 40.0), i / len(positions), Path(f"r_{i}.png")))
    return frames


@pytest.mark.parametrize(
    ("positions", "count", "chosen"),
    [
        ((0, 1, 2, 3, 4), 2, [0, 4]),
        ((0, 1, 2, 3, 4), 3, [0, 2, 4]),
        ((0, 0, 0, 9, 9, 9), 2, [0, 3]),  # cameras that stand still
        ((5, 5, 5), 2, [0]),
        ((2, 1), 9, [0, 1]),
        ((7,), 3, [0]),
    ],
)
def test_kept_cameras_are_far_from_each_other(positions: tuple[float, ...], count: int, chosen: list[int]) -> None:
    kept = spread_frames(frames_at(*positions), count)
    assert [frame.name for frame in kept] == [f"r_{i}" for i in chosen]
