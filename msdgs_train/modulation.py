"""Time-invariant modulation of the scaling (paper, section 3.4)."""

import torch
from torch import Tensor, nn

MAX_LOG_FACTOR = 2.0
"""Factors stay in [e^-2, e^2]. Left alone they grew to 5,000 in 2,000 steps on one scene, and the loss blew up: a small
change of a layer then changes some scale by orders of magnitude."""


class ScaleModulation(nn.Module):
    """F of equation 12: an embedding a Gaussian → three factors for its summed scaling deltas. Starts at exactly 1.

    1,155 parameters at the paper's sizes, besides the embeddings.
    """

    def __init__(self, embedding_size: int = 32, hidden: int = 32) -> None:
        super().__init__()
        self.hidden = nn.Linear(embedding_size, hidden)
        self.output = nn.Linear(hidden, 3)
        nn.init.zeros_(self.output.weight)
        nn.init.zeros_(self.output.bias)

    def forward(self, embeddings: Tensor) -> Tensor:
        """Factors, [N, 3], in [e^-2, e^2], of embeddings, [N, embedding_size]."""
        return torch.exp(self.output(self.hidden(embeddings).relu_()).clamp(-MAX_LOG_FACTOR, MAX_LOG_FACTOR))
