"""Leaving out what a scene does not need, as rendered frames decide."""

from export.pruning.decide import PrunedPart, prune, pruned_model
from export.pruning.mask import PrunedModel, PruningMask, full_mask
from export.pruning.rules import RULES
from export.pruning.statistics import PruningStatistics

__all__ = [
    "RULES",
    "PrunedModel",
    "PrunedPart",
    "PruningMask",
    "PruningStatistics",
    "full_mask",
    "prune",
    "pruned_model",
]
