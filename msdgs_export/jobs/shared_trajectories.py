"""Trajectories of the moving Gaussians, to which plans are fitted; shared by candidates of the same layers."""

from contextlib import suppress

import numpy as np

from msdgs_export.bake import Baked
from msdgs_export.jobs.pruned_models import PrunedModels
from msdgs_export.layers import HEADS
from msdgs_export.plans.single_poses import SinglePoses
from msdgs_export.progress import Track
from msdgs_export.pruning import PrunedModel
from msdgs_export.pruning.mask import NetworkMask
from msdgs_export.target import MIN_PSNR, Target
from msdgs_export.trajectories.sampling import Sampler, Trajectories, layers_digest
from msdgs_serve.scene.camera import Camera
from msdgs_serve.scene.errors import SceneFileInvalid

SAMPLED_KEPT = 2
"""Sets of trajectories that are cached; one takes up to 2 GiB."""


class SharedTrajectories:
    """Trajectories, sampled once for all candidates with the same layers: pruning doesn't change the motion of the
    Gaussians that it leaves."""

    def __init__(
        self, pruning: PrunedModels, target: Target, cameras: list[Camera], track: Track, *, in_float32: bool
    ) -> None:
        """`in_float32` says that poses in float32 are exact enough."""
        self._pruning, self._cameras, self._track, self._in_float32 = pruning, cameras, track, in_float32
        self._resolved = 10 ** (-max(target.min_psnr, MIN_PSNR) / 10 - 1)
        self._sampled: list[tuple[bytes, np.ndarray, Trajectories]] = []

    def of(self, baked: Baked, pruned: PrunedModel) -> Trajectories:
        """Trajectories of the Gaussians that move."""
        layers, ids = layers_digest(baked), pruned.ids[: len(baked.moving)]
        for known_layers, known, sampled in self._sampled:
            if known_layers == layers and np.isin(ids, known, assume_unique=True).all():
                return sampled.some(np.searchsorted(known, ids))
        inputs, sampled = (baked, self._track, self._cameras, self._resolved), None
        if self._in_float32:
            with suppress(SceneFileInvalid):  # it overflows at a time that stability didn't try
                sampled = Trajectories(*inputs, self._sampler(baked, pruned.network, ids))
        sampled = sampled or Trajectories(*inputs)
        self._sampled = [*self._sampled[1 - SAMPLED_KEPT :], (layers, ids, sampled)]
        return sampled

    def _sampler(self, baked: Baked, network: NetworkMask, ids: np.ndarray) -> Sampler:
        """Poses of the moving Gaussians `ids` in float32, from pruning at times that it has computed."""
        single, known = SinglePoses(baked), self._pruning.known_poses(network)

        def at(t: float, rows: np.ndarray) -> np.ndarray:
            if known is None or t not in known.times:
                return single.at(t, rows)
            return np.hstack([getattr(known.at(t), head)[ids[rows]] for head in HEADS])

        return at
