"""A trainable multi-resolution hash encoding: by kernels on a CPU, by torch on other devices."""

import itertools
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from msdgs_serve.threads import run_parallel, split_evenly
from msdgs_train.layers import arrays
from msdgs_train.layers.arrays import to_array
from msdgs_train.layers.hash_kernels import CORNERS, PRIMES, UINT32, Levels, hash_features, hash_gradients, hash_slopes

INITIAL = 1e-4
"""Numbers of a new table are uniform in ± this."""
WEIGHING = 6
"""Operations per node of a cell for its row and its weight."""
PARTS = 4  # that the positions are split into for their gradients


class HashGrid(nn.Module):
    """Features of positions in the unit cube, read from grids of several resolutions; zeros outside."""

    scales: Tensor
    nodes: Tensor
    starts: Tensor
    hashed: Tensor

    def __init__(self, levels: Levels, channels: int) -> None:
        super().__init__()
        self.levels, self.channels = levels, channels
        self.table = nn.Parameter(torch.empty(int(levels.starts[-1]), channels).uniform_(-INITIAL, INITIAL))
        for name, values in levels._asdict().items():
            self.register_buffer(name, torch.tensor(values), persistent=False)

    def forward(self, positions: Tensor) -> Tensor:
        """[N, L · C], level by level, at positions [N, 3]."""
        if arrays.has_kernels(positions):
            return _HashFeatures.apply(self.table, positions, self.levels)
        return self.in_torch(positions)

    def in_torch(self, positions: Tensor) -> Tensor:
        """As `forward`, on any device."""
        inside = ((positions >= 0) & (positions <= 1)).all(dim=1, keepdim=True)
        places = torch.where(inside, positions, 0)[:, None] * self.scales  # [N, L, 3]
        cells = torch.minimum(places.detach().long(), self.nodes - 2)
        parts, size = places - cells, self.starts.diff()
        shares = parts * parts * (3 - 2 * parts)
        features = torch.zeros_like(self.table[:1])
        for corner in itertools.product((0, 1), repeat=3):
            x, y, z = (cells[..., axis] + upper for axis, upper in enumerate(corner))
            spread = ((x ^ y * PRIMES[0] ^ z * PRIMES[1]) & UINT32) % size
            dense = x + self.nodes[:, 0] * (y + self.nodes[:, 1] * z)
            rows = self.starts[:-1] + torch.where(self.hashed, spread, dense)
            first, second, third = (shares[..., a] if upper else 1 - shares[..., a] for a, upper in enumerate(corner))
            features = features + (first * second * third)[..., None] * self.table[rows]
        return torch.where(inside, features.flatten(1), 0)

    def operations(self) -> int:
        """Floating-point operations per position."""
        return len(self.levels.nodes) * CORNERS * (WEIGHING + 2 * self.channels)


class _HashFeatures(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, table: Tensor, positions: Tensor, levels: Levels) -> Tensor:
        ctx.save_for_backward(table, positions)
        ctx.levels, count = levels, len(levels.nodes)
        rows, points = to_array(table), to_array(positions)
        features = np.empty((len(points), count, table.shape[1]), rows.dtype)
        run_parallel(hash_features, [(rows, levels, points, level, level + 1, features) for level in range(count)])
        return torch.from_numpy(features.reshape(len(points), -1))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        levels, (table, points) = ctx.levels, (to_array(tensor) for tensor in ctx.saved_tensors)
        count = len(levels.nodes)
        grad_features = to_array(grad).reshape(len(points), count, -1)
        grad_table, grad_points = np.zeros_like(table), None
        run_parallel(hash_gradients, [(levels, points, grad_features, k, k + 1, grad_table) for k in range(count)])
        if ctx.needs_input_grad[1]:
            grad_points = np.empty_like(points)
            parts = split_evenly(len(points), PARTS)
            run_parallel(hash_slopes, [(table, levels, points, grad_features, a, b, grad_points) for a, b in parts])
        return torch.from_numpy(grad_table), None if grad_points is None else torch.from_numpy(grad_points), None
