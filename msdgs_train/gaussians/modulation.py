"""Time-invariant modulation of the summed deltas (paper, section 3.4)."""

from collections.abc import Sequence
from typing import Literal, NamedTuple, get_args

import torch
from torch import Tensor, nn

from msdgs_train.layers.parameters import LearningRate
from msdgs_train.supports.base import Attribute

ModulationTarget = Literal["means", "scales", "quats"]

MAX_LOG_FACTOR = 2.0
"""Factors are clamped to [e^-2, e^2]. Unbounded they grew to 5,000 in 2,000 steps on one scene and the loss diverged:
a small change of a layer then changes some scale by orders of magnitude."""

COLUMNS: dict[ModulationTarget, int] = {"means": 3, "scales": 3, "quats": 4}

EMBEDDINGS = "embeddings"
"""The attribute of the Gaussians that the modulation reads."""


class Factors(NamedTuple):
    """Factors of the summed deltas of N Gaussians; None: not modulated."""

    means: Tensor | None  # [N, 3]
    scales: Tensor | None  # [N, 3]
    quats: Tensor | None  # [N, 4]

    def present(self) -> dict[str, Tensor]:
        """Factors by the name of the delta."""
        return {name: factors for name, factors in self._asdict().items() if factors is not None}


def embeddings_attribute(dim: int, lr: LearningRate) -> Attribute:
    """Small random embeddings, [N, dim]."""
    return Attribute(dim, lambda n, columns, generator: 0.1 * torch.randn(n, columns, generator=generator), lr)


class Modulation(nn.Module):
    """F of equation 12: an embedding per Gaussian → factors of its summed deltas, initially exactly 1.

    For scales alone, the paper's, it has 1,155 parameters besides the embeddings. Table 5 has the other targets.
    """

    def __init__(
        self, embedding_dim: int = 32, hidden: int = 32, targets: Sequence[ModulationTarget] = ("scales",)
    ) -> None:
        super().__init__()
        self.targets = [name for name in get_args(ModulationTarget) if name in targets]
        self.hidden = nn.Linear(embedding_dim, hidden)
        self.output = nn.Linear(hidden, sum(COLUMNS[name] for name in self.targets))
        nn.init.zeros_(self.output.weight)
        nn.init.zeros_(self.output.bias)

    def forward(self, embeddings: Tensor) -> Factors:
        """Factors in [e^-2, e^2] of embeddings, [N, embedding_dim]."""
        logs = self.output(self.hidden(embeddings).relu_()).clamp(-MAX_LOG_FACTOR, MAX_LOG_FACTOR)
        columns = logs.exp().split([COLUMNS[name] for name in self.targets], dim=1)
        found = dict(zip(self.targets, columns, strict=True))
        return Factors(found.get("means"), found.get("scales"), found.get("quats"))
