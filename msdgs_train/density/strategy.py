"""The base of strategies of density control."""

from dataclasses import dataclass

import torch
from torch import Tensor

from msdgs_train.density.config import DensityConfig
from msdgs_train.engine.schedule import Schedule
from msdgs_train.gaussians.surgery import RowSurgery
from msdgs_train.rendering.info import RasterizationInfo


@dataclass
class DensityStrategy:
    """Adds, removes and relocates Gaussians while they are trained."""

    schedule: Schedule
    generator: torch.Generator  # all of its randomness
    max_gaussians: int

    @property
    def config(self) -> DensityConfig:
        """The settings."""
        return self.schedule.config.density

    def accumulate(self, screen: RasterizationInfo, width: int, height: int, shows_all: bool) -> None:
        """Accumulate one view after its backward pass; `shows_all` if nothing of the scene is outside the image."""

    def after_step(self, surgery: RowSurgery, steps: range) -> None:
        """Density control after an optimizer step, which stands for these steps of the schedule, counted from 1."""
        raise NotImplementedError

    def state(self) -> tuple[Tensor, ...]:
        """The accumulated state, besides the generator, for a bit-exact continuation."""
        return ()

    def load_state(self, state: tuple[Tensor, ...]) -> None:
        """Continue from it."""
