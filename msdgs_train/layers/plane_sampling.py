"""Features of six planes by torch's `grid_sample`, for devices without kernels; `plane_kernels` describes them."""

import torch
from torch import Tensor
from torch.nn.functional import grid_sample


def sampled_features(space: Tensor, lines: Tensor, positions: Tensor) -> Tensor:
    """Features [N, C], differentiable, of positions in cells, [N, 3]; space [3, S, S, C], lines [3, S, C]."""
    x, y, z = (positions * (2 / (space.shape[1] - 1)) - 1).unbind(dim=1)  # -1 and 1 are the outermost nodes
    anywhere = torch.zeros_like(x)
    planes = _sample(space.permute(0, 3, 1, 2), ((x, y), (x, z), (y, z)))
    along = _sample(lines.permute(0, 2, 1)[..., None], ((x, anywhere), (y, anywhere), (z, anywhere)))
    first, second, third = planes.unbind()
    for factor in along.unbind():
        third = third * factor
    return (first * second * third).t()


def _sample(planes: Tensor, places: tuple[tuple[Tensor, Tensor], ...]) -> Tensor:
    """[3, C, N] of planes [3, C, S, S'], at places along their first and second axis; outside, those of the border."""
    grid = torch.stack([torch.stack((second, first), dim=-1) for first, second in places])[:, None]
    return grid_sample(planes, grid, mode="bilinear", padding_mode="border", align_corners=True)[:, :, 0]
