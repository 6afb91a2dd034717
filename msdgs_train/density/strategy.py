"""What a strategy of density control is to the trainer, which one the settings ask for, and Gaussians to begin with."""

from typing import Protocol

import torch
from torch import Tensor

from msdgs_train.density.gradient import GradientStrategy
from msdgs_train.density.mcmc import MCMCStrategy
from msdgs_train.engine.config import TrainConfig
from msdgs_train.engine.optimizer import replace_rows
from msdgs_train.gaussians.canonical import CanonicalGaussians

RESEED_SEED = 7
"""Added to that of the settings: not the very places at which training began."""


class DensityStrategy(Protocol):
    """Adds, removes and moves Gaussians while they are trained."""

    @property
    def generator(self) -> torch.Generator:
        """All of its randomness."""
        ...

    def accumulate(self, means2d_grads: Tensor, radii: Tensor, width: int, height: int) -> None:
        """Hear of one image: gradients [N, 2] in pixels, radii [N] that are 0 where a Gaussian was not drawn."""
        ...

    def reset(self, count: int) -> None:
        """Drop what was gathered; there are `count` Gaussians now."""
        ...

    def after_step(self, gaussians: CanonicalGaussians, optimizer: torch.optim.Optimizer, step: int) -> None:
        """Do what is due after this optimiser step, counted from 1."""
        ...

    def state(self) -> tuple[Tensor, ...]:
        """What has been gathered, besides the generator, for a bit-exact continuation."""
        ...

    def load_state(self, state: tuple[Tensor, ...]) -> None:
        """Go on from it."""
        ...


def make_strategy(config: TrainConfig, extent: float, count: int) -> DensityStrategy:
    """The strategy of the settings, for `count` Gaussians; `extent` is the radius of the cameras' positions."""
    if config.density_strategy == "mcmc":
        return MCMCStrategy.start(config)
    return GradientStrategy.start(config, extent, count)


@torch.no_grad()
def reseed(
    gaussians: CanonicalGaussians, optimizer: torch.optim.Optimizer, config: TrainConfig, scene_half_size: float
) -> None:
    """Add `config.num_reseeded` low-opacity Gaussians, as far as there is room, uniformly in the scene's cube."""
    model, count = config.model, min(config.num_reseeded, config.max_gaussians - len(gaussians))
    if count <= 0:
        return
    new = CanonicalGaussians.random_in_cube(
        count, scene_half_size, model.sh_degree, model.embedding_dim, config.seed + RESEED_SEED, model.motions
    )
    kept = torch.arange(len(gaussians))
    replace_rows(optimizer, gaussians, kept, {name: values.detach() for name, values in new.named_parameters()})
