"""Conversion from axes right, up, back of some formats to right, down, front of INRIA's PLY and this project."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

SH_SIGNS = np.array([1, -1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1])
"""Sign of each SH function, degree 0 to 3, if y and z change theirs: −1 if it is odd in y and z together."""


def from_right_up_back(means: np.ndarray, quats: np.ndarray, sh: np.ndarray) -> tuple[np.ndarray, ...]:
    """Rotate means [N, 3], wxyz quaternions [N, 4] and SH [N, C, 3] by 180° about x. It is its own inverse."""
    return means * (1, -1, -1), quats * (1, 1, -1, -1), sh * SH_SIGNS[: sh.shape[1], None]


def upright(up: np.ndarray) -> list[float]:
    """The quaternion xyzw of the rotation that makes y up, after `from_right_up_back`, in a scene of this `up`, [3]."""
    return Rotation.align_vectors([[0.0, 1.0, 0.0]], [up * (1, -1, -1)])[0].as_quat().tolist()


def upright_offset(offset: Sequence[float], up: np.ndarray) -> list[float]:
    """A translation of the scene, [3], in the axes of a node or prim with the rotation of `upright`."""
    return Rotation.from_quat(upright(up)).apply(np.array(offset) * (1, -1, -1)).tolist()
