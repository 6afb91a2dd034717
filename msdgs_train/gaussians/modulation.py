"""Time-invariant modulation of the summed deltas (paper, section 3.4)."""

from collections.abc import Sequence
from typing import Literal, get_args

import torch
from torch import Tensor, nn

from msdgs_train.gaussians.attribute import Attribute
from msdgs_train.layers.parameters import LearningRate

ModulationTarget = Literal["means", "scales", "quats"]

HIDDEN_UNITS = 32
MAX_LOG_FACTOR = 2.0
"""Factors are clamped to [e^-2, e^2]. Unbounded they grew to 5,000 in 2,000 steps on one scene and the loss diverged:
a small change of a layer then changes some scale by orders of magnitude."""

COLUMNS: dict[ModulationTarget, int] = {"means": 3, "scales": 3, "quats": 4}

EMBEDDINGS = "embeddings"
"""The attribute of the Gaussians that the modulation reads."""


def embeddings_attribute(dim: int, lr: LearningRate) -> Attribute:
    """Small random embeddings, [N, dim]."""
    return Attribute(dim, lambda n, columns, generator: 0.1 * torch.randn(n, columns, generator=generator), lr)


class Modulation(nn.Module):
    """F of equation 12: an embedding per Gaussian → factors of its summed deltas, initially exactly 1.

    For scales alone, the paper's, it has 1,155 parameters besides the embeddings. Table 5 has the other targets.
    """

    def __init__(self, embedding_dim: int = 32, targets: Sequence[ModulationTarget] = ("scales",)) -> None:
        super().__init__()
        self.targets = [name for name in get_args(ModulationTarget) if name in targets]
        self.hidden = nn.Linear(embedding_dim, HIDDEN_UNITS)
        self.output = nn.Linear(HIDDEN_UNITS, sum(COLUMNS[name] for name in self.targets))
        nn.init.zeros_(self.output.weight)
        nn.init.zeros_(self.output.bias)

    def forward(self, embeddings: Tensor) -> dict[ModulationTarget, Tensor]:
        """Factors in [e^-2, e^2] of the summed deltas, by name, from embeddings, [N, embedding_dim]."""
        logs = self.output(self.hidden(embeddings).relu_()).clamp(-MAX_LOG_FACTOR, MAX_LOG_FACTOR)
        columns = logs.exp().split([COLUMNS[name] for name in self.targets], dim=1)
        return dict(zip(self.targets, columns, strict=True))
