"""Conversion from axes right, up, back of some formats to right, down, front of INRIA's PLY and this project; and
directions that are up, as texts."""

import re

import numpy as np

SH_SIGNS = np.array([1, -1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1])
"""Sign of each SH function, degree 0 to 3, if y and z change theirs: −1 if it is odd in y and z together."""


def from_right_up_back(means: np.ndarray, quats: np.ndarray, sh: np.ndarray) -> tuple[np.ndarray, ...]:
    """Rotate means [N, 3], wxyz quaternions [N, 4] and SH [N, C, 3] by 180° about x. It is its own inverse."""
    return means * (1, -1, -1), quats * (1, 1, -1, -1), sh * SH_SIGNS[: sh.shape[1], None]


def up_direction(text: str) -> np.ndarray | None:
    """[3] unit, of an axis such as `z`, `-y` or `+Y` or of three numbers, as options and headers of files have it; None
    for anything else."""
    if axis := re.fullmatch(r"\s*([+-]?)\s*([xyz])(?:[ _-]?up)?\s*", text, re.IGNORECASE):
        return (-1.0 if axis[1] == "-" else 1.0) * np.eye(3)["xyz".index(axis[2].lower())]
    words = text.strip().strip("()[]").replace(",", " ").split()
    try:
        numbers = np.array([float(word) for word in words])
    except ValueError:
        return None
    largest = np.abs(numbers).max(initial=0)
    if len(numbers) != 3 or not np.isfinite(largest) or largest == 0:
        return None
    scaled = numbers / largest  # squares of large and small numbers are out of range
    return scaled / np.linalg.norm(scaled)
