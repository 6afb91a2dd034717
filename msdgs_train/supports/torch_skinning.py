"""Linear blend skinning by torch's operations, for devices without kernels; `skinning_kernels` has the formulas."""

import torch
from torch import Tensor

from msdgs_train.layers.quaternions import multiply, rotation_matrices, unit
from msdgs_train.supports.skinning_kernels import MIN_STRETCH


def skin(means: Tensor, quats: Tensor, weights: Tensor, ids: Tensor, motions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Differentiable deltas; arguments and results as of `skinning.skin`."""
    blended = blend(weights, ids, motions)
    matrices, offsets, rots = blended.split((9, 3, 4), dim=1)
    matrices = matrices.unflatten(1, (3, 3))
    moved = (matrices * means[:, None]).sum(dim=2) + offsets
    squares = (matrices @ rotation_matrices(quats)).square().sum(dim=1)  # of the stretched axes
    stretches = 0.5 * squares.clamp_min(MIN_STRETCH**2).log()
    return moved - means, stretches, multiply(unit(rots), quats) - quats


def blend(weights: Tensor, ids: Tensor, values: Tensor) -> Tensor:
    """[N, C] weighted sums of values of nodes, [M, C], node by node: all at once, they would take 8 times the
    memory."""
    blended = values.new_zeros(len(ids), values.shape[1])
    for weight, node in zip(weights.split(1, dim=1), ids.unbind(dim=1), strict=True):
        blended = torch.addcmul(blended, weight, values.index_select(0, node))
    return blended
