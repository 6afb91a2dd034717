"""A pull towards motion that keeps the distances between Gaussians.

One image a time shows each moving part from one side. Nothing in it tells how the far side moves, nor that what
it doesn't show stands still; a distance to the rest of the scene that has no reason to change does.
"""

import torch
from torch import Tensor

PAIRS = 12_000
"""Drawn anew for each image out of all pairs, not of near ones only."""
SOFTENING = 0.015
"""Of half the scene's extent; added to each distance, so that what is closer than that doesn't count for more."""


def stretch(canonical_means: Tensor, means: Tensor, scene_half_size: float, generator: torch.Generator) -> Tensor:
    """Mean relative change of the distances of random pairs, canonical and posed means both [N, 3]; a scalar."""
    n = len(means)
    if n < 2:
        return means.new_zeros(())
    one, other = torch.randint(n, (2, PAIRS), generator=generator).to(means.device)
    before, after = (torch.linalg.vector_norm(x[one] - x[other], dim=1) for x in (canonical_means, means))
    return ((after - before).abs() / (before.detach() + SOFTENING * scene_half_size)).mean()
