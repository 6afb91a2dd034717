"""Formats whose axes are right, up, back; all others here, and INRIA's PLY, have right, down, front."""

import numpy as np

SH_SIGNS = np.array([1, -1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1])
"""Of each SH function, degree 0 to 3, where y and z change their sign: −1 where it is odd in y and z together."""


def from_right_up_back(means: np.ndarray, quats: np.ndarray, sh: np.ndarray) -> tuple[np.ndarray, ...]:
    """Means [N, 3], wxyz quaternions [N, 4] and harmonics [N, C, 3] turned by half a turn about x; its own inverse."""
    return means * (1, -1, -1), quats * (1, 1, -1, -1), sh * SH_SIGNS[: sh.shape[1], None]
