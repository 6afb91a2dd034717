"""Marching of rays through a volume: samples, their weights, and the color of each ray.

A sample of density σ over a length δ has the optical depth σ δ and the opacity 1 - exp(-σ δ); it is seen through the
sum of the optical depths before it.
"""

import torch
from torch import Tensor

from msdgs_train.datasets.rays import Rays
from msdgs_train.volumes.field import RayField
from msdgs_train.volumes.samples import Marched, Samples


def weigh(depths: Tensor, samples: Samples, rays: int, stop: float) -> tuple[Tensor, Tensor]:
    """Weights of samples, [M], and what is left of the background, [R].

    Args:
        depths: optical depths, [M].
        stop: nothing is seen behind samples that leave less than this.
    """
    steps = int(samples.steps.max()) + 1 if len(samples.steps) else 1
    place = samples.rays * steps + samples.steps
    dense = depths.new_zeros(rays * steps).index_put((place,), depths).view(rays, steps)
    before = dense.cumsum(dim=1) - dense
    if stop:
        dense = torch.where(torch.exp(-before) >= stop, dense, 0.0)
    weights = torch.exp(-before) * -torch.expm1(-dense)
    return weights.view(-1)[place], torch.exp(-dense.sum(dim=1))


def march(field: RayField, rays: Rays, background: Tensor, generator: torch.Generator | None = None) -> Marched:
    """Colors of rays over `background`, [3]; with a generator, samples are shifted as in training."""
    samples = field.samples(rays, generator)
    depths, features = field.optical_depths(samples, rays)
    if field.least_depth:
        kept = torch.nonzero(depths > field.least_depth)[:, 0]
        samples, depths, features = samples.at(kept), depths[kept], features[kept]
    weights, left = weigh(depths, samples, len(rays.times), field.stop)
    seen = torch.nonzero(weights > field.least_weight)[:, 0]
    samples, weights = samples.at(seen), weights[seen]
    colors = field.colors(samples, rays, features[seen])
    rgb = left[:, None] * background
    rgb = rgb.index_add(0, samples.rays, weights[:, None] * colors)
    return Marched(rgb, left, weights, colors, samples.rays)
