"""The box that a volume fills, and a grid of the cells in it where something may be."""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

PARALLEL = 1e-6
"""Replaces components of directions that are 0."""


class Box(NamedTuple):
    """An axis-aligned box, in scene units."""

    low: Tensor  # [3]
    high: Tensor  # [3]

    def contains(self, points: Tensor) -> Tensor:
        """Whether points, [..., 3], are in it, [...] bool."""
        return ((points >= self.low) & (points <= self.high)).all(dim=-1)

    def normalized(self, points: Tensor) -> Tensor:
        """Points, [..., 3], with the corners at -1 and 1."""
        return (points - self.low) * (2 / (self.high - self.low)) - 1

    def spans(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Where rays, [R, 3] each, enter and leave it, [R] each in lengths of the direction; those that miss it leave
        before they enter."""
        slopes = torch.where(directions == 0, PARALLEL, directions)
        sides = (self.low - origins) / slopes, (self.high - origins) / slopes
        return torch.minimum(*sides).amax(dim=1), torch.maximum(*sides).amin(dim=1)


def occupied_cells(alphas: Tensor, least: float) -> Tensor:
    """Cells that may hold something, [X - 1, Y - 1, Z - 1] bool.

    Args:
        alphas: largest opacities over time at the vertices of a grid over the box, [X, Y, Z].
        least: a cell counts if a vertex of it, or one next to that, has this opacity.
    """
    near = functional.max_pool3d(alphas[None, None], kernel_size=3, stride=1, padding=1)
    return functional.max_pool3d((near >= least).float(), kernel_size=2, stride=1)[0, 0] > 0


def in_occupied(cells: Tensor, normalized: Tensor) -> Tensor:
    """Whether points of the box, [M, 3] in [-1, 1], are in cells, [X, Y, Z] bool, that may hold something."""
    columns = zip(normalized.unbind(dim=1), cells.shape, strict=True)
    x, y, z = (((column + 1) * (count / 2)).long().clamp(0, count - 1) for column, count in columns)
    return cells[x, y, z]
