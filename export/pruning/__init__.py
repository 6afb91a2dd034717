"""Pruning: removal of parts of a scene that rendered frames don't need."""

from export.pruning.decide import prune
from export.pruning.mask import PrunedModel, PruningMask, full_mask, pruned
from export.pruning.rules import RULES
from export.pruning.statistics import PruningStatistics

__all__ = ["RULES", "PrunedModel", "PruningMask", "PruningStatistics", "full_mask", "prune", "pruned"]
