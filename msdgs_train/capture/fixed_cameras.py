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
COMPARED = 16
"""Frames that are compared with their median."""
SHOWN = 0.6
"""Part of the compared frames, at least, that show the background."""
PASSING = 0.15
"""Part of the compared frames, at most, that don't at the start or at the end: between others, something passes, but a
camera that moves doesn't come back to the same place."""
BACKGROUND = 40
"""Frames whose median is the background."""


def is_fixed(files: Sequence[Path]) -> bool:
    """Whether enough corners stay where they are in most of the images, which are in the order of time."""
    if len(files) < 2:
        return False
    compared = [read_gray(file) for file in spread(files, COMPARED)]
    usual = np.median(compared, axis=0).astype(np.uint8)
    corners = cv2.goodFeaturesToTrack(usual, CORNERS, CORNER_QUALITY, CORNER_DISTANCE)
    if corners is None:
        return False
    shown = np.array([_still_part(usual, each, corners) > ENOUGH for each in compared])
    ends = int(PASSING * len(shown)) + 1
    return bool(shown.mean() >= SHOWN and shown[:ends].any() and shown[-ends:].any())


def background(files: Sequence[Path]) -> np.ndarray:
    """[H, W, 3] uint8, BGR: the median of images of a fixed camera, without what passes through them."""
    images = np.stack([read_color(file) for file in spread(files, BACKGROUND)])
    return np.median(images, axis=0).astype(np.uint8)


def _still_part(usual: np.ndarray, other: np.ndarray, corners: np.ndarray) -> float:
    moved, found, _ = cv2.calcOpticalFlowPyrLK(usual, other, corners, corners.copy())
    lengths = np.linalg.norm((moved - corners).reshape(-1, 2), axis=1)
    return float(np.mean((lengths < STILL * usual.shape[1]) & (found.ravel() == 1)))
