"""Linear blend skinning of Gaussians by moving nodes, with gradients."""

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from msdgs_serve.rasterizer.projection import part_range
from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.threads import run_parallel
from msdgs_train.layers import arrays
from msdgs_train.layers.arrays import to_array
from msdgs_train.layers.base import check_size
from msdgs_train.supports import torch_skinning
from msdgs_train.supports.skinning_kernels import MAX_NEAREST, skin_backward, skin_forward

PARTS = 4  # that the rows are split into; fixed, so that sums have the same order whatever the number of threads


def skin(means: Tensor, quats: Tensor, weights: Tensor, ids: Tensor, motions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Deltas of N Gaussians: of means and of logarithms of scales, [N, 3], and of quaternions, [N, 4].

    Args:
        means: [N, 3] canonical.
        quats: [N, 4] canonical, wxyz, unit.
        weights: [N, F] skinning weights, in memory best node by node; rows sum to 1.
        ids: [N, F] int64, of the nodes that each Gaussian follows.
        motions: [M, 16] of the nodes: matrix by rows, offset, unit quaternion.
    """
    if arrays.has_kernels(means):
        return _Skin.apply(means, quats, weights.T, ids, motions)
    return torch_skinning.skin(means, quats, weights, ids, motions)


def check_nodes(field: str, num_nodes: int, k_nearest: int) -> None:
    """Raise `InvalidInput` unless Gaussians can follow `k_nearest` of so many nodes, or all if there are fewer."""
    check_size(f"{field}.num_nodes", num_nodes)
    check_size(f"{field}.k_nearest", k_nearest)
    if k_nearest > MAX_NEAREST:
        raise InvalidInput(f"{field}.k_nearest", f"at most {MAX_NEAREST}", k_nearest)


class _Skin(torch.autograd.Function):
    """Linear blend skinning by kernels; with torch's matrix products a training step takes 1.14 times as long."""

    @staticmethod
    def forward(ctx: Any, *tensors: Tensor) -> tuple[Tensor, ...]:
        ctx.save_for_backward(*tensors)
        means, quats, *rest = (to_array(tensor) for tensor in tensors)
        deltas = np.empty_like(means), np.empty_like(means), np.empty_like(quats)
        run_parallel(skin_forward, [(means, quats, *rest, *rows, *deltas) for rows in _parts(len(means))])
        return tuple(torch.from_numpy(array).to(tensors[0].device) for array in deltas)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        arrays = means, quats, weights, _, motions = [to_array(tensor) for tensor in ctx.saved_tensors]
        own = [np.empty_like(array) for array in (means, quats, weights)]
        parts = _parts(len(means))
        sums = np.zeros((len(parts), *motions.shape), motions.dtype)
        given = [to_array(grad) for grad in grads]
        run_parallel(
            skin_backward, [(*arrays, *given, *rows, *own, part) for rows, part in zip(parts, sums, strict=True)]
        )
        of_means, of_quats, of_weights, of_motions = (
            torch.from_numpy(array).to(grads[0].device) for array in (*own, sums.sum(axis=0))
        )
        return of_means, of_quats, of_weights, None, of_motions


def _parts(count: int) -> list[tuple[int, int]]:
    """Ranges of rows, whole vectors of 16 but for the last."""
    return [part_range(part, PARTS, count) for part in range(PARTS)]
