"""Cameras that stand still: how they are recognized, and their background."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from msdgs_train.capture.image_files import read_color, read_gray
from msdgs_train.capture.views import spread

CORNERS, CORNER_QUALITY, CORNER_DISTANCE = 300, 0.02, 7
STILL = 0.002
"""Part of the width by which a corner of the background may move: one pixel of 500."""
ENOUGH = 0.3
"""Part of the corners that are at rest when the camera is; the others are on what moves."""
COMPARED = 8
"""Frames that the first one is compared with."""
PASSING = 0.15
"""Part of the compared frames in which something may hide the background."""
BACKGROUND = 40
"""Frames whose median is the background."""


def is_fixed(files: Sequence[Path]) -> bool:
    """Whether enough corners of the first image stay where they are in the others, which are in the order of time."""
    if len(files) < 2:
        return False
    first = read_gray(files[0])
    corners = cv2.goodFeaturesToTrack(first, CORNERS, CORNER_QUALITY, CORNER_DISTANCE)
    if corners is None:
        return False
    still = [_still_part(first, read_gray(file), corners) for file in spread(files[1:], COMPARED)]
    return float(np.quantile(still, PASSING)) > ENOUGH


def background(files: Sequence[Path]) -> np.ndarray:
    """[H, W, 3] uint8, BGR: the median of images of a fixed camera, without what passes through them."""
    images = np.stack([read_color(file) for file in spread(files, BACKGROUND)])
    return np.median(images, axis=0).astype(np.uint8)


def _still_part(first: np.ndarray, other: np.ndarray, corners: np.ndarray) -> float:
    moved, found, _ = cv2.calcOpticalFlowPyrLK(first, other, corners, corners.copy())
    lengths = np.linalg.norm((moved - corners).reshape(-1, 2), axis=1)
    return float(np.mean((lengths < STILL * first.shape[1]) & (found.ravel() == 1)))
