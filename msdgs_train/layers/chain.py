"""The multi-step deformation: layers in a chain, each with a learned weight (paper, section 3.2)."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple, cast

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from msdgs_train.layers.base import NO_EXTRA, DeformationLayer


class Deltas(NamedTuple):
    """Weighted sums of the deltas over all layers at one time (equation 9), before modulation."""

    means: Tensor  # [N, 3] scene units
    scales: Tensor  # [N, 3] as the model's `scale_space` says; on nodes [N, 3] or [N, 6] of a stretch tensor
    quats: Tensor  # [N, 4] wxyz, added to a unit quaternion
    opacities: Tensor | None = None  # [N] of logits; None without that head
    sh: Tensor | None = None  # [N, (degree + 1)², 3]; None without that head
    gains: Tensor | None = None  # [N, 3], by whose 1 + gain colors are multiplied; None without shading
    extra: Mapping[str, Tensor] = NO_EXTRA  # [N, ·] sums of the support's extra heads, by name

    @classmethod
    def joined(cls, parts: Sequence["Deltas"]) -> "Deltas":
        """The rows of one or more deltas of the same heads, one after the other."""
        *columns, extra = zip(*parts, strict=True)
        own = [None if rows[0] is None else torch.cat(rows) for rows in columns]
        return cls(*own, {name: torch.cat([each[name] for each in extra]) for name in extra[0]})  # pyright: ignore


class MultiStepDeformation(nn.Module):
    """K layers; layer k reads the means as moved by the layers before it. With K = 0 all deltas are 0."""

    def __init__(self, layers: Iterable[DeformationLayer]) -> None:
        super().__init__()
        self.layers = nn.ModuleList(layers)

    def __len__(self) -> int:
        return len(self.layers)

    def __iter__(self) -> Iterator[DeformationLayer]:
        return iter(cast(Iterable[DeformationLayer], self.layers))

    def forward(self, means: Tensor, t: Tensor, num_layers: int | None = None) -> Deltas:
        """Deltas of points at `means`, [N, 3], at time `t`, a scalar tensor; after the first `num_layers` if given."""
        deltas = Deltas(torch.zeros_like(means), means.new_zeros(len(means), 3), means.new_zeros(len(means), 4))
        for layer in list(self)[:num_layers]:
            step = layer(means + deltas.means, t)  # equations 7 and 8
            deltas = Deltas(
                torch.addcmul(deltas.means, step.weight, step.delta_means),
                _add_scales(deltas.scales, step.weight, step.delta_scales),
                torch.addcmul(deltas.quats, step.weight, step.delta_quats),
                _sum(deltas.opacities, step.weight[:, 0], step.delta_opacities),
                _sum(deltas.sh, step.weight[:, :, None], step.delta_sh),
                _sum(deltas.gains, step.weight, step.gains),
                {name: step.weight * value + deltas.extra.get(name, 0.0) for name, value in step.extra.items()},
            )
        return deltas

    def operations(self) -> int:
        """Floating-point operations per point."""
        return sum(layer.operations() for layer in self)


def _add_scales(total: Tensor, weight: Tensor, delta: Tensor) -> Tensor:
    """Add deltas of 3 columns, the diagonal, or 6, a symmetric tensor."""
    columns = max(total.shape[1], delta.shape[1])
    total, delta = (values if values.shape[1] == columns else pad(values, (0, 3)) for values in (total, delta))
    return torch.addcmul(total, weight, delta)


def _sum(total: Tensor | None, weight: Tensor, delta: Tensor | None) -> Tensor | None:
    if delta is None:
        return total
    return weight * delta if total is None else torch.addcmul(total, weight, delta)
