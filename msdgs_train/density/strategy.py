"""The interface of density control."""

from typing import Protocol

import torch
from torch import Tensor

from msdgs_train.gaussians.model import PosedGaussians
from msdgs_train.gaussians.surgery import RowSurgery


class DensityStrategy(Protocol):
    """Adds, removes and relocates Gaussians while they are trained."""

    @property
    def generator(self) -> torch.Generator:
        """All of its randomness."""
        ...

    def accumulate(self, means2d_grads: Tensor, radii: Tensor, width: int, height: int, shows_all: bool) -> None:
        """Accumulate one view: gradients [N, 2] in pixels, radii [N] that are 0 if a Gaussian was not drawn;
        `shows_all` if nothing of the scene is outside the image."""
        ...

    def regularizers(self, posed: PosedGaussians) -> dict[str, Tensor]:
        """Weighted terms of the loss, by name."""
        ...

    def after_step(self, surgery: RowSurgery, steps: range) -> None:
        """Density control after an optimizer step, which stands for these steps of the schedule, counted from 1."""
        ...

    def state(self) -> tuple[Tensor, ...]:
        """The accumulated state, besides the generator, for a bit-exact continuation."""
        ...

    def load_state(self, state: tuple[Tensor, ...]) -> None:
        """Continue from it."""
        ...
