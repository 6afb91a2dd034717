"""Nearest points."""

import numpy as np
import torch
from torch import Tensor

from msdgs_serve.threads import run_parallel, split_evenly
from msdgs_train.layers import arrays
from msdgs_train.layers.arrays import to_array
from msdgs_train.supports.nearest_kernels import nearest_rows

PARTS = 8
CHUNK = 1 << 14
"""Points whose distances to all centers are in memory at once."""


def nearest(points: Tensor, centers: Tensor, count: int) -> Tensor:
    """[N, F] int64 ids of the nearest of M centers, [M, D], to each of N points, [N, D], from the nearest to the
    farthest; F is `count`, at most M."""
    if not arrays.has_kernels(points):
        return nearest_by_sorting(points, centers, count)
    columns = to_array(centers.detach().T)
    rows, ids = to_array(points), np.zeros((len(points), min(count, len(centers))), np.int64)
    run_parallel(nearest_rows, [(rows, columns, *part, ids) for part in split_evenly(len(rows), PARTS)])
    return torch.from_numpy(ids)


def nearest_by_sorting(points: Tensor, centers: Tensor, count: int) -> Tensor:
    """As `nearest`, by torch's operations."""
    most = min(count, len(centers))
    parts = [torch.cdist(chunk, centers).topk(most, largest=False).indices for chunk in points.detach().split(CHUNK)]
    return torch.cat(parts) if parts else points.new_zeros(0, most, dtype=torch.int64)
