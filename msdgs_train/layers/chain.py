"""The multi-step deformation: layers in a chain, each with a learned weight (paper, section 3.2)."""

from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor, nn

from msdgs_train.layers.mlp import LayerStep
from msdgs_train.supports.nodes import BasisLayer, SkinningInputs
from msdgs_train.supports.skinning_kernels import K_NEAREST, MOTION

CHUNK = 4096
"""Gaussians at a time where no gradient is wanted: activations stay in a core's cache. 1.3 times as fast in float32
and 1.2 times in float64 at 106,500 Gaussians, K = 10 and width 256."""


class Deltas(NamedTuple):
    """Weighted sums over the layers of what each Gaussian changes by at one time (equation 9), before modulation."""

    means: Tensor  # [N, 3] scene units
    scales: Tensor  # [N, 3] of logarithms or of scales, as the model's `delta_space` says
    quats: Tensor  # [N, 4] wxyz, added to the normalised canonical quaternion
    opacities: Tensor | None = None  # [N] of logits; None without that head
    sh: Tensor | None = None  # [N, (degree + 1)², 3]; None without that head


class MultiStepDeformation(nn.Module):
    """K layers; layer k sees the means as the layers before it have moved them. K = 0 moves nothing."""

    def __init__(self, layers: Iterable[nn.Module]) -> None:
        super().__init__()
        self.layers = nn.ModuleList(layers)

    def __len__(self) -> int:
        return len(self.layers)

    def forward(
        self, means: Tensor, t: Tensor, steps: int | None = None, carried: SkinningInputs | None = None
    ) -> Deltas:
        """Deltas of canonical means, [N, 3], at time `t`, a scalar tensor; after the first `steps` layers if given.

        `carried` are the same Gaussians as a layer of kind `bases` wants them.
        """
        if torch.is_grad_enabled() or len(means) <= CHUNK:
            return self._chain(means, t, steps, carried)
        starts = range(0, len(means), CHUNK)
        chunks = [slice(start, start + CHUNK) for start in starts]
        parts = [self._chain(means[c], t, steps, carried.rows(c) if carried else None) for c in chunks]
        columns = [[column for column in columns if column is not None] for columns in zip(*parts, strict=True)]
        return Deltas(*(torch.cat(column) if column else None for column in columns))  # pyright: ignore

    def _chain(self, means: Tensor, t: Tensor, steps: int | None, carried: SkinningInputs | None) -> Deltas:
        deltas = Deltas(torch.zeros_like(means), torch.zeros_like(means), means.new_zeros(len(means), 4))
        for layer in self.layers[:steps]:
            step = step_of(layer, means + deltas.means, t, carried)  # equations 7 and 8
            deltas = Deltas(
                torch.addcmul(deltas.means, step.weight, step.delta_means),
                torch.addcmul(deltas.scales, step.weight, step.delta_scales),
                torch.addcmul(deltas.quats, step.weight, step.delta_quats),
                _sum(deltas.opacities, step.weight[:, 0], step.delta_opacities),
                _sum(deltas.sh, step.weight[:, :, None], step.delta_sh),
            )
        return deltas


def step_of(layer: nn.Module, means: Tensor, t: Tensor, carried: SkinningInputs | None) -> LayerStep:
    """What a layer proposes for means, [N, 3], as the layers before it have moved them."""
    if isinstance(layer, BasisLayer):
        assert carried is not None  # the model's configuration has seen to it
        return layer(carried, t)
    return layer(means, t)


def _sum(total: Tensor | None, weight: Tensor, delta: Tensor | None) -> Tensor | None:
    if delta is None:
        return total
    return weight * delta if total is None else torch.addcmul(total, weight, delta)


def operations(layers: Iterable[nn.Module]) -> int:
    """About how many layers take for a Gaussian: a product and a sum for each weight of a Linear and for each number of
    a motion that it follows."""
    modules = [module for layer in layers for module in layer.modules()]
    linears = sum(module.weight.numel() for module in modules if isinstance(module, nn.Linear))
    blends = sum(MOTION * min(K_NEAREST, len(module.pivots)) for module in modules if isinstance(module, BasisLayer))
    return 2 * (linears + blends)
