"""Poses of the moving Gaussians of a baked scene in float32, by its network in onnxruntime."""

import numpy as np
import numpy.typing as npt

from msdgs_export.bake import Baked
from msdgs_export.plans.network import network
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.scene.gaussians import FloatArray


class SinglePoses:
    """Poses in float32 by onnxruntime, in 0.6 of torch's time for ten layers of 256 units on two cores.

    Raises `SceneFileInvalid` if float32 can't hold the scene or its motion.
    """

    def __init__(self, baked: Baked) -> None:
        self._session = DeformationSession("network in float32", contents=network(baked).SerializeToString())

    def at(self, t: float, ids: npt.NDArray[np.int64]) -> FloatArray:
        """[M, 10] means, linear scales and unit quaternions of the moving Gaussians `ids`."""
        means, quats, scales = self._session.pose(t, ids)
        return np.concatenate([means, scales, quats], axis=1)
