"""A copy of a model at one step of training, and its rendering."""

import copy
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import torch

from msdgs_serve.rasterizer import Rendering, rasterize
from msdgs_serve.scene import Camera, Gaussians, InvalidInput
from msdgs_train.engine.metrics_log import to_bytes
from msdgs_train.engine.trainer import Trainer
from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.layers.arrays import to_array
from msdgs_train.systems.gaussian_splatting import GaussianSplatting

Channel = Literal["rgb", "alpha", "depth"]
OUTLYING_DEPTHS = (0.02, 0.98)
"""Quantiles of the visible depths that are drawn white and black."""


@dataclass(eq=False)
class Snapshot:
    """A model that isn't trained further. Not thread-safe."""

    model: DynamicGaussians
    background: tuple[float, float, float]  # sRGB in [0, 1]
    deform: bool = True  # False in the static phase, before layers are trained
    sh_degree: int | None = None  # highest degree in use; None: all
    _posed: tuple[tuple[float, int], Gaussians] | None = field(default=None, init=False)

    def draw(self, camera: Camera, t: float, layers: int, channel: Channel = "rgb") -> np.ndarray:
        """Draw [H, W, 3] uint8 at time `t`, after `layers` of the deformation; alpha 1 and the nearest depth are white.

        Raises `InvalidInput` if Gaussians aren't finite.
        """
        posed, options = self._pose(t, layers), self.model.rasterizer
        drawn = rasterize(posed, camera, background=self.background, depth=channel == "depth", options=options)
        return _image_of(drawn, channel)

    @torch.no_grad()
    def _pose(self, t: float, layers: int) -> Gaussians:
        """Deform the Gaussians. The last result is kept: a moving camera needs the same Gaussians for each frame."""
        if self._posed is None or self._posed[0] != (t, layers):
            posed = self.model.pose(t, num_layers=layers, deform=self.deform, sh_degree=self.sh_degree)
            self._posed = (t, layers), Gaussians(*map(to_array, posed))
        return self._posed[1]


def snapshot_of_training(trainer: Trainer) -> Snapshot:
    """Copy the model as it would be evaluated and saved now. Must not be called during a step."""
    system, step = trainer.system, trainer.step_count
    if not isinstance(system, GaussianSplatting):
        raise InvalidInput("viewer", "off for this system, which isn't made of Gaussians", trainer.config.run.system)
    schedule, model = trainer.schedule, copy.deepcopy(system.eval_model).cpu()
    model.config = replace(model.config, eps2d=schedule.eps2d(step))
    return Snapshot(model, trainer.background, schedule.deforms(step), schedule.sh_degree(step))


def _image_of(rendering: Rendering, channel: Channel) -> np.ndarray:
    match channel:
        case "rgb":
            return to_bytes(rendering.rgb)
        case "alpha":
            values = rendering.alpha
        case "depth":
            values = _nearness(rendering.depth)
    return np.repeat(to_bytes(values)[:, :, None], 3, axis=2)


def _nearness(depth: np.ndarray) -> np.ndarray:
    """Map depths, [H, W] and infinite for empty pixels, to [0, 1]; 1 is nearest."""
    seen = np.isfinite(depth)
    if not seen.any():
        return np.zeros_like(depth)
    near, far = np.quantile(depth[seen], OUTLYING_DEPTHS)
    return np.where(seen, (far - np.where(seen, depth, far)) / max(far - near, 1e-9), 0)
