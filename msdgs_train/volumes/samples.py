"""Samples on rays, and what marching makes of them."""

from typing import NamedTuple

import torch
from torch import Tensor


class Samples(NamedTuple):
    """Points on rays, ray by ray, from near to far."""

    points: Tensor  # [M, 3] scene units
    rays: Tensor  # [M] int64, the ray of each
    steps: Tensor  # [M] int64, its number on the ray
    lengths: Tensor  # [M] that it stands for

    @classmethod
    def of(cls, points: Tensor, lengths: Tensor, inside: Tensor) -> "Samples":
        """Those of `points`, [R, S, 3], that are `inside`, [R, S] bool; `lengths`, [S], are the same for all rays."""
        rays, steps = torch.nonzero(inside, as_tuple=True)
        return cls(points[rays, steps], rays, steps, lengths[steps])

    def at(self, places: Tensor) -> "Samples":
        """Those at `places`, int64, in this order."""
        return Samples(*(tensor[places] for tensor in self))


class Marched(NamedTuple):
    """Colors of rays, and the samples that they are made of."""

    rgb: Tensor  # [R, 3]
    left: Tensor  # [R] part of the background that is seen
    weights: Tensor  # [M], those of samples whose color counts
    colors: Tensor  # [M, 3]
    rays: Tensor  # [M] int64
