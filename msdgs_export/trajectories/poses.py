"""Poses of the moving Gaussians of a baked scene, in float64 by torch."""

import copy

import numpy as np
import numpy.typing as npt
import torch

from msdgs_export.bake import DELTA_SPACES, Baked
from msdgs_export.layers import HEAD_COLUMNS, HEADS
from msdgs_export.measure.poses import operations
from msdgs_train.gaussians.raw_quaternions import unit_form
from msdgs_train.gaussians.scale_space import ScaleSpace, add_to_scales
from msdgs_train.layers.chain import MultiStepDeformation
from msdgs_train.layers.quaternions import unit_or_identity
from msdgs_train.supports.base import CanonicalPoints

POSE = 10
"""Columns of a pose: means 3, scales 3, quats 4 (wxyz)."""
MEANS, SCALES, QUATS = HEAD_COLUMNS.values()

Poses = npt.NDArray[np.float64]


class ExactPoses:
    """Poses in float64, by running the scene's layers on the baked values."""

    def __init__(self, baked: Baked) -> None:
        m = baked.moving
        self.count = len(m)
        self._space: ScaleSpace = "log" if baked.scene.metadata.delta_space == DELTA_SPACES["log"] else "linear"
        self._is_raw = baked.quat_space == "raw"
        self._means, self._log_scales, self._quats, self._raw_quats = (
            torch.from_numpy(a).double() for a in (m.means, m.log_scales, m.quats, m.raw_quats)
        )
        self._factors = {head: torch.from_numpy(factors).double() for head, factors in m.modulation.items()}
        self._attributes = {name: torch.from_numpy(values) for name, values in m.attributes.items()}
        self._attributes |= {n: v.double() for n, v in self._attributes.items() if v.is_floating_point()}
        self._support = copy.deepcopy(baked.support).double()
        self._deformation = MultiStepDeformation(copy.deepcopy(layer).double() for layer in baked.layers)

    @property
    def operations(self) -> float:
        """Approximate operations per Gaussian and pose."""
        return max(operations(self._support, self._deformation, self.count), 1)

    @torch.no_grad()
    def at(self, t: float, ids: npt.NDArray[np.int64] | None = None) -> Poses:
        """[M, 10] means, linear scales and unit quaternions of the moving Gaussians `ids`, or of all."""
        rows = torch.from_numpy(np.arange(self.count) if ids is None else ids)
        means, log_scales, quats = self._means[rows], self._log_scales[rows], self._quats[rows]
        attributes = {name: v[rows] for name, v in self._attributes.items()}
        points = CanonicalPoints(means, quats, attributes, self._raw_quats[rows])
        deltas = self._support(self._deformation, points, torch.tensor(t, dtype=torch.float64))
        of_means, of_scales, of_quats = (
            self._factors[head][rows] * getattr(deltas, head) if head in self._factors else getattr(deltas, head)
            for head in HEADS  # equation 12
        )
        scales = add_to_scales(self._space, log_scales, of_scales)
        quats = quats + of_quats
        if self._is_raw:
            quats, scales = unit_form(quats, scales)
        return torch.cat([means + of_means, scales, unit_or_identity(quats)], dim=1).numpy()
