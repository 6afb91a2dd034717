"""Rotations of nodes and prims of formats in which y is up."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation


def upright(up: np.ndarray) -> list[float]:
    """The quaternion xyzw of the rotation that makes y up, after `from_right_up_back`, in a scene of this `up`, [3]."""
    return Rotation.align_vectors([[0.0, 1.0, 0.0]], [up * (1, -1, -1)])[0].as_quat().tolist()


def upright_offset(offset: Sequence[float], up: np.ndarray) -> list[float]:
    """A translation of the scene, [3], in the axes of a node or prim with the rotation of `upright`."""
    return Rotation.from_quat(upright(up)).apply(np.array(offset) * (1, -1, -1)).tolist()
