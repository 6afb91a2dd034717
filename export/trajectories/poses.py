"""The moving Gaussians of a baked scene at any time, in float64: what plans are fitted to."""

import copy

import numpy as np
import numpy.typing as npt
import torch

from export.jobs.bake import Baked
from export.plans.network import network
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.scene.gaussians import FloatArray
from msdgs_train.gaussians.model import MIN_SCALE, activated_scales, unit_quats
from msdgs_train.layers.chain import MultiStepDeformation, operations
from msdgs_train.supports.nodes import SkinningInputs

POSE = 10
"""Columns of a pose: means 3, scales 3, quats 4 (wxyz)."""
MEANS, SCALES, QUATS = slice(0, 3), slice(3, 6), slice(6, 10)

Poses = npt.NDArray[np.float64]


class ExactPoses:
    """`at(t)`: the scene's layers run on the baked values in float64, without any graph."""

    def __init__(self, baked: Baked) -> None:
        m = baked.moving
        self.count = len(m)
        self._raw = baked.scene.metadata.delta_space == "raw"
        self._means, self._log_scales, self._quats = (_double(a) for a in (m.means, m.log_scales, m.quats))
        factors = (m.mean_modulation, m.scale_modulation, m.quat_modulation)
        self._factors = [None if f is None else _double(f) for f in factors]
        self._carried = None
        if m.skinning_weights is not None and m.node_ids is not None:
            self._carried = SkinningInputs(
                self._means, self._quats, _double(m.skinning_weights), torch.from_numpy(m.node_ids)
            )
        self._deformation = MultiStepDeformation(copy.deepcopy(layer).double() for layer in baked.layers)

    @property
    def operations(self) -> int:
        """About how many a pose takes."""
        return max(operations(self._deformation.layers), 1)

    def at(self, t: float, ids: npt.NDArray[np.int64] | None = None) -> Poses:
        """[M, 10] means, linear scales and unit quaternions of the moving Gaussians `ids`, or of all."""
        return self._posed(t, torch.from_numpy(np.arange(self.count) if ids is None else ids))

    @torch.no_grad()
    def _posed(self, t: float, ids: torch.Tensor) -> Poses:
        means, log_scales = self._means[ids], self._log_scales[ids]
        carried = self._carried.rows(ids) if self._carried else None
        deltas = self._deformation(means, torch.tensor(t, dtype=torch.float64), carried=carried)
        of_means, of_scales, of_quats = (
            delta if factors is None else factors[ids] * delta  # equation 12
            for factors, delta in zip(self._factors, (deltas.means, deltas.scales, deltas.quats), strict=True)
        )
        if self._raw:
            scales = activated_scales(log_scales + of_scales)
        else:
            scales = (activated_scales(log_scales) + of_scales).clamp_min(MIN_SCALE)
        return torch.cat([means + of_means, scales, unit_quats(self._quats[ids] + of_quats)], dim=1).numpy()


def _double(array: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(array).double()


def pixel(baked: Baked) -> float:
    """What one pixel of the scene's nearest camera spans in scene units at the middle of what moves.

    Errors of plans are chosen in this unit. Without cameras: of an image of 400 pixels across the scene's bounds.
    """
    low, high = np.array(baked.scene.metadata.bounds)
    middle = np.median(baked.moving.means, axis=0) if len(baked.moving) else (low + high) / 2
    spans = [
        np.linalg.norm(view.camera.camera_to_world[:3, 3] - middle) / max(view.camera.fx, view.camera.fy)
        for view in baked.scene.metadata.cameras
    ]
    size = max(float(np.linalg.norm(high - low)), 1e-30)
    return float(min((s for s in spans if s > 0), default=size / 400))


class SinglePoses:
    """As `ExactPoses`, to round-off. Raises `SceneFileInvalid` where float32 can't hold the scene or its motion."""

    def __init__(self, baked: Baked) -> None:
        self._session = DeformationSession("network in float32", contents=network(baked).SerializeToString())

    def at(self, t: float, ids: npt.NDArray[np.int64]) -> FloatArray:
        """[M, 10] means, linear scales and unit quaternions of the moving Gaussians `ids`."""
        means, quats, scales = self._session.pose(t, ids)
        return np.concatenate([means, scales, quats], axis=1)
