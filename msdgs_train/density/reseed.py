"""Reseeding with random Gaussians after the static phase, and the choice of a strategy."""

import torch

from msdgs_train.density.gradient import GradientStrategy
from msdgs_train.density.mcmc import MCMCStrategy
from msdgs_train.density.strategy import DensityStrategy
from msdgs_train.engine.schedule import Schedule
from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.surgery import RowSurgery

RESEED_SEED = 7
"""Added to the run's seed, so that positions differ from the initial ones."""


def make_strategy(schedule: Schedule, scene_scale: float, count: int) -> DensityStrategy:
    """The strategy of the settings, for `count` Gaussians; `scene_scale` is the radius of the cameras' positions."""
    if schedule.config.density.density_strategy == "mcmc":
        return MCMCStrategy.start(schedule)
    return GradientStrategy.start(schedule, scene_scale, count)


@torch.no_grad()
def reseed(surgery: RowSurgery, schedule: Schedule, scene_half_size: float) -> None:
    """Add `num_reseeded` low-opacity Gaussians, as far as there is room, uniformly in the scene's cube."""
    config, gaussians = schedule.config, surgery.gaussians
    count = min(schedule.num_reseeded, config.density.max_gaussians - len(gaussians))
    if count <= 0:
        return
    model, seed = config.model, config.run.seed + RESEED_SEED
    new = CanonicalGaussians.random_in_cube(count, scene_half_size, model.sh_degree, seed, model.attributes())
    kept = torch.arange(len(gaussians))
    surgery.replace_rows(kept, {name: values.detach() for name, values in new.named_parameters()})
